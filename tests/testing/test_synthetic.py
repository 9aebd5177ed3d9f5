"""The synthetic body is sound: closed, symmetric, human in its proportions, and carried by its rig."""

from __future__ import annotations

import numpy as np
import pytest

from soma_core.io import USER_JOINTS
from soma_core.obj import read_obj
from soma_core.rig import load_canonical
from soma_core.testing.synthetic import (
    NATIVE_FROM_CANONICAL,
    synthetic_canonical,
    synthetic_native,
    write_wrap_pair,
)
from soma_core.topology.correspondence import load_correspondence

MESH, RIG = synthetic_canonical()
ROUNDING = 1e-12
"""Metres; a sum of few float64 terms."""
NET = 0.01
"""Metres; how far the flat faces of two nets of about 5 cm lie from the surface they share."""


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    return float(np.einsum("fc,fc->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(
    ("vertices", "triangles"),
    [(MESH.vertices, MESH.triangles), (synthetic_native()[0] / 100, synthetic_native()[1])],
    ids=["canonical", "native"],
)
def test_the_surfaces_are_closed_and_of_human_size(vertices, triangles):
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)  # each directed edge once
    assert {tuple(edge) for edge in edges} == {(b, a) for a, b in edges}  # and its opposite
    assert len(vertices) - len(edges) // 2 + len(triangles) == 2
    assert 0.08 < volume(vertices, triangles) < 0.11  # m^3
    assert 1.7 < np.ptp(vertices, axis=0).max() < 1.8


def test_the_canonical_mesh_is_symmetric():
    np.testing.assert_array_equal(MESH.mirror[MESH.mirror], np.arange(MESH.vertex_count))
    np.testing.assert_allclose(MESH.vertices[MESH.mirror], MESH.vertices * [-1, 1, 1], atol=ROUNDING, rtol=0)


def test_the_face_interior_has_three_regions_inside_the_head():
    assert len(MESH.segments["mouth_bag"]) > 3
    assert len(MESH.segments["eye_bags"]) > 3
    assert set(MESH.mirror[MESH.face_interior]) == set(MESH.face_interior)
    assert np.linalg.norm(MESH.vertices[MESH.face_interior] - [0, 1.6, 0], axis=1).max() < 0.1


def test_the_rig_has_the_skeleton_of_the_shipped_one():
    real = load_canonical("low")[1]
    assert RIG.joint_names == real.joint_names == ("Root", *USER_JOINTS)
    np.testing.assert_array_equal(RIG.parents, real.parents)
    carried = RIG.weights.sum(0) > 0
    assert {name for name, used in zip(RIG.joint_names, carried, strict=True) if not used} == {
        name for name in RIG.joint_names if name == "Root" or name.endswith(("End", "Eye"))
    }
    np.testing.assert_allclose(RIG.weights.sum(1), 1, atol=ROUNDING)


def test_the_joints_lie_inside_the_body():
    corners = MESH.vertices[MESH.triangles][None] - RIG.bind_world[1:, None, None, :3, 3]
    a, b, c = np.moveaxis(corners, 2, 0)
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    dot = lambda left, right: np.einsum("jfc,jfc->jf", left, right)  # noqa: E731
    solid = np.arctan2(
        dot(a, np.cross(b, c)), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    )
    winding = solid.sum(1) / (2 * np.pi)
    outside = [name for name, turns in zip(RIG.joint_names[1:], winding, strict=True) if turns < 0.5]
    assert not outside


def test_the_t_pose_raises_the_arms_and_keeps_the_bones():
    for places in (RIG.bind_world, RIG.t_pose_world):
        rotation = places[:, :3, :3]
        np.testing.assert_allclose(
            rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (78, 1, 1)), atol=ROUNDING
        )
    lengths = [
        np.linalg.norm(places[1:, :3, 3] - places[RIG.parents[1:], :3, 3], axis=1)
        for places in (RIG.bind_world, RIG.t_pose_world)
    ]
    np.testing.assert_allclose(*lengths, atol=ROUNDING)
    height = dict(zip(RIG.joint_names, RIG.t_pose_world[:, 1, 3], strict=True))
    assert height["LeftHand"] == pytest.approx(height["LeftArm"]) == pytest.approx(height["RightHand"])


def test_the_wrap_pair_fits_the_canonical_mesh(tmp_path):
    pair = write_wrap_pair(tmp_path)
    correspondence = load_correspondence(pair, MESH)
    covered = np.setdiff1d(np.arange(MESH.vertex_count), MESH.face_interior)
    assert correspondence.distances[covered].max() < 100 * ROUNDING
    moved = np.linalg.norm(correspondence.wrap_vertices - MESH.vertices @ NATIVE_FROM_CANONICAL.T, axis=1)
    assert np.percentile(moved, 95) < 100 * NET  # the rest lies on the rounded ends of hands and feet


def test_the_files_read_back_bit_for_bit(tmp_path):
    vertices, triangles = read_obj(write_wrap_pair(tmp_path).native)
    np.testing.assert_array_equal(vertices, synthetic_native()[0])
    np.testing.assert_array_equal(triangles, synthetic_native()[1])
