"""Closest points that look the same way."""

from __future__ import annotations

import numpy as np

from soma_core.registration.surface import Surface
from tests.registration.test_target import sphere

ROUNDING = 1e-12


def _two_sheets(gap: float = 0.004) -> Surface:
    """Two plates [m] that face away from each other, like the sides of a thin part."""
    side = np.linspace(0, 0.1, 11)
    x, z = (each.ravel() for each in np.meshgrid(side, side))
    upper = np.stack([x, np.full_like(x, gap), z], 1)
    corner = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    facing_up = np.concatenate(
        [np.stack([corner, corner + 11, corner + 1], 1), np.stack([corner + 1, corner + 11, corner + 12], 1)]
    )
    lower = upper * [1, 0, 1]
    return Surface(
        np.concatenate([upper, lower]), np.concatenate([facing_up, facing_up[:, ::-1] + len(upper)])
    )


def test_the_side_that_looks_the_same_way_wins() -> None:
    surface = _two_sheets()
    points = np.array([[0.05, 0.0, 0.05], [0.03, 0.001, 0.07]])
    up = np.tile([0.0, 1.0, 0.0], (2, 1))
    np.testing.assert_allclose(surface.facing(points, up).points[:, 1], 0.004, atol=ROUNDING)
    np.testing.assert_allclose(surface.facing(points, -up).points[:, 1], 0.0, atol=ROUNDING)
    np.testing.assert_allclose(surface.closest(points).points[:, 1], 0.0, atol=ROUNDING)


def test_both_queries_agree_on_a_convex_body() -> None:
    surface = Surface(*sphere())
    random = np.random.default_rng(1)
    normals = random.standard_normal((300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 1.02 * normals
    facing, closest = surface.facing(points, normals), surface.closest(points)
    np.testing.assert_allclose(facing.points, closest.points, atol=ROUNDING)
    corners = surface.vertices[surface.triangles[facing.faces]]
    np.testing.assert_allclose(np.einsum("mk,mkc->mc", facing.shares, corners), facing.points, atol=1e-9)
    assert (np.linalg.norm(facing.normals, axis=1) - 1 < ROUNDING).all()
    assert ((facing.normals * normals).sum(1) > 0.99).all()
