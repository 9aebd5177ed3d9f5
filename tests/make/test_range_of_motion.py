"""The shipped clip is what the code makes, moves smoothly and stands on the ground."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from assets.make.range_of_motion import FPS, SECONDS, main, range_of_motion
from soma_core.io import USER_JOINTS, read_motion
from soma_core.paths import assets_dir
from soma_core.rig import load_canonical

CLIP = assets_dir() / "motions/range_of_motion.npz"

STORED_TOLERANCE = 2e-6
"""Matrix entries after float32 rotation vectors."""

FASTEST = 6.0
"""Joint speed [rad/s]: a brisk but unhurried arm swing."""

SOFTEST_START = 1.6
"""Largest change of joint velocity in one frame [rad/s]; a jump of the angle would exceed it."""

SLIDE_MM = 0.01
"""Drift of a standing ankle; only float32 rounding is left."""


@pytest.fixture(scope="module")
def rig():
    return load_canonical()[1]


@pytest.fixture(scope="module")
def motion(rig):
    return range_of_motion(rig)


def joint(motion, name):
    return motion.rotations[:, USER_JOINTS.index(name)].astype(float)


def world(rig, motion, chain):
    """Position of the last joint of a chain that starts at Hips (frames, 3) and its turn."""
    place = dict(zip(rig.joint_names, rig.t_pose_world[:, :3, 3], strict=True))
    turn, position = joint(motion, "Hips"), motion.translation.astype(float)
    for parent, name in zip(("Hips", *chain), chain, strict=False):
        position = position + turn @ (place[name] - place[parent])
        turn = turn @ joint(motion, name)
    return position, turn


def test_shipped_file_is_what_the_code_makes(motion):
    stored = read_motion(CLIP)
    np.testing.assert_allclose(stored.rotations, motion.rotations, atol=STORED_TOLERANCE)
    np.testing.assert_allclose(stored.translation, motion.translation, atol=STORED_TOLERANCE)
    assert (stored.fps, stored.rig_revision, stored.licence) == (FPS, motion.rig_revision, "Apache-2.0")
    assert CLIP.stat().st_size < 300_000


def test_writing_twice_gives_the_same_motion(tmp_path):
    for name in ("a.npz", "b.npz"):
        main(str(tmp_path / name))
    a, b = (dict(np.load(tmp_path / name)) for name in ("a.npz", "b.npz"))
    assert a.keys() == b.keys()
    assert all((a[key] == b[key]).all() for key in a)


def test_both_ends_are_the_t_pose(motion):
    np.testing.assert_allclose(motion.rotations[[0, -1]] - np.eye(3), 0, atol=1e-7)
    assert motion.frame_count == SECONDS * FPS + 1


def test_joints_move_smoothly(motion):
    rotations = motion.rotations.astype(float)
    steps = np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:]
    velocity = Rotation.from_matrix(steps.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 77, 3) * FPS
    assert np.linalg.norm(velocity, axis=-1).max() < FASTEST
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=-1).max() < SOFTEST_START


def test_every_kind_of_joint_takes_part(motion):
    reach = Rotation.from_matrix(motion.rotations.reshape(-1, 3, 3).astype(float)).magnitude()
    reach = np.degrees(reach.reshape(-1, 77).max(axis=0))
    largest = {name: reach[USER_JOINTS.index(name)] for name in USER_JOINTS}
    for name, low, high in (
        ("LeftArm", 60, 110),
        ("RightForeArm", 100, 145),
        ("LeftLeg", 80, 120),
        ("RightShin", 80, 140),
        ("Chest", 10, 40),
        ("Head", 20, 70),
        ("LeftHandIndex3", 80, 100),
        ("RightHandThumb3", 30, 60),
        ("Jaw", 5, 25),
    ):
        assert low < largest[name] < high, name


@pytest.mark.parametrize(("side", "until"), [("Right", 11.2), ("Left", 10.2)])
def test_a_standing_foot_neither_slides_nor_tilts(rig, motion, side, until):
    ankle, turn = world(rig, motion, [side + part for part in ("Leg", "Shin", "Foot")])
    standing = np.arange(motion.frame_count) / FPS < until
    assert 1000 * np.linalg.norm(ankle - ankle[0], axis=1)[standing].max() < SLIDE_MM
    np.testing.assert_allclose(turn[standing], np.broadcast_to(np.eye(3), turn[standing].shape), atol=1e-5)


def test_a_lifted_knee_leaves_the_ground(rig, motion):
    toes = world(rig, motion, [f"Left{part}" for part in ("Leg", "Shin", "Foot", "ToeBase")])[0]
    assert toes[round(10.75 * FPS), 1] > 0.25
