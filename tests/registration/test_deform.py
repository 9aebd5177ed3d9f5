"""Smooth displacements: exact where nothing pulls, on the surface where it does, folds taken out."""

from __future__ import annotations

import numpy as np

from soma_core.registration.deform import Smoothness, deform, project
from soma_core.registration.folds import flipped_triangles, folded_triangles, lay_down
from soma_core.registration.surface import Surface
from tests.registration.test_target import sphere

BALL_M = 0.3
ON_SURFACE_MM = 0.01
NEAR_SURFACE_MM = 1.0  # before projection; the ball is 20 mm larger than where the mesh starts


def _ball() -> tuple[Surface, np.ndarray, Smoothness]:
    vertices, triangles = sphere(16, size=BALL_M)
    target = Surface(*sphere(30, size=BALL_M + 0.02))
    return target, vertices, Smoothness.of(triangles, np.zeros((len(vertices), 5)))


def test_a_mesh_comes_to_lie_on_the_surface() -> None:
    target, start, smooth = _ball()
    free = np.zeros(len(start), bool)
    moved = deform(start, target, smooth, free=free, reaches=(4, 3, 2, 1), scale=0.05)
    gap = 1000 * np.linalg.norm(target.closest(moved).points - moved, axis=1)
    assert gap.mean() < NEAR_SURFACE_MM
    laid = project(moved, target, smooth, free=free)
    assert 1000 * np.linalg.norm(target.closest(laid).points - laid, axis=1).max() < ON_SURFACE_MM


def test_vertices_without_counterpart_follow_their_neighbours() -> None:
    target, start, smooth = _ball()
    free = start[:, 1] > 0.8 * BALL_M
    target = Surface(target.vertices * [1, 0.7, 1], target.triangles)  # a surface that would mislead them
    moved = deform(start, target, smooth, free=free, reaches=(3, 2), scale=0.05)
    assert np.isfinite(moved).all()
    np.testing.assert_array_equal(project(moved, target, smooth, free=free)[free], moved[free])


def test_landmarks_hold() -> None:
    target, start, smooth = _ball()
    turn = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
    ids = np.arange(0, len(start), 40)
    marks = ids, (BALL_M + 0.02) / BALL_M * start[ids] @ turn.T
    moved = deform(
        start, target, smooth, free=np.zeros(len(start), bool), reaches=(3, 2, 2), scale=0.05, landmarks=marks
    )
    assert 1000 * np.linalg.norm(moved[ids] - marks[1], axis=1).max() < NEAR_SURFACE_MM


def test_a_fold_is_taken_out() -> None:
    target, start, smooth = _ball()
    free = np.zeros(len(start), bool)
    on_target = project(start, target, smooth, free=free)
    folded = on_target.copy()
    vertex = int(np.abs(start[:, 1]).argmin())
    folded[vertex] += 2.5 * (on_target[vertex + 1] - on_target[vertex])  # over the next vertex
    bad = flipped_triangles(folded, smooth.triangles, target, free)
    bad |= folded_triangles(folded, start, smooth.triangles)
    assert bad.any()
    mended = lay_down(folded, start, target, smooth, free=free, scale=0.05)
    assert not flipped_triangles(mended, smooth.triangles, target, free).any()
    assert not folded_triangles(mended, start, smooth.triangles).any()
