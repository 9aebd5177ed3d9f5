"""Questions to how a body moves: each mistake names the setting that mends it, and no clip is questioned."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core import SmplMotion, write_amass
from soma_core.errors import InputError
from soma_core.io import USER_JOINTS, Motion
from soma_core.io.bvh import write_bvh
from soma_core.io.joint_order import nearest_ancestors, other_side
from soma_core.io.skeleton_motion import soma_skeleton
from soma_core.motion import ConvertOptions, convert_file, load_clip, mirror, read, retarget, write
from soma_core.motion.movement import of_movement
from soma_core.motion.quality import joint_places, relative_rotations
from soma_core.rig import load_canonical

TURNS = ("rotation_layout", "swap_sides", "convention")
FPS, SECONDS = 30, 4
RECORDED = sorted(Path(os.environ.get("SOMA_TEST_DATA", "/nonexistent")).glob("motions/kimodo_*.npz"))


@pytest.fixture(scope="module")
def rig():
    return load_canonical("mid")[1]


def turned(vectors):
    return Rotation.from_rotvec(vectors).as_matrix()


@pytest.fixture(scope="module")
def walk() -> Motion:
    """Someone who walks with bent elbows, 1.8 steps a second, and whose feet stay where they stand."""
    time = np.arange(FPS * SECONDS) / FPS
    rotations = np.tile(np.eye(3), (len(time), 77, 1, 1))
    for side, sign in (("Left", 1), ("Right", -1)):
        swing = sign * np.sin(2 * np.pi * 0.9 * time)
        lift = np.maximum(sign * np.cos(2 * np.pi * 0.9 * time), 0)  # the leg that comes forward
        zero = 0 * time
        for part, vectors in {
            "Leg": [-0.4 * swing - 0.4 * lift, zero, zero],
            "Shin": [0.1 + 1.0 * lift, zero, zero],
            "Foot": [0.3 * swing - 0.5 * lift, zero, zero],
            "Arm": [0.3 * swing, zero, zero - sign * 1.2],
            "ForeArm": [zero, zero - sign * (0.8 + 0.2 * swing), zero],
        }.items():
            rotations[:, USER_JOINTS.index(side + part)] = turned(np.stack(vectors, axis=1))
    still = Motion(
        rotations=rotations, translation=np.zeros((len(time), 3)), fps=FPS, joint_names=USER_JOINTS
    )
    feet = joint_places(still)[:, [USER_JOINTS.index(f"{side}Foot") for side in ("Left", "Right")]]
    steps = np.diff(feet, axis=0)
    stands = ((feet[1:] + feet[:-1])[..., 1]).argmin(axis=1)
    path = np.cumsum(-steps[np.arange(len(steps)), stands], axis=0) * [1, 0, 1]
    return replace(still, translation=np.concatenate([[[0, 0, 0]], path]) + np.array([0, 0.9, 0]))


def locally(world):
    local = world.copy()
    for joint, parent in enumerate(nearest_ancestors(USER_JOINTS)):
        if parent >= 0:
            local[:, joint] = np.swapaxes(world[:, parent], -1, -2) @ world[:, joint]
    return local


def globally(motion):
    world = motion.rotations.astype(np.float64)
    for joint, parent in enumerate(nearest_ancestors(USER_JOINTS)):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ world[:, joint]
    return world


def swapped(motion):
    other = [USER_JOINTS.index(other_side(name)) for name in USER_JOINTS]
    return replace(motion, rotations=motion.rotations[:, other])


def clips(walk):
    return [walk, load_clip(), *map(read, RECORDED)]


def test_what_bodies_do_is_not_questioned(walk):
    for clip in clips(walk):
        jitter = np.random.default_rng(0).normal(0, 0.01, clip.translation.shape)
        for same in (
            clip, mirror(clip), clip.cut(slice(0, 1)), clip.cut(slice(5, 20)),
            replace(clip, fps=clip.fps / 2), replace(clip, translation=0 * clip.translation),
            replace(clip, translation=clip.translation + jitter),
            replace(clip, rotations=relative_rotations(clip), skeleton=None),
        ):  # fmt: skip
            assert of_movement(same, turns=TURNS) == []


def test_rotations_that_are_none_of_a_body_name_the_setting_that_mends_them(walk, rig):
    own, above = rig.t_pose_world[1:, :3, :3], rig.t_pose_world[rig.parents[1:], :3, :3]
    for clip in clips(walk):
        clip = replace(clip, rotations=relative_rotations(clip), convention="t_pose_relative")
        local = np.swapaxes(above, -1, -2) @ clip.rotations @ own
        world = locally(np.swapaxes(globally(clip), -1, -2))
        for wrong, mend in (
            (replace(clip, rotations=np.swapaxes(clip.rotations, -1, -2)), "rotation_layout=columns"),
            (replace(clip, rotations=world), "rotation_layout=columns"),
            (swapped(clip), "swap_sides=true"),
            (replace(clip, rotations=local), "convention=absolute_local"),
            (replace(clip, convention="absolute_local"), "convention=t_pose_relative"),
        ):  # fmt: skip
            (said,) = of_movement(wrong, turns=TURNS)
            assert said.endswith(f"pass {mend}"), said
            (said,) = of_movement(wrong)
            assert said.endswith("export it again"), said


@pytest.mark.parametrize(("unit", "metres"), [("inch", 0.0254), ("ft", 0.3048), ("cm", 0.01)])
def test_a_path_in_another_unit_than_the_steps_is_named(walk, unit, metres):
    (said,) = of_movement(replace(walk, translation=walk.translation / metres), unit="motion_unit")
    assert said.endswith(f"pass motion_unit={unit}"), said


def test_a_path_at_another_rate_than_the_steps_is_named(walk):
    (said,) = of_movement(replace(walk, translation=2 * walk.translation))
    assert "2 times as long as its feet walk; if path and rotations were sampled at other rates" in said
    slow = replace(walk, translation=walk.translation / 2)
    assert of_movement(slow) == []  # legs may be twice as long as the rig's, where the file does not tell
    offsets = np.diff(joint_places(walk)[0][[0, 0]], axis=0).repeat(77, 0) + np.nan
    assert "0.5 times as long" in of_movement(replace(slow, skeleton=offsets))[0]


def test_a_rate_at_which_no_feet_could_push_is_named(walk):
    sway = 0.1 * np.sin(np.pi * np.arange(len(walk.translation)) / FPS)
    swaying = replace(walk, translation=sway[:, None] * [1, 0, 0] + [0, 0.9, 0])
    assert of_movement(swaying) == []
    (said,) = of_movement(replace(swaying, fps=4 * FPS), fps="motion_fps")
    assert said.startswith("at 120 frames a second no feet could push a body so")
    assert said.endswith("pass motion_fps=30 (the true rate)")


def test_frames_that_repeat_are_named_with_their_rate(walk):
    for rate, frames in ((15, np.arange(120) // 2), (24, np.floor(np.arange(120) * 0.8).astype(int))):
        (said,) = of_movement(walk.cut(frames))
        assert said.endswith(f"soma clean rate={rate} takes them out")
    held = np.concatenate([np.arange(40), np.full(30, 40), np.arange(40, 90)])
    assert not any("repeat" in said for said in of_movement(walk.cut(held)))  # a pose may be held
    (said,) = of_movement(walk.cut(np.zeros(40, int)))
    assert said.startswith("its 40 frames hold one pose; if it should move")
    assert "while its hips move" in of_movement(replace(walk, rotations=0 * walk.rotations + np.eye(3)))[0]


def test_files_come_back_with_the_settings_that_their_questions_name(walk, tmp_path):
    write(walk, tmp_path / "own.npz")
    write(replace(walk, rotations=np.swapaxes(walk.rotations, -1, -2)), tmp_path / "columns.npz")
    write(swapped(walk), tmp_path / "swapped.npz")
    world, path = globally(walk), walk.translation
    np.savez(tmp_path / "kimodo.npz", global_rot_mats=np.swapaxes(world, -1, -2), root_positions=path)
    for name, options in {
        "own": {}, "columns": {"rotation_layout": "columns"}, "kimodo": {"rotation_layout": "columns"},
        "swapped": {"swap_sides": True},
    }.items():  # fmt: skip
        if options:
            (said,) = convert_file(tmp_path / f"{name}.npz", tmp_path / f"{name}_out").report["warnings"]
            assert next(iter(options)) in said
        found = convert_file(tmp_path / f"{name}.npz", tmp_path / name, options=ConvertOptions(**options))
        assert found.report["warnings"] == []
        np.testing.assert_allclose(found.motion().rotations, walk.rotations, atol=1e-6)
    with pytest.raises(InputError, match="rotation_layout: got wxyz, expected rows or columns"):
        read(tmp_path / "own.npz", rotation_layout="wxyz")


def test_joints_of_kimodo_tell_matrices_by_columns(walk, tmp_path, caplog):
    turns = np.swapaxes(walk.rotations, -1, -2)
    arrays = {"root_positions": walk.translation, "posed_joints": joint_places(walk)}
    np.savez(tmp_path / "a.npz", local_rot_mats=turns, **arrays)
    read(tmp_path / "a.npz")
    assert "posed_joints do not fit the rotations" in caplog.text
    assert "pass rotation_layout=columns" in caplog.text
    caplog.clear()
    assert read(tmp_path / "a.npz", rotation_layout="columns").skeleton is not None
    assert not caplog.text


def test_sides_of_other_skeletons_are_exchanged(walk, rig, tmp_path):
    """Names of a BVH, and joints of the SMPL family without its model."""
    source = soma_skeleton(walk, rig)
    write_bvh(replace(source, names=tuple(map(other_side, source.names))), tmp_path / "a.bvh")
    right = retarget(source).motion
    wrong = convert_file(tmp_path / "a.bvh", tmp_path / "wrong").report["warnings"]
    assert any("swap_sides=true" in said for said in wrong)
    found = convert_file(tmp_path / "a.bvh", tmp_path / "a", options=ConvertOptions(swap_sides=True))
    assert not any("swap_sides" in said for said in found.report["warnings"])
    np.testing.assert_allclose(found.motion().rotations, right.rotations, atol=1e-4)

    poses = np.zeros((len(walk.translation), 52, 3), np.float32)
    for smpl, joint in ((4, "LeftShin"), (5, "RightShin"), (18, "LeftForeArm"), (19, "RightForeArm")):
        poses[:, smpl] = Rotation.from_matrix(walk.rotations[:, USER_JOINTS.index(joint)]).as_rotvec()
    poses[:, [22, 37], 2] = [-0.5, 0.3]
    poses[:, 0] = [np.pi / 2, 0, 0]
    kind = {"model": "smplh", "betas": np.zeros(10), "gender": "neutral", "fps": FPS}
    path = walk.translation[:, [2, 0, 1]]
    order = [0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20]
    order += [*range(37, 52), *range(22, 37)]
    for name, values in {"right": poses, "sides": poses[:, order], "columns": -poses}.items():
        write_amass(SmplMotion(rotations=values, translation=path, **kind), tmp_path / f"{name}.npz")
    options = {"right": {}, "sides": {"swap_sides": True}, "columns": {"rotation_layout": "columns"}}
    motions = {
        name: convert_file(
            tmp_path / f"{name}.npz", tmp_path / name, options=ConvertOptions(carry="skeleton", **chosen)
        )
        for name, chosen in options.items()
    }
    for name in ("sides", "columns"):
        np.testing.assert_allclose(
            motions[name].motion().rotations, motions["right"].motion().rotations, atol=1e-5
        )
        plain = ConvertOptions(carry="skeleton")
        said = convert_file(tmp_path / f"{name}.npz", tmp_path / f"{name}_out", options=plain).report[
            "warnings"
        ]
        mend = "swap_sides=true" if name == "sides" else "rotation_layout=columns"
        assert any(mend in text for text in said) or name == "columns", said


@pytest.mark.parametrize(("unit", "mend"), [(1, ""), (0.3048, "unit=ft")], ids=["metres", "feet"])
def test_smpl_without_its_model_is_asked_how_it_walks(walk, unit, mend, tmp_path):
    """Whose legs are not known: they may be a fifth shorter."""
    poses = np.zeros((len(walk.translation), 52, 3))
    joints = ("Leg", "Shin", "Foot", "Arm", "ForeArm")
    for first, part in zip((1, 4, 7, 16, 18), joints, strict=True):
        for smpl, side in ((first, "Left"), (first + 1, "Right")):
            turns = walk.rotations[:, USER_JOINTS.index(side + part)]
            poses[:, smpl] = Rotation.from_matrix(turns).as_rotvec()
    poses[:, 0] = Rotation.from_euler("xz", [90, 90], degrees=True).as_rotvec()
    path = 0.8 * walk.translation[:, [2, 0, 1]] / unit
    kind = {"model": "smplh", "betas": np.zeros(10), "gender": "female", "fps": FPS}
    write_amass(SmplMotion(rotations=poses, translation=path, **kind), tmp_path / "a.npz")
    said = convert_file(tmp_path / "a.npz", tmp_path / "out", options=ConvertOptions(carry="skeleton"))
    others = [text for text in said.report["warnings"] if "betas are not read" not in text]
    assert len(others) == bool(mend), others
    assert all(mend in text for text in others)
