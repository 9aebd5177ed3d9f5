"""``soma invert identity=unknown``: the body is found, kept with the motion, and animated again."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import soma_core.layer
from soma_core.backends import native
from soma_core.cli import EXIT_OK, main
from soma_core.errors import InputError
from soma_core.io import read_motion
from soma_core.layer import SomaLayer
from soma_core.motion import animate, identities, models, stored_identity
from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import Parameter
from soma_core.tasks import animate as animate_task
from soma_core.tasks import invert
from tests.bodies import randn
from tests.plugin.fakes import FakeEntryPoint
from tests.tasks import test_animate
from tests.tasks.test_invert import Stopping, configured

FOUND_MM = 0.2
"""Largest distance between the input and what the motion and the body found make, on plain skinning."""
UNPOSED_MM = 2.0
"""The same, mean, where every vertex was free."""
FRAMES = 6
TRUTH = [[1.2, -0.8, 0.7]]


@pytest.fixture(autouse=True)
def lean(monkeypatch):
    """A backend of the first three components of the shape space, to be quick."""
    spec = replace(native.soma_backend(), name="lean", params=(Parameter(name="shape", shape=(3,)),))
    plugin = SimpleNamespace(soma_backend=hookimpl(lambda: spec), soma_generator=native.soma_generator)
    registry = Registry([FakeEntryPoint("lean", plugin), FakeEntryPoint("soma", native)])
    monkeypatch.setattr(soma_core.layer, "default_registry", lambda: registry)
    return registry


@pytest.fixture
def source(lean, tmp_path):
    layer = SomaLayer("lean", lod="low", procedural=False)
    turns, hips = 0.25 * randn(FRAMES, 77, 3, seed=1).float(), 0.3 * randn(FRAMES, 3, seed=2).float()
    with torch.no_grad():
        vertices = layer.pose(layer.identity({"shape": TRUTH}), turns, hips).vertices
    np.savez(tmp_path / "body.npz", vertices=vertices.numpy())
    return tmp_path / "body.npz"


def settings(source, **changes):
    unknown = {"method": "backend", "frames": 4, "iterations": 6}
    return configured(
        input=str(source), backend={"name": "lean", "params": {}}, identity=unknown | changes, chunk=2
    )


def animated(folder, frames):
    """Vertices that soma animate makes of a fit, whatever backend is configured."""
    config = test_animate.configured(
        motion=str(folder / "motion.npz"), identity_from="motion", translation="motion", write=["npz"],
        frames={"start": 0, "stop": None, "step": 1},
    )  # fmt: skip
    animate_task.run(config, folder / "again")
    motion = read_motion(folder / "again/motion.npz")
    layer = SomaLayer(motion.identity["backend"], lod="low", procedural=False)
    with torch.no_grad():
        body = stored_identity(layer, motion.identity)
        result = animate(layer, body, motion, translation="motion", keep=list(range(frames)))
    return np.stack(list(result.vertices.values()))


@pytest.mark.slow
def test_a_body_that_is_not_known_is_found_and_animated_again(source, tmp_path, caplog):
    caplog.set_level("INFO")
    invert.run(settings(source), tmp_path / "fit")
    assert "finding the identity from 4 frames" in caplog.text
    with np.load(source) as file:
        target = file["vertices"]
    assert 1e3 * np.abs(animated(tmp_path / "fit", FRAMES) - target).max() < FOUND_MM
    report = json.loads((tmp_path / "fit/report.json").read_text(encoding="utf-8"))
    found = report["settings"]["identity"]
    assert (found["method"], found["frames"], found["converged"]) == ("backend", 4, True)
    np.testing.assert_allclose(found["params"]["shape"], TRUTH[0], atol=0.01)
    assert report["error_mm"]["all"]["max"] < FOUND_MM
    assert not (tmp_path / "fit/chunks").exists()


@pytest.mark.slow
def test_an_unposed_body_travels_as_its_rest_shape(source, tmp_path):
    invert.run(settings(source, method="unpose", free=[], frames=6, iterations=14), tmp_path / "fit")
    motion = read_motion(tmp_path / "fit/motion.npz")
    assert motion.identity["params"] == {"shape": [0, 0, 0]}
    assert motion.identity["rest"].shape == (4505, 3)
    with np.load(source) as file:
        target = file["vertices"]
    error = np.linalg.norm(animated(tmp_path / "fit", FRAMES) - target, axis=-1)
    assert 1e3 * error.mean() < UNPOSED_MM


def test_a_run_that_goes_on_keeps_the_body_that_it_found(source, tmp_path, monkeypatch):
    monkeypatch.setattr(models, "GuidedInversion", Stopping)
    monkeypatch.setattr(Stopping, "calls", 1)
    few = {"frames": 2, "iterations": 1}
    with pytest.raises(KeyboardInterrupt):
        invert.run(settings(source, **few), tmp_path / "fit")
    monkeypatch.setattr(identities, "fit_identity", lambda *_, **__: pytest.fail("searched again"))
    with pytest.raises(InputError, match="identity: got .*'frames': 3.*, expected .*'frames': 2"):
        invert.run(settings(source, **few | {"frames": 3}), tmp_path / "fit")
    invert.run(settings(source, **few), tmp_path / "fit")
    assert read_motion(tmp_path / "fit/motion.npz").frame_count == FRAMES


@pytest.mark.slow
def test_from_the_command_line(source, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["invert", f"input={source}", "fps=24", "unit=m", "topology=canonical", "lod=low",
               "identity=unknown", "identity.method=unpose", "identity.free=[]", "identity.frames=2",
               "identity.iterations=1", "picture.frames=0", "hydra.run.dir=out"]  # fmt: skip
    assert main(command) == EXIT_OK
    assert "finding the identity from 2 frames" in capsys.readouterr().err
    again = ["animate", "motion=out/motion.npz", "identity_from=motion", "lod=low", "write=[npz]",
             "hydra.run.dir=again"]  # fmt: skip
    assert main(again) == EXIT_OK
    made, kept = (read_motion(tmp_path / name / "motion.npz").identity["rest"] for name in ("out", "again"))
    np.testing.assert_array_equal(made, kept)


def test_a_motion_without_an_identity_cannot_give_one():
    with pytest.raises(InputError, match="identity_from: got a motion with nothing of its"):
        animate_task.run(test_animate.configured(identity_from="motion", motion=None), None)
