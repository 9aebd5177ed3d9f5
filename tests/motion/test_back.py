"""The way back: pose parameters in the layout of AMASS, vertices of another model, and there again."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from soma_core import SomaLayer
from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.io import open_vertex_sequence, write_motion
from soma_core.io.smpl_files import read_amass
from soma_core.motion import BackendChoice, back
from tests.motion.conftest import AMASS_FRAMES
from tests.motion.test_converter import converted, motion, posed_smplh

THERE_AND_BACK_MM = 5.0
"""Mean distance after two fits to stand-ins: each skin bends in a way of its own."""

NATIVE_FIT_MM = 3.0
"""Root mean square error of the T-pose that comes back: the toy's mesh is coarser than ours."""


@pytest.fixture(scope="session")
def fitted(smplh_supplied, amass, tmp_path_factory):
    """The AMASS motion on this skeleton, with the body that it is of."""
    folder = tmp_path_factory.mktemp("fitted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOMA_DATA_DIR", str(smplh_supplied))
        patch.setenv("SOMA_CACHE_DIR", str(smplh_supplied / "cache"))
        np.savez(folder / "walk_poses.npz", **amass)
        converted(folder / "walk_poses.npz", folder)
    return folder / "motion.npz"


def test_an_amass_motion_comes_back(smplh_models, fitted, amass, tmp_path):
    found = converted(fitted, tmp_path, to="smplh", chunk=4)
    again = read_amass(tmp_path / "motion.npz")
    assert (again.model, again.gender, again.fps, again.up) == ("smplh", "female", 60, "+z")
    np.testing.assert_array_equal(
        again.betas, np.float32([0.5, -1.0, *[0] * 8])
    )  # ten, which every tool takes
    shown = {"poses": again.rotations.reshape(AMASS_FRAMES, -1), "trans": again.translation}
    distance = np.linalg.norm(posed_smplh(amass | shown) - posed_smplh(amass), axis=-1)
    assert 1e3 * distance.mean() < THERE_AND_BACK_MM
    assert found.report["frames"] == AMASS_FRAMES
    assert found.report["unusable_frames"] == 0
    regions = found.report["error_mm"]
    assert list(regions)[:5] == ["all", "body", "hands", "feet", "head"]
    assert regions["all"]["max"] == max(regions[name]["max"] for name in ("body", "hands", "feet", "head"))
    assert 0 < found.error_mm["median"] < found.error_mm["p95"] < found.error_mm["max"]
    with np.load(tmp_path / "frames.npz") as frames:
        assert 1e3 * frames["mean_error"].mean() == pytest.approx(found.error_mm["mean"], rel=1e-3)
    assert not (tmp_path / "chunks").exists()
    assert converted(fitted, tmp_path, to="smplh", chunk=4).earlier


@pytest.mark.slow
def test_an_unknown_body_is_found_once(smplh_models, fitted, tmp_path, monkeypatch):
    """Somebody of another backend: betas are sought, and a stopped run does not seek them again."""
    searches, saves = [], []
    search, save = back.NativeFit.fit_params, back.FittedChunks.save
    monkeypatch.setattr(
        back.NativeFit,
        "fit_params",
        lambda *given: searches.append(1) or search(*given, iterations=2),
    )

    def stopping(chunks, number, arrays):
        save(chunks, number, arrays)
        saves.append(number)
        if len(saves) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(back.FittedChunks, "save", stopping)
    choice = {"to": "smplh", "gender": "female", "chunk": 3, "up": "y",
              "backend": BackendChoice(name="soma", params={"shape": [1.0]})}  # fmt: skip
    with pytest.raises(KeyboardInterrupt):
        converted(fitted, tmp_path, **choice)
    found = converted(fitted, tmp_path, **choice)
    assert (len(searches), saves) == (1, [0, 1])
    motion = read_amass(tmp_path / "motion.npz", up="+y")
    np.testing.assert_array_equal(motion.betas[:3], np.float32(found.report["settings"]["found"]["betas"]))
    assert np.abs(motion.betas).max() > 0.1
    assert np.ptp(motion.translation[:, 1]) < 0.2  # walks on the plane y = const.


def test_betas_that_are_given_are_used(smplh_models, fitted, tmp_path):
    converted(fitted, tmp_path, to="smplh", betas=[0.25])
    np.testing.assert_array_equal(read_amass(tmp_path / "motion.npz").betas[:2], np.float32([0.25, 0]))


def test_vertices_of_another_topology_come_back_through_the_inversion(tmp_path):
    pytest.importorskip("soma_backend_toy")
    turns = np.tile(np.eye(3), (2, 77, 1, 1))
    still = motion(
        frames=2, rotations=turns, translation=np.array([[0, 1, 0], [1, 2, 3.0]]),
        identity={"backend": "toy", "params": {"legs": 1.1}},
    )  # fmt: skip
    write_motion(still, tmp_path / "m.npz")
    found = converted(tmp_path / "m.npz", tmp_path, to="toy")
    assert str(found) == "soma, 2 frames at 24 fps, posed"
    layer = SomaLayer("toy", lod="low")
    with open_vertex_sequence(tmp_path / "vertices.npz") as sequence:
        assert (sequence.frame_count, sequence.fps, sequence.metres) == (2, 24, 0.01)
        vertices = torch.as_tensor(sequence.read(0, 2))
    fit = PoseInversion(layer)(vertices, layer.identity({"legs": 1.1}), topology="native")
    assert 1e3 * fit.residual.max() < NATIVE_FIT_MM
    np.testing.assert_allclose(fit.translation, still.translation, atol=1e-3)


