"""Files of every kind in one folder, and motions that take the way through another format and back."""

from __future__ import annotations

import json
import os
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from soma_core import SomaLayer, load_canonical
from soma_core.cli import EXIT_FAILED, main
from soma_core.io.bvh import write_bvh
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.skeleton_files import read_skeleton
from soma_core.motion import (
    FrameRange,
    convert,
    convert_file,
    convert_people,
    load_clip,
    read,
    write,
    write_body,
)
from soma_core.motion.retargeting import retarget
from tests.fbx_files import write_fbx
from tests.io.smpl_layouts import TURNS, save_joblib, save_npy, save_pt, smplx_names, wham
from tests.motion.test_retarget import MIXAMO, SAME_DEGREES, bones_apart
from tests.skeletons import biped, moved, write_vrm

DATA = Path(os.environ.get("SOMA_TEST_DATA", ""))
REVISION_DEGREES = 8  # tips of fingers, the shortest bones
EXACT = 1e-5  # seven decimals of degrees in a file, and float32 rotations

_SIDED = {
    "collar": "Shoulder", "arm": "UpperArm", "elbow": "LowerArm", "wrist": "Hand", "thigh": "UpperLeg",
    "knee": "LowerLeg", "ankle": "Foot", "toe": "Toes", "finger1": "MiddleProximal",
    "finger2": "MiddleIntermediate",
}  # fmt: skip
VRM = {"hips": "hips", "spine": "spine chest upperChest", "neck": "neck", "head": "head"}
VRM |= {part: f"*{name}" for part, name in _SIDED.items()}
HUMAN = {name: name[0].lower() + name[1:] for name in biped(VRM)[0]}


def turned(frames=3, seed=0):
    return moved(*biped(MIXAMO), frames=frames, seed=seed)


@pytest.mark.parametrize("version", [0, 1])
def test_a_vrm_tells_its_joints_by_the_bones_of_a_human(version, tmp_path):
    motion = moved(*biped(VRM), seed=6)
    write_vrm(motion, tmp_path / "avatar.vrm", HUMAN, version=version)
    found = read_skeleton(tmp_path / "avatar.vrm")
    places = [found.names.index(HUMAN[name]) for name in motion.names]
    np.testing.assert_allclose(found.positions()[:, places], motion.positions(), atol=EXACT)
    np.testing.assert_allclose(found.rest[places], motion.rest, atol=EXACT)
    carried = retarget(found, match="bones")
    assert {"spine", "chest", "upperChest"} == set(carried.report["spine"])
    assert not carried.report["not_carried"]
    apart = bones_apart(found, carried, load_canonical("mid")[1])
    assert max(apart.values()) < SAME_DEGREES, apart


@pytest.fixture
def clips(tmp_path):
    """A folder of every kind that needs no model, and of what cannot be read."""
    folder = tmp_path / "clips"
    folder.mkdir()
    clip, skeleton = load_clip(frames=FrameRange(stop=2)), turned()
    write(clip, folder / "soma.npz")
    turns = np.tile(np.eye(3), (2, 3, 30, 1, 1))
    np.savez(folder / "kimodo.npz", local_rot_mats=turns, root_positions=np.tile([0, 1.0, 0], (2, 3, 1)))
    body = {"global_orient": np.zeros((3, 3)), "body_pose": np.zeros((3, 228)), "transl": np.zeros((3, 3))}
    save_pt(folder / "gem_x.pt", {"body_params_global": body})
    write_bvh(skeleton, folder / "mixamo.bvh")
    write_vrm(moved(*biped(VRM), frames=2), folder / "avatar.vrm", HUMAN)
    layer = SomaLayer("soma", lod="low")
    for name in ("body.glb", "body.usdc"):
        write_body(folder / name, layer, layer.identity(), clip)
    if find_spec("ufbx"):
        write_fbx(skeleton, folder / "mixamo.fbx", skin=True)
    names = smplx_names(TURNS)
    np.savez(folder / "smplx.npz", **names)
    save_npy(folder / "smplx.npy", names)
    save_pt(folder / "hmr4d_results.pt", {"smpl_params_global": names})
    save_joblib(folder / "wham_output.pkl", wham())
    np.savez(folder / "shape.npz", betas=np.zeros(16), gender="male")
    np.savez(folder / "vertices.npz", vertices=np.zeros((2, 5, 3)))
    np.savez(folder / "strange.npz", my_poses=np.zeros((2, 72)))
    (folder / "page.npz").write_bytes(b"<html></html>")
    (folder / "empty.bvh").write_bytes(b"")
    strange = {part: f"b{number}*" for number, part in enumerate(MIXAMO)} | {"spine": "s0 s1 s2"}
    write_bvh(moved(*biped(strange)), folder / "unknown.bvh")
    (folder / "notes.txt").write_text("of no kind")
    return folder


