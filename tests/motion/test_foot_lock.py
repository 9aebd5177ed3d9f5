"""Feet that are pinned: they stay, the rest of the body does not change, legs neither flip nor stretch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.layer import SomaLayer
from soma_core.motion import animate, load_clip
from soma_core.motion.foot_lock import lock_feet
from soma_core.motion.ground import FootTrack
from soma_core.options import FrameRange

FPS = 30.0
PINNED = 2e-4
"""A pinned joint moves by less than this [m] in a contact: float32, and what the two ends of a foot share."""

STEP, BEND = 0.015, 0.0075
"""Largest step of a joint in a frame and its change [m], for a sway of 3 cm: a pop takes it at once."""

LEG = [f"{side}{part}" for side in ("Left", "Right") for part in ("Leg", "Shin", "Foot")]


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low")


@pytest.fixture(scope="module")
def clip(layer):
    """Somebody in a light squat whose Hips sway over feet that stand, but for the left one in between."""
    frames = 60
    motion = load_clip(frames=FrameRange(stop=1))
    motion = motion.cut(np.zeros(frames, int))
    rotations = motion.rotations.copy()
    for side in ("Left", "Right"):
        for part, angle in (("Leg", -25), ("Shin", 50), ("Foot", -25)):
            turn = Rotation.from_euler("x", angle, degrees=True).as_matrix()
            rotations[:, layer.joint_names.index(side + part)] = turn
    phase = 2 * np.pi * np.arange(frames) / frames
    sway = 0.03 * np.stack([np.sin(phase), 0 * phase, np.sin(2 * phase)], axis=1)
    contacts = np.ones((frames, 4), bool)
    contacts[20:40, :2] = False
    return replace(
        motion, rotations=rotations, translation=motion.translation + sway, contacts=contacts, fps=FPS
    )


def played(layer, motion, **choice):
    with torch.no_grad():
        return animate(layer, layer.identity({}), motion, ground="lowest", **choice)


def test_pinned_feet_stay_and_come_and_go_smoothly(layer, clip):
    free, locked = played(layer, clip), played(layer, clip, contacts="lock")
    for index in range(4):
        for run in (slice(0, 20), slice(40, 60)) if index < 2 else (slice(0, 60),):
            assert np.ptp(free.feet.joints[run, index], axis=0).max() > 0.01
            assert np.ptp(locked.feet.joints[run, index], axis=0).max() < PINNED
    step = np.linalg.norm(np.diff(locked.transforms[:, :, :3, 3], axis=0), axis=-1)
    bend = np.linalg.norm(np.diff(locked.transforms[:, :, :3, 3], 2, axis=0), axis=-1)
    assert step.max() < STEP
    assert bend.max() < BEND


def test_only_legs_change_and_knees_bend_as_before(layer, clip):
    free, locked = played(layer, clip), played(layer, clip, contacts="lock")
    legs = [layer.joint_names.index(name) for name in LEG]
    others = np.setdiff1d(np.arange(77), legs)
    np.testing.assert_array_equal(locked.motion.rotations[:, others], free.motion.rotations[:, others])
    knees = [layer.joint_names.index(name) for name in ("LeftShin", "RightShin")]
    turned = Rotation.from_matrix(locked.motion.rotations[:, knees].reshape(-1, 3, 3)).as_rotvec()
    assert (turned[:, 0] > np.radians(20)).all()
    assert np.abs(turned[:, 1:]).max() < np.radians(10)


def test_where_a_leg_does_not_reach_the_hips_sink(layer, clip):
    straight = replace(clip, rotations=clip.rotations.copy(), contacts=np.ones((60, 4), bool))
    for name in LEG:
        straight.rotations[:, layer.joint_names.index(name)] = np.eye(3)
    wide = straight.translation * [4, 1, 1]
    free, locked = (
        played(layer, replace(straight, translation=wide), contacts=way) for way in ("free", "lock")
    )
    sunk = (free.motion.translation - locked.motion.translation)[:, 1]
    assert sunk.min() > -1e-6
    assert 0.005 < sunk.max() < 0.05 * 1.6
    assert np.ptp(locked.feet.joints[:, 2], axis=0).max() < 5 * PINNED
    knees = locked.motion.rotations[:, layer.joint_names.index("RightShin")]
    assert np.degrees(Rotation.from_matrix(knees).magnitude()).max() < 60


def test_absolute_rotations_are_pinned_alike(layer, clip):
    orient = np.concatenate([np.eye(3)[None], layer.rig.t_pose_world[1:, :3, :3]])
    local = np.swapaxes(orient[layer.rig.parents[1:]], -1, -2) @ clip.rotations.astype(float) @ orient[1:]
    absolute = replace(clip, rotations=local, convention="absolute_local")
    a, b = (played(layer, motion, contacts="lock") for motion in (clip, absolute))
    np.testing.assert_allclose(a.transforms, b.transforms, atol=1e-4)


@pytest.mark.parametrize("bend", [-3.0, 0.0, 3.0, 40.0])
def test_what_stands_already_is_not_touched(layer, clip, bend):
    """Straight knees and such as are bent the wrong way are no exception."""
    still = clip.cut(np.zeros(8, int))
    turn = Rotation.from_euler("x", bend, degrees=True).as_matrix()
    still.rotations[:, layer.joint_names.index("LeftShin")] = turn
    found = played(layer, still)
    track = FootTrack(
        joints=found.feet.joints, soles=np.zeros((8, 4)), lowest=np.zeros(8), height=found.feet.height
    )
    locked = lock_feet(
        found.motion, found.transforms, track, still.contacts[:8] | True, rig=layer.rig, floor=0.0
    )
    np.testing.assert_allclose(locked.rotations, found.motion.rotations, atol=1e-5)
    np.testing.assert_allclose(locked.translation, found.motion.translation, atol=1e-6)