def test_the_body_can_be_put_on_the_ground(tmp_path):
    pytest.importorskip("soma_backend_toy")
    write_motion(motion(frames=1, identity={"backend": "toy", "params": {}}), tmp_path / "m.npz")
    converted(tmp_path / "m.npz", tmp_path / "ground", to="toy", translation="ground")
    lowest = {}
    with open_vertex_sequence(tmp_path / "ground/vertices.npz") as sequence:
        lowest = sequence.metres * sequence.read(0, 1)[..., "xyz".index(sequence.up[1])].min()
    assert abs(lowest) < 0.02
    found = converted(
        tmp_path / "m.npz", tmp_path / "low", to="toy", translation="ground", ground="lowest", contacts="lock"
    )
    placed = {key: found.report["settings"][key] for key in ("translation", "ground", "contacts")}
    assert placed == {"translation": "ground", "ground": "lowest", "contacts": "lock"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"to": "toy", "result": "poses"},
            "backend: got toy, whose poses are no vector of parameters, expected a backend whose generator",
        ),
        ({"to": "toy", "up": "z"}, "up: got z, expected none: vertices of toy have the axes of that model"),
        ({"to": "toy", "gender": "male"}, "gender: got male, expected none"),
        ({"to": "toy", "betas": [1.0]}, r"betas: got \[1\.0\], expected none"),
    ],
)
def test_what_vertices_do_not_have_is_refused(tmp_path, changes, said):
    pytest.importorskip("soma_backend_toy")
    write_motion(motion(identity={"backend": "toy", "params": {}}), tmp_path / "m.npz")
    with pytest.raises(InputError, match=said):
        converted(tmp_path / "m.npz", tmp_path, **changes)


def test_a_motion_without_a_body_needs_one(tmp_path):
    write_motion(motion(), tmp_path / "m.npz")
    with pytest.raises(InputError, match=r"backend: got none, and no body in m\.npz.*Pass backend=NAME"):
        converted(tmp_path / "m.npz", tmp_path, to="smplh")


def test_a_body_that_the_model_has_not_names_the_file(tmp_path):
    pytest.importorskip("soma_backend_toy")
    write_motion(motion(identity={"backend": "soma", "params": {"legs": 1.0}}), tmp_path / "m.npz")
    with pytest.raises(InputError, match=r"m\.npz: identity, params\['legs'\]: got unknown name 'legs'"):
        converted(tmp_path / "m.npz", tmp_path, to="toy")


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"poses": 0, "trans": 0}, "got the layout amass, expected a motion on this skeleton"),
        ({"betas": 0}, "got the keys betas, expected poses"),
    ],
)
def test_what_is_no_motion_on_this_skeleton_is_refused(tmp_path, keys, said):
    np.savez(tmp_path / "m.npz", **keys)
    with pytest.raises(InputError, match=said):
        converted(tmp_path / "m.npz", tmp_path, to="smplh")


def test_coefficients_of_another_gender_are_another_body(smplh_models, fitted, tmp_path, monkeypatch):
    (smplh_models / "SMPLH/SMPLH_MALE.npz").symlink_to(smplh_models / "SMPLH/SMPLH_FEMALE.npz")
    try:
        monkeypatch.setattr(back, "_found_params", lambda *_: {"betas": [0.25]})
        converted(fitted, tmp_path, to="smplh", gender="male")
    finally:
        (smplh_models / "SMPLH/SMPLH_MALE.npz").unlink()
    found = read_amass(tmp_path / "motion.npz")
    assert (found.gender, found.betas.tolist()) == ("male", [0.25] + 9 * [0.0])


def test_more_coefficients_than_the_model_has_are_refused(smplh_models, fitted, tmp_path):
    with pytest.raises(
        InputError, match=r"betas: got 4 coefficients, expected at most 3.*Leave the last ones"
    ):
        converted(fitted, tmp_path, to="smplh", betas=[0.0, 1.0, 2.0, 3.0])


def test_doubts_of_the_way_back_stand_in_its_report(smplh_models, fitted, tmp_path):
    found = converted(fitted, tmp_path, to="smplh", betas=[9.0], fps=0.04, up="-y")
    (own, rate, betas) = found.report["warnings"]
    assert "fps=0.04 is taken in place of the file's own, 60" in own
    assert "pass fps=25" in rate
    assert "betas=9 is far outside the range of smplh" in betas
    assert read_amass(tmp_path / "motion.npz", up="-y").translation[:, 1].mean() < 0  # y down: up is negative
