"""Fingers and toes are told apart on any tessellation, and a wrap that mixes them up is found out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from soma_core.registration.coverage import (
    COVERED,
    MATCHED,
    Share,
    coverage,
    faults,
    lost,
    matches,
    slid,
    without_digits,
)
from soma_core.registration.digits import DIGITS, LIMBS, digit_guide
from soma_core.registration.surface import Surface
from soma_core.registration.target import Frame, find_skin
from soma_core.rig import load_canonical
from soma_core.rig.landmarks import canonical_landmarks

TIP_M = 0.012  # a tip is the vertex furthest from the wrist, on a coarse mesh another one
SLID_M = 0.04  # of a face, off a forehead that stays
SOLE_M = 0.012
FEW_FACES = 2000
SIDES, LONG = ("Left", "Right"), ("Index", "Middle", "Ring")
AWAY_M = 0.03  # what a rough fit may be off at wrists and insteps


@pytest.fixture(scope="module")
def guide():
    return digit_guide()


@pytest.fixture(scope="module")
def halved(guide) -> tuple[Surface, np.ndarray]:
    """The bind shape in another tessellation: centres of faces joined, with noise; and its canonical twin."""
    mesh = guide.mesh
    skin = mesh.triangles[~np.isin(mesh.triangles, mesh.face_interior).any(1)].astype(np.int64)
    used, place = np.unique(skin, return_inverse=True)
    vertices, triangles = trimesh.remesh.subdivide(mesh.vertices[used], place.reshape(-1, 3))
    noise = np.random.default_rng(0).normal(scale=3e-4, size=vertices.shape)
    return Surface(vertices + noise, triangles), mesh.vertices


def test_each_limb_has_five_in_their_order(guide, halved) -> None:
    surface, body = halved
    found = guide.find(surface, body + np.array([0, AWAY_M, 0]))
    assert found.counts == dict.fromkeys(LIMBS, 5)
    for limb in LIMBS:
        gap = np.linalg.norm(surface.vertices[found.tips[limb]][:, None] - body[guide.tips[limb]], axis=2)
        assert (gap.argmin(1) == np.arange(5)).all()
        assert np.diag(gap).max() < TIP_M


def test_both_hands_are_mirror_images(guide) -> None:
    mirror = guide.mesh.mirror
    for kind in ("Hand", "Foot"):
        left, right = (guide.along[f"{side}{kind}"] for side in ("Left", "Right"))
        assert np.abs(left[:, mirror] - right).max() < 0.05  # shares; triangles split quads differently


def test_a_landmark_decides(guide, halved) -> None:
    surface, body = halved
    index, ring = guide.tips["LeftHand"][[1, 3]]
    found = guide.find(surface, body, marks=(np.array([index]), body[[ring]]))
    gap = np.linalg.norm(surface.vertices[found.tips["LeftHand"][1]] - body[ring])
    assert gap < TIP_M


def test_fingers_that_are_none_are_said(guide, halved) -> None:
    _, body = halved
    stump = body.copy()
    for along in guide.along["LeftHand"]:
        stump[along > 0] = body[(along > 0) & (along < 0.2)].mean(0)
    found = guide.find(Surface(stump, guide.mesh.triangles.astype(np.int64)), body)
    assert "LeftHand" not in found.tips
    assert "RightHand" in found.tips
    assert any(text.startswith("LeftHand: no separate fingers") for text in without_digits({"LeftHand": 1}))


def test_a_finger_on_its_neighbour_is_found_out(guide, halved) -> None:
    surface, body = halved
    right = guide.find(surface, body)
    shares = matches(body, surface, right, guide)
    assert len(shares) == 20
    assert min(share.least for share in shares.values()) > MATCHED
    ring, pinky = guide.along["LeftHand"][3] > 0, guide.along["LeftHand"][4] > 0
    shifted = body.copy()
    offset = body[pinky].mean(0) - body[ring].mean(0)
    shifted[ring] += offset
    mesh, rig = load_canonical("mid")
    shares = matches(shifted, surface, guide.find(surface, shifted), guide)
    assert shares["LeftRing"].least < 0.5 * MATCHED
    assert shares["RightRing"].least > MATCHED
    covered = coverage(shifted, surface, mesh, rig, np.isin(np.arange(len(body)), mesh.face_interior))
    assert covered["LeftRing"].least < COVERED
    assert covered["RightRing"].least > COVERED
    said = faults(covered, shares, dict.fromkeys(LIMBS, 5))
    assert any(text.startswith("LeftRing: ") for text in said)
    assert not any("Right" in text for text in said)


def test_fingers_that_are_one_to_their_middle_are_no_fault(guide, halved) -> None:
    surface, body = halved
    found = guide.find(surface, body)
    fused = {limb: np.clip(2 * along - 1, 0, None) for limb, along in found.along.items()}
    shares = matches(body, surface, replace(found, along=fused), guide)
    assert min(share.least for share in shares.values()) > MATCHED
    gone = {limb: np.clip(6 * along - 5, 0, None) for limb, along in found.along.items()}
    shares = matches(body, surface, replace(found, along=gone), guide)
    assert max(share.wrap for share in shares.values()) < MATCHED


def test_less_is_asked_of_digits_on_a_mesh_of_few_faces(guide, halved) -> None:
    pyvista = pytest.importorskip("pyvista")
    surface, body = halved
    fine = matches(body, surface, guide.find(surface, body), guide)
    assert {share.asked for share in fine.values()} == {MATCHED}
    whole = pyvista.PolyData(surface.vertices, np.insert(surface.triangles, 0, 3, axis=1).ravel())
    few = whole.decimate(1 - FEW_FACES / len(surface.triangles))
    coarse = Surface(np.asarray(few.points, np.float64), few.faces.reshape(-1, 4)[:, 1:].astype(np.int64))
    found = guide.find(coarse, body)
    shares = matches(body, coarse, found, guide)
    assert all(0 < shares[f"{side}{name}"].asked < MATCHED for side in SIDES for name in ("Index", "Ring"))
    swapped = replace(found, along={limb: along[[0, 2, 1, 4, 3]] for limb, along in found.along.items()})
    shares = matches(body, coarse, swapped, guide)
    said = faults({}, shares, dict.fromkeys(LIMBS, 5))
    assert all(any(text.startswith(f"{side}{name}: ") for text in said) for side in SIDES for name in LONG)


def test_what_lies_over_holes_is_no_fault_until_a_part_is_gone(guide) -> None:
    mesh, rig = load_canonical("mid")
    body, faces = mesh.vertices, mesh.triangles.astype(np.int64)
    sole = body[:, 1] < body[:, 1].min() + SOLE_M
    hand = np.char.startswith(np.array(rig.joint_names)[rig.weights.toarray().argmax(1)], "LeftHand")
    for gone, said in ((sole, ()), (hand, ("LeftHand", "LeftThumb"))):
        skin = find_skin(body, faces[~gone[faces].any(1)])
        assert not skin.masked
        assert skin.notes[-1] == "has holes; skin is drawn over them"
        frame = Frame(unit="m", up="+y", forward="+z", centre=(0.0, 0.0, 0.0))
        assert list(lost(body, skin.surface(frame), rig))[:2] == list(said)


def test_a_face_that_slid_is_found_out(guide) -> None:
    mesh, rig = load_canonical("mid")
    filled = np.zeros(mesh.vertex_count, bool)
    assert slid(7 * mesh.vertices, mesh, rig, filled) == ()
    brow = mesh.vertices[canonical_landmarks()["LeftInnerEye"], 1] + 0.03
    low = mesh.vertices.copy()
    low[:, 1] -= SLID_M * np.clip((brow - low[:, 1]) / 0.02, 0, 1)
    (said,) = slid(low, mesh, rig, filled)
    assert said.startswith("head: ")


@pytest.mark.parametrize(
    ("count", "told", "refused"),
    [
        (4, (), True),
        (4, ("LeftHand",), False),
        (2, (), False),
        (None, (), True),
        (None, ("LeftHand",), False),
    ],
)
def test_fingers_that_cannot_be_told_apart_are_refused_by_name(count, told, refused) -> None:
    counts = dict.fromkeys(LIMBS, 5) | {"LeftHand": count}
    said = faults({"head": Share(wrap=1.0, native=1.0)}, {}, counts, told=told)
    text = f"LeftHand: {count} fingers stand out of the mesh, not 5, so that none can be told from another"
    if count is None:
        text = "LeftHand: it touches another part of the mesh, so that no finger can be told"
    assert said == ((text,) if refused else ())


@pytest.mark.parametrize(("bare", "refused"), [(0.1, False), (0.7, True)])
def test_fingers_within_a_ball_in_place_of_a_hand_are_refused(bare, refused) -> None:
    names = [f"Left{digit}" for digit in DIGITS["Hand"]]
    covered = {name: Share(wrap=0.4, native=1 - bare) for name in names}
    said = faults(covered, {}, dict.fromkeys(LIMBS, 5) | {"LeftHand": 1})
    text = f"LeftHand: no fingers stand out of the mesh, of which {bare:.0%} is bare there"
    assert said == ((text,) if refused else ())
