"""Where a played motion stands: the floor among heights, planted feet, and legs of another length."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.io import read_motion, write_motion
from soma_core.layer import SomaLayer
from soma_core.motion import animate, load_clip
from soma_core.motion.ground import (
    FootTrack,
    contacts_of,
    floor_height,
    leg_length,
    planted_path,
    skeleton_of,
)
from soma_core.options import FrameRange

FPS = 30.0
BODY = 1.7
POKE = 0.075
"""How far a toe goes through the floor in some frames [m]."""

FLOOR_TOLERANCE = 0.004
"""Heights that count as one floor may differ by this [m]; it is a quarter of a layer."""

HOVER = 0.004
"""Median distance of soles that stand from the floor [m]: one foot is never quite as the other."""


def track(joints, soles=None):
    soles = np.zeros(joints.shape[:2]) if soles is None else soles
    return FootTrack(joints=joints, soles=soles, lowest=soles.min(axis=1), height=BODY)


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low")


@pytest.fixture(scope="module")
def standing_clip():
    """A second of the shipped clip, whose feet stand; the Hips sway by more than they did."""
    motion = load_clip(frames=FrameRange(stop=30))
    sway = 0.03 * np.sin(np.linspace(0, 2 * np.pi, 30))[:, None] * [1, 0, 1]
    return replace(motion, translation=motion.translation + sway, contacts=np.ones((30, 4), bool))


# -- the floor ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_minority_below_moves_the_floor_by_nothing(seed):
    random = np.random.default_rng(seed)
    heights = np.concatenate(
        [0.002 * random.standard_normal(60), 0.2 * random.random(40), -POKE * random.random(20)]
    )
    found = floor_height(heights, BODY)
    assert abs(found) < FLOOR_TOLERANCE
    np.testing.assert_allclose(floor_height(random.permutation(heights) + 3.0, BODY), found + 3, atol=1e-9)


def test_of_several_floors_it_is_the_lowest():
    stairs = np.repeat([0.0, 0.17, 0.34], 20) + 0.001 * np.random.default_rng(0).standard_normal(60)
    assert abs(floor_height(stairs, BODY)) < FLOOR_TOLERANCE
    assert floor_height(np.array([0.4]), BODY) == 0.4


def test_low_and_slow_feet_stand(standing_clip):
    joints = np.zeros((20, 4, 3))
    joints[10:, 0, 0] = np.arange(10) / FPS  # a metre a second
    soles = np.zeros((20, 4))
    soles[:, 3] = 0.2
    still = replace(standing_clip.cut(slice(0, 20)), contacts=None, fps=FPS)
    found = contacts_of(track(joints, soles), still, 0.0)
    assert found[:10, 0].all()
    assert not found[12:, 0].any()
    assert found[:, 1].all()
    assert not found[:, 3].any()


def test_contacts_flicker_neither_where_they_are_found_nor_hold_what_runs(standing_clip):
    joints, soles = np.zeros((40, 4, 3)), np.zeros((40, 4))
    soles[20, 0] = 1.0  # one frame
    soles[:, 1] = 1.0
    soles[20, 1] = 0.0
    joints[20:, 2, 2] = 2.0 * np.arange(20) / FPS
    still = standing_clip.cut(np.zeros(40, int))
    found = contacts_of(track(joints, soles), replace(still, contacts=None), 0.0)
    assert found[:, 0].all()
    assert not found[:, 1].any()
    told = contacts_of(track(joints, soles), still, 0.0)  # the file says that all stand
    assert told[:, [0, 1, 3]].all()
    assert told[:19, 2].all()
    assert not told[22:, 2].any()


# -- the path -----------------------------------------------------------------------------------------


def test_the_path_follows_a_foot_that_would_slide():
    joints = np.zeros((40, 4, 3))
    joints[:, 0, 0] = 0.2 * np.arange(40) / FPS
    contacts = np.zeros((40, 4), bool)
    contacts[10:25, 0] = True
    change = planted_path(track(joints), contacts, FPS)
    moved = joints + change[:, None]
    own, left = (np.abs(np.diff(way[11:24, 0, 0])).mean() for way in (joints, moved))
    assert left < own / 3
    assert np.abs(change[:, 1:]).max() < 1e-12
    bend = FPS**2 * np.abs(np.diff(change[:, 0], 2))
    assert bend.max() < 4  # no jerk: 0.4 g, as a step has


def test_what_slides_on_purpose_and_what_does_not_stand_is_left_alone():
    joints = np.zeros((40, 4, 3))
    joints[:, 0, 0] = 3 * np.arange(40) / FPS
    assert not planted_path(track(joints), np.ones((40, 4), bool), FPS)[:, 1:].any()
    skating = planted_path(track(joints[:, [0] * 4]), np.ones((40, 4), bool), FPS)
    assert np.abs(skating).max() < 1e-9
    assert not planted_path(track(joints), np.zeros((40, 4), bool), FPS).any()
    assert not planted_path(track(joints[:2]), np.ones((2, 4), bool), FPS).any()


# -- a body on the ground -----------------------------------------------------------------------------


def slide(found, contacts):
    steps = np.linalg.norm(np.diff(found.feet.joints[..., [0, 2]], axis=0), axis=-1)
    return steps[contacts[1:] & contacts[:-1]].mean()


def test_feet_in_contact_stand_on_the_floor_and_slide_less(layer, standing_clip):
    identity = layer.identity({})
    lowest, found = (animate(layer, identity, standing_clip, ground=way) for way in ("lowest", None))
    assert np.median(np.abs(found.feet.soles[standing_clip.contacts])) < HOVER
    assert slide(found, standing_clip.contacts) < 0.3 * slide(lowest, standing_clip.contacts)
    np.testing.assert_array_equal(found.contacts, standing_clip.contacts)


def test_a_toe_that_pokes_through_the_floor_does_not_lift_the_clip(layer, standing_clip):
    identity, toes = layer.identity({}), layer.joint_names.index("LeftToeBase")
    pointed = standing_clip.rotations.copy()
    pointed[12:15, toes] = Rotation.from_euler("x", 60, degrees=True).as_matrix()
    for contacts in (standing_clip.contacts, None):
        poked = replace(standing_clip, rotations=pointed, contacts=contacts)
        still = animate(layer, identity, replace(standing_clip, contacts=contacts))
        found = animate(layer, identity, poked)
        assert found.feet.lowest.min() < -0.03
        change = found.motion.translation[:, 1] - still.motion.translation[:, 1]
        assert np.abs(change).max() < FLOOR_TOLERANCE


def test_the_path_is_scaled_by_the_legs_of_the_source(layer, standing_clip):
    identity = layer.identity({})
    walk = replace(
        standing_clip, contacts=None, translation=np.arange(30)[:, None] * [0.0, 0, 0.1] + [0, 1, 0]
    )
    own = skeleton_of(layer.rig, identity)
    for size in (1.0, 2.0):
        recorded = replace(walk, skeleton=size * own)
        found = animate(layer, identity, recorded, ground="none").motion
        np.testing.assert_allclose(found.translation * size, recorded.translation, atol=1e-5)
        np.testing.assert_allclose(found.skeleton, own, atol=1e-6)
    unknown = own.copy()
    unknown[layer.joint_names.index("LeftShin")] = np.nan
    assert leg_length(unknown) is None
    a = animate(layer, identity, replace(walk, skeleton=unknown), ground="none").motion.translation
    np.testing.assert_array_equal(a, animate(layer, identity, walk, ground="none").motion.translation)


def test_a_motion_played_again_stays_where_it_is(layer, standing_clip, tmp_path):
    identity = layer.identity({})
    once = animate(layer, identity, standing_clip).motion
    write_motion(once, tmp_path / "motion.npz")
    again = animate(layer, identity, read_motion(tmp_path / "motion.npz")).motion
    np.testing.assert_array_equal(again.contacts, standing_clip.contacts)
    np.testing.assert_allclose(again.translation[:, 1], once.translation[:, 1], atol=1e-5)


@pytest.mark.parametrize(
    ("choice", "text"),
    [
        ({"ground": "floor"}, "ground: got 'floor', expected 'contacts' or 'lowest' or 'none'"),
        ({"contacts": "glue"}, "contacts: got 'glue'"),
        (
            {"translation": "motion", "ground": "lowest"},
            "ground: got lowest, expected none with",
        ),
        (
            {"translation": "none", "contacts": "lock"},
            "contacts: got lock, expected free",
        ),
    ],
)
def test_choices_that_do_not_go_together_are_refused(layer, standing_clip, choice, text):
    with pytest.raises(InputError, match=text):
        animate(layer, layer.identity({}), standing_clip, **choice)
