"""Cleaned motions: spikes go, smooth motions stay, nothing lags, and the mirror image is one."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.motion import Motion
from soma_core.layer import SomaLayer
from soma_core.motion import (
    CleanOptions,
    LimbSeconds,
    clean,
    load_clip,
    mirror,
    mirrored_body,
    motion_quality,
    resample,
    smooth,
    without_spikes,
)
from soma_core.motion.cleaning import _LIMBS, _limb
from soma_core.motion.quality import joint_places, relative_rotations
from soma_core.rig import load_canonical

FRAMES, FPS = 60, 30.0

CHANGED_DEG = 0.1
"""How far smoothing may turn a joint of a smooth motion."""

LEFT_DEG = 3.0
"""What may be left of a spike of 40 degrees: the way of the joint in the frame that is interpolated."""

MIRROR_MM = 0.01
"""How far mirrored joints and skin may be from the mirror image."""

SYMMETRIC = 1e-6
"""Difference of skin weights from those of the other side that counts as rounding."""

EVERY = LimbSeconds(**dict.fromkeys(["path", *_LIMBS], 0.05))


def swinging(seed: int, frequency: float = 1.0, fps: float = FPS, frames: int = FRAMES) -> Motion:
    """Every joint swings by up to 30 degrees at its own phase; the Hips turn steadily and walk."""
    random = np.random.default_rng(seed)
    time = np.arange(frames) / fps
    axis = random.standard_normal((77, 3))
    axis *= np.radians(30) / np.linalg.norm(axis, axis=-1, keepdims=True)
    swing = np.sin(2 * np.pi * (frequency * time[:, None] + random.random(77)))
    rotations = Rotation.from_rotvec((swing[..., None] * axis).reshape(-1, 3)).as_matrix()
    rotations = rotations.reshape(frames, 77, 3, 3)
    rotations[:, 0] = Rotation.from_rotvec(np.outer(4.0 * time, [0.1, 1.0, 0.2])).as_matrix()
    path = np.stack([np.sin(time), 0.9 + 0.05 * np.sin(4 * time), time], axis=1)
    return Motion(
        rotations=rotations, translation=path, fps=fps, joint_names=USER_JOINTS,
        contacts=random.random((frames, 4)) < 0.5, skeleton=random.standard_normal((77, 3)),
    )  # fmt: skip


def degrees(first: Motion, second: Motion) -> np.ndarray:
    """Angles (frames, 77) between the rotations of two motions."""
    between = np.swapaxes(first.rotations, -1, -2).astype(np.float64) @ second.rotations
    return np.degrees(Rotation.from_matrix(between.reshape(-1, 3, 3)).magnitude()).reshape(-1, 77)


def turned(motion: Motion, frames: list[int], joint: int, angle: float, seed: int = 0) -> Motion:
    """The motion with a joint that is turned further in some frames, about any axis."""
    axis = np.random.default_rng(seed).standard_normal(3)
    spike = Rotation.from_rotvec(np.radians(angle) * axis / np.linalg.norm(axis)).as_matrix()
    rotations = motion.rotations.copy()
    rotations[frames, joint] = rotations[frames, joint] @ spike
    return replace(motion, rotations=rotations)


def noisy(motion: Motion, angle: float, seed: int = 0) -> Motion:
    """Rotations with noise of so many degrees about each axis, the path with as many millimetres."""
    random = np.random.default_rng(seed)
    shape = motion.rotations.shape[:2]
    noise = Rotation.from_rotvec(np.radians(angle) * random.standard_normal((shape[0] * shape[1], 3)))
    path = motion.translation + 1e-3 * angle * random.standard_normal(motion.translation.shape)
    rotations = motion.rotations @ noise.as_matrix().reshape(*shape, 3, 3)
    return replace(motion, rotations=rotations, translation=path)


@pytest.mark.parametrize("seed", [0, 1])
def test_smooth_motions_stay(seed):
    motion = swinging(seed)
    assert degrees(motion, clean(motion).motion).max() < CHANGED_DEG
    assert np.abs(motion.translation - clean(motion).motion.translation).max() < 1e-3


def test_a_steady_turn_stays_at_any_gain():
    """Quaternions of a turn of constant speed lie on a circle, which smoothing shrinks, but does not turn."""
    motion = swinging(0, fps=30, frames=90)
    found = smooth(motion, LimbSeconds(hips=0.06))
    assert degrees(motion, found)[:, 0].max() < CHANGED_DEG
    assert (found.rotations[:, 1:] == motion.rotations[:, 1:]).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_noise_goes(seed):
    true = swinging(seed)
    given = noisy(true, 2.0, seed)
    found = smooth(given, EVERY)
    assert degrees(true, found)[5:-5].mean() < 0.6 * degrees(true, given).mean()
    assert motion_quality(found)["jitter_m_s3"] < 0.2 * motion_quality(given)["jitter_m_s3"]
    errors = [np.linalg.norm(each.translation - true.translation, axis=1).mean() for each in (given, found)]
    assert errors[1] < 0.7 * errors[0]


def test_nothing_lags():
    """What is smoothed backward in time is the same: no filter that looks to one side is."""
    motion = noisy(swinging(2), 2.0)
    backward = motion.cut(slice(None, None, -1))
    there, back = smooth(motion, EVERY), smooth(backward, EVERY).cut(slice(None, None, -1))
    assert degrees(there, back).max() < 1e-3
    swing = Rotation.from_matrix(there.rotations[:, 5]).as_rotvec() @ [1.0, 0.4, 0.2]
    own = Rotation.from_matrix(motion.rotations[:, 5]).as_rotvec() @ [1.0, 0.4, 0.2]
    shifts = [np.dot(swing[5:-5], own[5 + lag : len(own) - 5 + lag]) for lag in (-1, 0, 1)]
    assert np.argmax(shifts) == 1


def test_smoothing_follows_any_frame_of_reference():
    motion = noisy(swinging(3), 3.0)
    left, right = Rotation.random(2, random_state=3).as_matrix()
    moved = replace(motion, rotations=left @ motion.rotations @ right)
    expected = smooth(motion, EVERY)
    expected = replace(expected, rotations=left @ expected.rotations @ right)
    assert degrees(smooth(moved, EVERY), expected).max() < 1e-3


def test_limbs_are_smoothed_by_their_own_gain():
    motion = noisy(swinging(4), 3.0)
    assert all(map(_limb, USER_JOINTS))
    changed = (smooth(motion, LimbSeconds(arms=0.05)).rotations != motion.rotations).any(axis=(0, 2, 3))
    assert {_limb(name) for name, each in zip(USER_JOINTS, changed, strict=True) if each} == {"arms"}
    options = CleanOptions(smooth="strong", seconds=LimbSeconds(arms=0.0), spikes=False)
    changed = (clean(motion, options=options).motion.rotations != motion.rotations).any(axis=(0, 2, 3))
    assert changed[USER_JOINTS.index("LeftLeg")]
    assert not changed[USER_JOINTS.index("LeftArm")]


@pytest.mark.parametrize("frame", [0, 1, 2, 20, FRAMES - 2, FRAMES - 1])
@pytest.mark.parametrize("angle", [40.0, 170.0])
def test_a_spike_in_one_frame_goes(frame, angle):
    true = swinging(5)
    joint, end = (7 * frame + 5) % 77, frame in (0, FRAMES - 1)
    spiked = turned(true, [frame], joint, angle, seed=frame)
    found, replaced = without_spikes(spiked)
    assert replaced == {USER_JOINTS[joint]: [frame]}
    left = 3 * LEFT_DEG if end else LEFT_DEG  # the pose beside it, a frame away
    assert degrees(true, found).max() < left
    assert degrees(true, smooth(found, EVERY))[:, joint].max() < left


def test_spikes_of_three_frames_and_close_to_each_other_go():
    calm = swinging(6, frequency=0.2)
    spiked = turned(turned(calm, [10, 11, 12], 13, 60.0), [30, 32, 35], 13, 40.0, seed=1)
    found, replaced = without_spikes(spiked)
    assert set(replaced) == {USER_JOINTS[13]}
    assert set(replaced[USER_JOINTS[13]]) >= {10, 11, 12, 30, 32, 35}
    assert degrees(calm, found).max() < LEFT_DEG


def test_a_path_that_leaps_for_a_frame_comes_back():
    motion = swinging(7)
    path = motion.translation.copy()
    path[25] += [0.4, 0.0, 0.1]
    found, replaced = without_spikes(replace(motion, translation=path))
    assert replaced == {"path": [25]}
    assert np.abs(found.translation - motion.translation).max() < 5e-3


def test_steps_quick_swings_and_noise_are_no_spikes():
    step = swinging(8, frequency=0.3)
    assert without_spikes(turned(step, list(range(30, FRAMES)), 13, 60.0))[1] == {}
    assert without_spikes(swinging(9, frequency=4.0))[1] == {}
    assert without_spikes(noisy(swinging(10), 3.0))[1] == {}


@pytest.mark.parametrize("fps", [24.0, 60.0, 120.0, 29.97])
def test_another_rate_keeps_the_motion_in_time(fps):
    motion = swinging(11)
    found = resample(motion, fps)
    expected = swinging(11, fps=fps, frames=found.frame_count)
    seconds = (motion.frame_count - 1) / FPS
    assert found.fps == fps
    assert seconds - 1 / fps < (found.frame_count - 1) / fps <= seconds + 1e-6
    assert degrees(found, expected).max() < 1.5  # the sagitta of a swing of 30 degrees over 1/30 s is 0.2
    assert np.abs(found.translation - expected.translation)[3:-3].max() < 1e-4
    assert found.contacts.shape == (found.frame_count, 4)


def test_its_own_rate_changes_nothing_and_twice_as_many_frames_hold_the_old_ones():
    motion = swinging(12)
    assert resample(motion, FPS) is motion
    double = resample(motion, 2 * FPS).cut(slice(None, None, 2))
    assert degrees(motion, double).max() < 1e-3
    assert (double.contacts == motion.contacts).all()
    for bad in (0.0, -30.0, np.nan):
        with pytest.raises(InputError, match=str(bad)):
            resample(motion, bad)


@pytest.mark.parametrize("convention", ["t_pose_relative", "absolute_local"])
def test_mirrored_twice_is_the_motion(convention):
    rest = np.random.default_rng(0).random((4505, 3))
    motion = replace(swinging(13), convention=convention, identity={"backend": "soma", "rest": rest})
    once = mirror(motion)
    twice = mirror(once)
    rounding = 0 if convention == "t_pose_relative" else 1e-6
    assert np.abs(twice.rotations - motion.rotations).max() <= rounding
    for name in ("translation", "contacts", "skeleton"):
        assert (getattr(twice, name) == getattr(motion, name)).all()
        assert (getattr(once, name) != getattr(motion, name)).any()
    assert (twice.identity["rest"] == rest).all()
    assert not np.allclose(once.identity["rest"], rest)


@pytest.mark.parametrize("convention", ["t_pose_relative", "absolute_local"])
def test_joints_of_the_mirrored_motion_are_the_mirror_image(convention):
    motion = replace(swinging(14), convention=convention)
    other = [USER_JOINTS.index(_other(name)) for name in USER_JOINTS]
    image = joint_places(motion)[:, other] * [-1, 1, 1]
    assert 1e3 * np.abs(joint_places(mirror(motion)) - image).max() < MIRROR_MM


def _other(name: str) -> str:
    return name.replace("Left", "#").replace("Right", "Left").replace("#", "Right")


def test_skin_of_the_mirrored_motion_is_the_mirror_image():
    layer = SomaLayer("soma", lod="low", correctives=None, dtype=torch.float64)
    motion = swinging(15, frames=4)
    body = layer.identity({"shape": torch.linspace(-2, 2, 8, dtype=torch.float64)})
    image = mirrored_body(layer, body)

    def posed(shown, moved):
        values = (torch.as_tensor(each).double() for each in (moved.rotations, moved.translation))
        return layer.pose(shown, *values).vertices.numpy()

    expected = posed(body, motion)[:, layer.mesh.mirror] * [-1, 1, 1]
    rig = layer.rig
    weights = rig.weights.toarray()
    columns = [rig.joint_names.index(_other(name)) for name in rig.joint_names]
    even = np.abs(weights[layer.mesh.mirror][:, columns] - weights).max(axis=1) < SYMMETRIC
    assert even.mean() > 0.9
    error = 1e3 * np.linalg.norm(posed(image, mirror(motion)) - expected, axis=-1)
    assert error[:, even].max() < MIRROR_MM
    assert torch.equal(mirrored_body(layer, image).rest, body.rest)


def test_the_order_is_spikes_smoothing_rate_mirror():
    motion = turned(noisy(swinging(16), 0.5), [20], 13, 40.0)
    found = clean(motion, options=CleanOptions(rate=15.0, mirror=True))
    by_hand = mirror(resample(clean(motion).motion, 15.0))
    assert (found.motion.rotations == by_hand.rotations).all()
    assert found.report["spikes"] == {USER_JOINTS[13]: [20]}
    assert found.report["frames"] == {"before": FRAMES, "after": FRAMES // 2}
    assert found.report["after"]["jitter_m_s3"] < found.report["before"]["jitter_m_s3"]


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5])
def test_short_clips_are_cleaned_too(frames):
    motion = swinging(17, frames=frames)
    found = clean(motion, options=CleanOptions(smooth="strong", rate=60, mirror=True))
    assert found.motion.frame_count == 2 * frames - 1
    assert np.isfinite(found.motion.rotations).all()


def test_the_report_tells_sliding_feet_and_joints_beyond_their_range():
    frames = 30
    still = Motion(
        rotations=np.tile(np.eye(3), (frames, 77, 1, 1)), translation=np.tile([0.0, 1.0, 0.0], (frames, 1)),
        fps=FPS, joint_names=USER_JOINTS,
    )  # fmt: skip
    sliding = still.translation + np.linspace(0, 0.1, frames)[:, None] * [1.0, 0, 0]
    speed = 100.0 / (frames - 1) * FPS
    quality = motion_quality(replace(still, translation=sliding))
    assert quality["foot_slide_mm_s"] == pytest.approx(speed, rel=1e-3)
    assert quality["foot_contacts"] == 1
    assert motion_quality(still)["jitter_m_s3"] == 0
    knee = USER_JOINTS.index("LeftShin")
    rotations = still.rotations.copy()
    rotations[:15, knee] = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    found = motion_quality(replace(still, rotations=rotations))["joint_range"]
    assert found["LeftShin"]["share"] == 0.5
    assert "RightShin" not in found


@pytest.mark.parametrize("name", ["01_single_text_prompt", "03_full_body_keyframes", "06_root_waypoints"])
def test_feet_slide_alike_whether_the_file_says_when_they_stand(name):
    file = Path(os.environ.get("SOMA_TEST_DATA", "")) / "motions" / f"kimodo_{name}.npz"
    if not file.is_file():
        pytest.skip(f"needs SOMA_TEST_DATA with {file}")
    motion = load_clip(file)
    told, found = motion_quality(motion), motion_quality(replace(motion, contacts=None))
    assert found["foot_slide_mm_s"] == pytest.approx(told["foot_slide_mm_s"], rel=0.25)
    assert found["foot_contacts"] == pytest.approx(told["foot_contacts"], abs=0.08)


def test_absolute_rotations_are_read_as_such():
    rig = load_canonical("mid")[1]
    motion = swinging(18)
    own, above = rig.t_pose_world[1:, :3, :3], rig.t_pose_world[rig.parents[1:], :3, :3]
    absolute = replace(
        motion, rotations=np.swapaxes(above, -1, -2) @ motion.rotations @ own, convention="absolute_local"
    )
    assert np.abs(relative_rotations(absolute) - motion.rotations).max() < 1e-5


@pytest.mark.parametrize(("changes", "value"), [({"rate": 0.0}, "0.0"), ({"rate": -5.0}, "-5.0")])
def test_rates_that_are_none_are_refused(changes, value):
    with pytest.raises(InputError, match=value):
        CleanOptions(**changes)
    with pytest.raises(InputError, match=r"seconds.arms.*-0\.1"):
        LimbSeconds(arms=-0.1)
