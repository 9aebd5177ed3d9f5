"""One file to a motion of this skeleton: what is carried over, what is fitted, and what is refused."""

from __future__ import annotations

import json
import logging
from typing import get_args

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core import SomaLayer, load_canonical
from soma_core.errors import InputError
from soma_core.io import USER_JOINTS, Motion, read_motion, write_motion
from soma_core.io.skeleton_motion import soma_skeleton
from soma_core.motion import ConvertOptions, convert_file, converter, fit_job, layout_of
from soma_core.motion.bodies import FITTED
from soma_core.motion.files import Layout
from soma_core.plugin.declaration import CORE_LAYOUTS
from soma_core.plugin.errors import BackendError
from soma_core.plugin.registry import default_registry
from tests.motion.conftest import AMASS_FRAMES

FIT_MM = 3.0
"""Mean distance of a fit to the stand-in, whose pose blend shapes are noise of about that size."""

CARRIED_DEGREES = 15.0
"""Angle of a limb that is carried over to the same limb fitted, in any frame: what rest poses leave open."""

Z_UP_TO_Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def converted(path, folder, **changes):
    return convert_file(path, folder, options=ConvertOptions(lod="low", **changes))


def motion(frames=3, **changes):
    turns = Rotation.random(77 * frames, random_state=0).as_matrix().reshape(frames, 77, 3, 3)
    values = {"rotations": turns, "translation": np.ones((frames, 3)), "fps": 24, "joint_names": USER_JOINTS}
    return Motion(**values | changes)


def test_no_plugin_takes_the_name_of_a_layout():
    assert {*get_args(Layout), *FITTED} == CORE_LAYOUTS


def test_our_own_file_is_carried_over_exactly(tmp_path):
    given = motion(identity={"backend": "soma", "params": {"shape": [1.0]}}, licence="CC0-1.0")
    write_motion(given, tmp_path / "m.npz")
    found = converted(tmp_path / "m.npz", tmp_path / "out")
    again = read_motion(tmp_path / "out/motion.npz")
    np.testing.assert_array_equal(again.rotations, given.rotations)
    np.testing.assert_array_equal(again.translation, given.translation)
    assert (again.identity, again.licence, again.fps) == (given.identity, "CC0-1.0", 24)
    assert str(found) == "soma, 3 frames at 24 fps, rotations carried over"
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report == found.report
    assert report["identity"] == "soma"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["motion.npz", "report.json"]


def test_a_file_of_soma_tools_comes_to_metres(tmp_path):
    turns = motion().rotations
    np.savez(
        tmp_path / "m.npz", poses=turns, transl=np.full((3, 3), 150.0), unit="centimeters",
        joint_names=np.array(USER_JOINTS), absolute_pose=False, joint_orient=np.tile(np.eye(3), (77, 1, 1)),
        identity_model_type="mhr", identity_coeffs=np.ones((1, 45)), scale_params=np.ones((1, 68)),
    )  # fmt: skip
    with pytest.raises(InputError, match=r"fps: got no frame rate.*Pass fps=30"):
        converted(tmp_path / "m.npz", tmp_path / "out")
    converted(tmp_path / "m.npz", tmp_path / "out", fps=50)
    again = read_motion(tmp_path / "out/motion.npz")
    np.testing.assert_array_equal(again.rotations, turns)
    np.testing.assert_allclose(again.translation, 1.5)
    assert again.fps == 50
    assert sorted(again.identity) == ["backend", "identity_coeffs", "scale_params"]  # and no default body
    np.testing.assert_array_equal(again.identity["scale_params"], np.ones((1, 68)))
    converted(tmp_path / "m.npz", tmp_path / "mm", fps=50, unit="mm")
    np.testing.assert_allclose(read_motion(tmp_path / "mm/motion.npz").translation, 0.15)


