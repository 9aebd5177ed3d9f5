"""SAM 3D Body outputs through ``soma convert``, posed by the stand-in for the model."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from soma_core import AssetError, BackendError, InputError, read_motion
from soma_core.motion import (
    BackendChoice,
    ConvertOptions,
    FrameRange,
    IdentityChoice,
    convert_file,
    load_clip,
    write,
)
from soma_core.plugin import Registry
from tests.standins.mhr_files import StandIn, mhr_body

FIT_MM = 3.0
"""Mean distance: the stand-in bends about other joints than the rig, and has no twist joints."""

CAMERA = np.array([1, -1, -1])


@pytest.fixture(scope="module")
def person():
    """Two frames of one person, the second one nearer to the camera, with small bends."""
    random = np.random.default_rng(0)
    model = np.zeros((2, 204), np.float32)
    model[:, 3:129] = 0.1 * random.standard_normal((2, 126))
    model[:, 130:] = 0.05 * random.standard_normal(74)
    shape = np.tile(0.5 * random.standard_normal(45), (2, 1)).astype(np.float32)
    with torch.no_grad():
        inputs = (torch.as_tensor(shape), torch.as_tensor(model), torch.zeros(2, 72))
        vertices = StandIn(mhr_body(1))(*inputs)[0].numpy() / 100
    return {
        "pred_vertices": (CAMERA * vertices).astype(np.float32), "mhr_model_params": model,
        "shape_params": shape, "pred_cam_t": np.array([[0, 1, 5], [0, 1, 3]], np.float32),
    }  # fmt: skip


def converted(folder, person, *, trusted=True, **changes):
    np.savez(folder / "person.npz", **person)
    backend = BackendChoice(name="mhr", options={"trust": True}) if trusted else None
    options = ConvertOptions(**{"lod": "low", "fps": 30, "backend": backend} | changes)
    return convert_file(folder / "person.npz", folder / "out", options=options)


def test_the_body_of_the_file_is_posed(data_folder, person, tmp_path):
    found = converted(tmp_path, person)
    assert found.error_mm["mean"] < FIT_MM
    motion = read_motion(tmp_path / "out/motion.npz")
    assert motion.identity["backend"] == "mhr"
    assert not motion.identity["options"]  # whether the model is trusted is not for a file to say
    np.testing.assert_allclose(motion.identity["params"]["identity"], person["shape_params"][0], atol=1e-6)
    np.testing.assert_allclose(
        motion.identity["params"]["scales"], person["mhr_model_params"][0, 136:], atol=1e-6
    )
    moved = motion.translation[1] - motion.translation[0]
    np.testing.assert_allclose(moved, [0, 0, 2], atol=0.02)  # towards the camera, which looks along -z


def test_a_body_can_be_found_without_the_model(data_folder, person, tmp_path, monkeypatch):
    early = {"pred_vertices": person["pred_vertices"]}
    with pytest.raises(
        InputError, match=r"shape_params: got none, as in the first releases.*identity=unknown"
    ):
        converted(tmp_path, early)
    search = IdentityChoice(method="backend", frames=1, iterations=1)
    found = converted(tmp_path, early, trusted=False, identity=search)
    motion = read_motion(tmp_path / "out/motion.npz")
    assert motion.identity["backend"] == "soma"
    assert motion.identity["params"]["shape"] == found.report["settings"]["found"]["params"]["shape"]
    assert np.isfinite(found.error_mm["mean"])


def test_what_is_missing_is_said(data_folder, person, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"person\.npz: fps: got none: SAM 3D Body sees pictures.*fps=30"):
        converted(tmp_path, person, fps=None)
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    monkeypatch.setattr("soma_core.motion.bodies.default_registry", Registry)
    with pytest.raises(
        AssetError, match=r"mhr_neutral\.obj: the wrap of MHR is missing.*native=mhr_neutral\.ply out="
    ):
        converted(tmp_path, person, trusted=False, identity=IdentityChoice(method="backend"))
    with pytest.raises(BackendError, match=r"missing.*mhr_model_lod1\.pt.*Or pass identity=unknown"):
        converted(tmp_path, person)


def test_parameters_without_the_model_are_refused_with_what_goes_without(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    monkeypatch.setattr("soma_core.native.parameters.default_registry", Registry)
    write(load_clip(frames=FrameRange(stop=1)), tmp_path / "clip.npz")
    options = ConvertOptions(to="mhr", result="poses", lod="low", backend=BackendChoice(name="soma"))
    with pytest.raises(
        BackendError, match=r"mhr_model_lod1\.pt.*no mesh of the model does.*leave result=poses out"
    ):
        convert_file(tmp_path / "clip.npz", tmp_path / "out", options=options)
