"""MHR's own parameters from bodies of this skeleton: vertices that MHR itself posed, and motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from soma_core import InputError, ParameterFit, PoseInversion, SomaLayer
from soma_core.motion import (
    BackendChoice,
    ConvertOptions,
    FrameRange,
    convert_file,
    load_clip,
    write,
)

TRUST = {"trust": True}

SAME_MM = 1.0
"""Mean distance to vertices that the model itself can reach: 595 vertices that went over ours and back."""

OTHER_SKIN_MM = 10.0
"""Mean distance to poses of our skin: the stand-in has angles for 42 joints of 78, and none for the legs."""

NEAR_MM = 3.0
"""Mean distance of a body that is found to the one that it is of, in the T-pose."""


@pytest.fixture(scope="module")
def tools(supplied):
    """Layer and fit of LOD 6, whose parameters are those of LOD 1, and the data folder meanwhile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOMA_DATA_DIR", str(supplied))
        patch.setenv("SOMA_CACHE_DIR", str(supplied.parent / "derived"))
        kind = {"options": TRUST, "lod": "low"}
        yield SomaLayer("mhr_lod6", **kind), ParameterFit("mhr_lod6", **kind)


def body(**values):
    sizes = {"identity": 45, "scales": 68, "bone_lengths": 6}
    return {name: values.get(name, torch.zeros(1, size)) for name, size in sizes.items()}


@pytest.mark.slow
def test_poses_of_the_model_are_found_however_it_is_turned(tools):
    layer, fit = tools
    random = np.random.default_rng(0)
    model = np.zeros((2, 130), np.float32)
    model[:, :3], model[:, 4] = 3 * random.standard_normal((2, 3)), [1.8, -2.5]
    model[:, 6:129] = 0.15 * random.standard_normal((2, 123))
    native = fit.generator.posed(body(), {"parameters": torch.as_tensor(model)})
    canonical = PoseInversion(layer).canonical(native, "native")
    gap = torch.cat((canonical, canonical[:1] * torch.nan))
    found = fit(gap)
    assert found.valid.tolist() == [True, True, False]
    assert not found.parameters[2].any()
    again = fit.generator.posed(body(), {"parameters": found.parameters[:2]})
    distance = (again - native).norm(dim=-1)[:, fit.transfer.covered]
    assert 10 * float(distance.mean()) < SAME_MM
    assert bool(found.converged[:2].all())
    assert 1e3 * float(found.vertex_error[:2].nanmean()) < SAME_MM


@pytest.mark.slow
def test_a_body_is_found_from_its_t_pose(tools):
    layer, fit = tools
    identity = layer.identity({"identity": torch.tensor([[0.5, -0.5, 0.3] + [0.0] * 42])})
    still = layer.pose(identity, torch.zeros(1, 77, 3)).vertices
    found = fit.fit_params(still)
    assert {name: tuple(value.shape) for name, value in found.items()} == {
        "identity": (1, 45), "scales": (1, 68), "bone_lengths": (1, 6),
    }  # fmt: skip
    near, far = (float(fit(still, params=params).vertex_error.nanmean()) for params in (found, None))
    assert 1e3 * near < NEAR_MM
    assert near < far
    with pytest.raises(InputError, match="vertices: got 2 frames, expected one frame.*T-pose"):
        fit.fit_params(still.repeat(2, 1, 1))


def test_a_motion_becomes_parameters_as_sam3d_names_them(tools, tmp_path):
    """And they pose the model where the report says."""
    _, fit = tools
    clip = load_clip(frames=FrameRange(start=0, stop=240, step=120))
    known = {"identity": [0.5] + [0.0] * 44, "scales": [0.0] * 68, "bone_lengths": [0.0] * 6}
    write(
        replace(clip, identity={"backend": "mhr_lod6", "params": known, "options": TRUST}), tmp_path / "m.npz"
    )
    trusted = BackendChoice(name="mhr_lod6", options=TRUST)
    options = ConvertOptions(to="mhr_lod6", result="poses", lod="low", backend=trusted)
    report = convert_file(tmp_path / "m.npz", tmp_path / "out", options=options).report
    with np.load(tmp_path / "out/motion.npz", allow_pickle=False) as file:
        shapes = {name: file[name].shape for name in file.files}
        parameters = torch.as_tensor(file["mhr_model_params"])
        np.testing.assert_array_equal(file["shape_params"], np.tile(np.float32(known["identity"]), (2, 1)))
        assert (file["fps"], file["model"]) == (clip.fps, "mhr_lod6")
    assert shapes["mhr_model_params"] == (2, 204)
    assert shapes["expr_params"] == (2, 72)
    own = body(identity=torch.tensor([known["identity"]]))
    posed = fit.generator.posed(own, {"parameters": parameters[:, :130]})
    layer = SomaLayer("mhr_lod6", options=TRUST, lod="low")
    target = fit.transfer(
        layer.pose(
            layer.identity(known), torch.as_tensor(clip.rotations), torch.as_tensor(clip.translation)
        ).vertices
    )
    error = 10 * float((posed - target).norm(dim=-1)[:, fit.transfer.covered].mean())
    assert error < OTHER_SKIN_MM
    assert report["error_mm"]["all"]["mean"] == pytest.approx(
        error, rel=0.1
    )  # which leaves the face's inside out
    assert report["settings"]["params"] == known


@pytest.mark.parametrize("setting", [{"num_betas": 10}, {"up": "z"}, {"gender": "male"}])
def test_what_these_parameters_do_not_have_is_refused(tools, tmp_path, setting):
    clip = load_clip(frames=FrameRange(stop=1))
    write(clip, tmp_path / "m.npz")
    choice = BackendChoice(name="mhr_lod6", options=TRUST)
    options = ConvertOptions(to="mhr_lod6", result="poses", lod="low", backend=choice, **setting)
    with pytest.raises(InputError, match=f"{next(iter(setting))}: got .*, expected none with to=mhr_lod6"):
        convert_file(tmp_path / "m.npz", tmp_path / "out", options=options)


def test_a_model_without_a_pose_vector_is_refused():
    with pytest.raises(InputError, match="backend: got soma, whose poses are no vector.*NativeFit"):
        ParameterFit("soma")
