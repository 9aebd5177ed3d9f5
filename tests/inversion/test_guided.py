"""A fit that is told how another rig turned its joints."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core import SomaLayer
from soma_core.errors import InputError
from soma_core.inversion.guided import GuidedInversion
from soma_core.inversion.priors import PosePriors
from soma_core.io.joint_order import USER_JOINTS
from soma_core.motion import FrameRange, load_clip

FRAMES = 6
TWIST_DEGREES = 15.0
"""Upper arms and thighs of another rig, whose skin tells no twist: without turns to go by up to 90."""

MOVED_MM = 0.5
"""What skin of the model itself is moved by, where each joint is expected ten degrees off."""


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low")


@pytest.fixture(scope="module")
def clip():
    return load_clip(frames=FrameRange(start=0, stop=280, step=280 // FRAMES)).cut(slice(FRAMES))


def apart(found, clip, *parts):
    """Angles [degrees] between joints and those of the clip, (frames, joints)."""
    joints = [USER_JOINTS.index(side + part) for side in ("Left", "Right") for part in parts]
    turns = np.swapaxes(clip.rotations[:, joints], -1, -2) @ found.rotations[:, joints].numpy()
    size = turns.shape[:2]
    return np.degrees(Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude()).reshape(size)


def fitted(layer, clip, *, expected, plain, factor=1.0):
    identity = layer.identity()
    rotations, hips = torch.as_tensor(clip.rotations), torch.as_tensor(clip.translation)
    posed = (layer.pose_plain if plain else layer.pose)(identity, rotations, hips)
    fit = GuidedInversion(layer, skinning="full", priors=PosePriors(expected=factor))
    return fit.guided(posed.vertices, identity, torch.as_tensor(expected))


def test_twists_that_skin_does_not_tell_are_those_expected(layer, clip):
    told = fitted(layer, clip, expected=clip.rotations, plain=True)
    assert apart(told, clip, "Arm", "ForeArm", "Leg", "Shin").max() < TWIST_DEGREES
    free = fitted(layer, clip, expected=clip.rotations, plain=True, factor=0)
    assert apart(free, clip, "Arm", "ForeArm", "Leg", "Shin").max() > TWIST_DEGREES


def test_skin_is_hardly_moved_by_what_is_expected(layer, clip):
    wrong = np.random.default_rng(0).normal(size=(len(clip.rotations) * 77, 3))
    wrong *= np.radians(10) / np.linalg.norm(wrong, axis=1, keepdims=True)
    expected = clip.rotations @ Rotation.from_rotvec(wrong).as_matrix().reshape(-1, 77, 3, 3)
    told = fitted(layer, clip, expected=expected.astype(np.float32), plain=False)
    assert 1e3 * float(told.vertex_error.nanmean()) < MOVED_MM


def test_turns_of_other_frames_are_refused(layer, clip):
    with pytest.raises(InputError, match="expected: got 5 frames, expected 6 frames"):
        fitted(layer, clip, expected=clip.rotations[1:], plain=True)