def test_a_kimodo_file_is_carried_over(tmp_path):
    turns, places = motion().rotations, np.random.default_rng(0).random((3, 3))
    np.savez(tmp_path / "m.npz", local_rot_mats=turns, root_positions=places)
    converted(tmp_path / "m.npz", tmp_path / "out")
    again = read_motion(tmp_path / "out/motion.npz")
    np.testing.assert_allclose(again.rotations, turns, atol=1e-6)
    np.testing.assert_allclose(again.translation, places, atol=1e-6)
    assert again.fps == 30


def posed_smplh(amass):
    """Vertices of the stand-in [m], turned to +y up."""
    cpu = torch.device("cpu")
    generator = default_registry().generator(
        "smplh", device=cpu, dtype=torch.float32, options={"gender": "female"}
    )
    single = {name: torch.as_tensor(np.asarray(amass[name])).float() for name in ("poses", "trans", "betas")}
    pose = {"rotations": single["poses"].unflatten(1, (52, 3)), "translation": single["trans"]}
    with torch.no_grad():
        posed = generator.posed({"betas": single["betas"][None, :3]}, pose).numpy()
    return posed @ Z_UP_TO_Y_UP.T


def test_an_amass_motion_is_posed_by_its_own_model_and_fitted(smplh_models, amass, amass_file, tmp_path):
    found = converted(amass_file, tmp_path / "out", chunk=4)
    assert found.error_mm["mean"] < FIT_MM
    assert str(found).startswith(f"amass, {AMASS_FRAMES} frames at 60 fps, fitted with an error of mean ")
    motion = read_motion(tmp_path / "out/motion.npz")
    body = {"backend": "smplh", "params": {"betas": [0.5, -1.0, 0.0]}, "options": {"gender": "female"}}
    assert motion.identity == body
    assert (motion.fps, motion.frame_count) == (60, AMASS_FRAMES)
    assert motion.licence.startswith("that of walk_poses.npz; body model: non-commercial")
    layer = SomaLayer("smplh", options=body["options"], lod="low")
    rotations, hips = torch.as_tensor(motion.rotations), torch.as_tensor(motion.translation)
    with torch.no_grad():
        vertices = layer.pose(layer.identity(body["params"]), rotations, hips).vertices.numpy()
    target = posed_smplh(amass)  # another mesh: compare where its middle is and how tall it stands
    np.testing.assert_allclose(vertices.max(1), target.max(1), atol=0.03)
    np.testing.assert_allclose(vertices.min(1), target.min(1), atol=0.03)
    names = ["frames.npz", "motion.npz", "report.json"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names


@pytest.mark.slow
def test_what_was_fitted_before_is_left_alone(smplh_models, amass, amass_file, tmp_path, monkeypatch):
    fits = []
    original = converter.FitJob.fit_missing
    monkeypatch.setattr(converter.FitJob, "fit_missing", lambda job: fits.append(original(job)))
    first = converted(amass_file, tmp_path / "out")
    again = converted(amass_file, tmp_path / "out")
    assert (first.earlier, again.earlier, len(fits)) == (False, True, 1)
    assert again.report == first.report
    assert str(again).endswith("mm (by an earlier run)")
    with pytest.raises(InputError, match=r"up: got '\+y', expected '\+z', as in the run that .*report\.json"):
        converted(amass_file, tmp_path / "out", up="y")
    report = tmp_path / "out/report.json"
    report.write_text(report.read_text()[:100])
    assert not converted(amass_file, tmp_path / "out").earlier
    np.savez(amass_file, **amass | {"mocap_framerate": 30.0})
    anew = converted(amass_file, tmp_path / "out")
    assert (anew.earlier, anew.report["settings"]["fps"]) == (False, 30)


def test_a_stopped_conversion_goes_on(smplh_models, amass_file, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    original, saved = fit_job.FittedChunks.save, []

    def save(chunks, number, arrays):
        original(chunks, number, arrays)
        saved.append(number)
        if len(saved) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(fit_job.FittedChunks, "save", save)
    with pytest.raises(KeyboardInterrupt):
        converted(amass_file, tmp_path / "out", chunk=2)
    converted(amass_file, tmp_path / "out", chunk=2)
    assert saved == [0, 1, 2]
    assert "going on after 2 of 3 chunks" in caplog.text


def test_betas_beyond_the_model_are_refused_or_left_out(smplh_models, amass, tmp_path):
    np.savez(tmp_path / "m.npz", **amass | {"betas": np.ones(16)})
    said = r"m\.npz: betas: got 16 coefficients, expected at most 3.*Pass most_betas=3"
    with pytest.raises(InputError, match=said):
        converted(tmp_path / "m.npz", tmp_path / "out")
    converted(tmp_path / "m.npz", tmp_path / "out", most_betas=2, fps=1)
    motion = read_motion(tmp_path / "out/motion.npz")
    assert (motion.identity["params"], motion.fps) == ({"betas": [1.0, 1.0]}, 1)


def test_a_gender_without_a_model_is_said(smplh_models, amass_file, tmp_path):
    with pytest.raises(BackendError, match="no male SMPL-H model is there; there are female"):
        converted(amass_file, tmp_path / "out", gender="male")


def test_a_world_with_another_axis_up_is_noticed(smplh_models, amass_file, tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    converted(amass_file, tmp_path / "z")
    assert not caplog.text
    converted(amass_file, tmp_path / "y", up="y")
    said = (
        "walk_poses.npz: the body is lying on the whole, its head along z of the file; if that is not its "
        "pose, pass up=z"
    )
    assert said in caplog.text
    report = json.loads((tmp_path / "y/report.json").read_text())
    assert report["warnings"] == [said]


@pytest.mark.parametrize(
    ("keys", "layout"),
    [
        ({"poses": 0, "transl": 0}, "soma"),
        ({"schema_version": 1}, "soma"),
        ({"global_rot_mats": 0, "posed_joints": 0}, "kimodo"),
        ({"poses": 0, "trans": 0}, "amass"),
        ({"pose_body": 0, "trans": 0, "root_orient": 0}, "amass"),
        ({"pred_vertices": 0}, "sam3d"),
        ({"betas": 0, "gender": "male"}, None),
    ],
)
def test_layouts_are_told_apart_by_their_keys(tmp_path, keys, layout):
    np.savez(tmp_path / "m.npz", **keys)
    assert layout_of(tmp_path / "m.npz") == layout


def test_a_file_without_a_motion_is_refused(tmp_path):
    np.savez(tmp_path / "shape.npz", betas=np.zeros(16))
    with pytest.raises(
        InputError, match=r"shape\.npz: got the keys betas, expected poses, or .*pred_vertices"
    ):
        converted(tmp_path / "shape.npz", tmp_path / "out")


def test_an_array_without_keys_is_sent_where_arrays_are_read(tmp_path):
    np.save(tmp_path / "joints.npy", np.zeros((3, 22, 3)))
    with pytest.raises(
        InputError, match=r"got one array \(3, 22, 3\), .*\. Vertices over .*points=NAME is for"
    ):
        converted(tmp_path / "joints.npy", tmp_path / "out")


def test_without_the_model_the_joints_are_carried_over(
    smplh_models, amass_file, tmp_path, monkeypatch, caplog
):
    fitted = converted(amass_file, tmp_path / "fitted", chunk=4).motion()
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path / "no models"))
    with pytest.raises(BackendError, match="Or pass carry=skeleton"):
        converted(amass_file, tmp_path / "none")
    carried = converted(amass_file, tmp_path / "carried", carry="skeleton").motion()
    assert "betas are not read" in caplog.text
    worlds = []
    for each in (fitted, carried):
        skeleton = soma_skeleton(each, load_canonical("low")[1])
        worlds.append(skeleton.turns())
    cosine = (np.einsum("fjab,fjab->fj", *worlds) - 1) / 2
    apart = np.degrees(np.arccos(cosine.clip(-1, 1)))
    limbs = [
        USER_JOINTS.index(side + part)
        for side in ("Left", "Right")
        for part in ("Arm", "ForeArm", "Leg", "Shin")
    ]
    assert apart[:, limbs].max() < CARRIED_DEGREES