@pytest.mark.slow
def test_one_command_converts_a_folder_of_every_kind(clips, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = [f"input={clips}", "out=done", "carry=skeleton", "fps=30", "person=all", "picture.frames=0"]
    assert main(["convert", *command]) == EXIT_FAILED
    rows = json.loads((tmp_path / "done/report.json").read_text())["files"]
    reasons = {
        "shape.npz": ("skipped", "the keys betas, gender"), "vertices.npz": ("skipped", "vertices"),
        "strange.npz": ("failed", "my_poses"), "page.npz": ("failed", "not an NPZ file"),
        "empty.bvh": ("failed", "empty"), "unknown.bvh": ("failed", "mapping=FILE"),
    }  # fmt: skip
    for name, (state, reason) in reasons.items():
        assert rows[name]["state"] == state, name
        assert reason in rows[name]["reason"], name
    others = {name: row["state"] for name, row in rows.items() if name not in reasons}
    failed = {name: rows[name] for name, state in others.items() if state != "converted"}
    assert not failed
    of_file = {name.partition("/")[0] for name in others}
    assert of_file == {file.name for file in clips.iterdir()} - {*reasons, "notes.txt"}
    assert {"kimodo.npz/0", "kimodo.npz/1"} <= set(others)
    for name in others:
        assert read(tmp_path / "done/motions" / f"{name.removesuffix('.npz')}.npz").fps > 0


def test_every_sample_of_a_batch_has_a_folder(tmp_path):
    turns = np.tile(np.eye(3), (2, 3, 77, 1, 1))
    places = np.stack([np.tile([0, 1.0, 0], (3, 1)), np.tile([0.5, 1.0, 0], (3, 1))])
    np.savez(tmp_path / "batch.npz", local_rot_mats=turns, root_positions=places)
    found = convert_people(tmp_path / "batch.npz", tmp_path / "out")
    assert list(found) == ["0", "1"]
    assert [float(each.motion().translation[0, 0]) for each in found.values()] == [0, 0.5]


def test_a_clip_of_another_skeleton_is_played(tmp_path):
    write_bvh(turned(frames=6), tmp_path / "walk.bvh")
    clip = load_clip(tmp_path / "walk.bvh", frames=FrameRange(start=2, step=2))
    whole = convert(tmp_path / "walk.bvh")
    np.testing.assert_array_equal(clip.rotations, whole.rotations[2::2])
    assert clip.fps == whole.fps / 2


@pytest.mark.parametrize("name", ["01_single_text_prompt", "03_full_body_keyframes", "06_root_waypoints"])
def test_clips_of_kimodo_come_back_through_bvh(name, tmp_path):
    file = DATA / "motions" / f"kimodo_{name}.npz"
    if not file.is_file():
        pytest.skip(f"needs SOMA_TEST_DATA with {file}")
    motion, rig = read(file).cut(slice(0, 40)), load_canonical("mid")[1]
    write_bvh(motion, tmp_path / "clip.bvh", rig=rig, order="ZYX")
    found = convert_file(tmp_path / "clip.bvh", tmp_path / "out").motion()
    assert np.abs(found.rotations - motion.rotations).max() < EXACT
    assert np.abs(found.translation - motion.translation).max() < 1e-6  # [m], nine decimals in a file
    assert found.fps == motion.fps


@pytest.mark.parametrize("name", ["soma_zero_frame0.bvh", "soma_base_skel_minimal.usd"])
def test_files_of_the_soma_retargeter_rest_as_the_rig_does(name):
    package = find_spec("soma_retargeter")
    if package is None:
        pytest.skip("needs eden-soma-retargeter")
    source = read_skeleton(Path(package.origin).parent / "configs/soma" / name)
    found = retarget(source, match="bones")
    assert found.report["not_carried"] == ["Root"]
    assert set(found.report["joints"].values()) <= set(USER_JOINTS)
    # A later revision of the rig: rotations carry over, and its bones lie some degrees elsewhere.
    shown = source.placed(np.eye(3), found.report["unit_metres"])
    assert max(bones_apart(shown, found, load_canonical("mid")[1]).values()) < REVISION_DEGREES


def test_the_small_file_of_lafan_is_read(tmp_path):
    file = DATA / "cases/18_lafan_like.bvh"
    if not file.is_file():
        pytest.skip(f"needs SOMA_TEST_DATA with {file}")
    done = convert_file(file, tmp_path / "out")
    source = read_skeleton(file)
    assert done.report["frames"] == source.frame_count
    assert set(done.report["joints"]) == {"Hips", "LeftLeg"}
    assert np.isfinite(done.motion().rotations).all()
