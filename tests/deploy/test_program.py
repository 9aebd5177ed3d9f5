"""A program gives what the layer gives, whatever the batch, after it was written and read again."""

import json

import numpy as np
import pytest
import torch

from soma_core import SomaLayer
from soma_core.choices import ModelPart
from soma_core.deploy.onnx_file import open_session, run_session, write_onnx, write_program
from soma_core.deploy.program import deploy
from soma_core.errors import InputError, SomaError
from soma_core.tasks.export_model import compare, random_inputs
from tests import bodies
from tests.bodies import LinearBody, tiny_canonical, tiny_registry

AGREES_MM = 1e-3
"""Some roundings of float32, at most 1.2e-4 mm each at the size of a body."""

FITTED_MM = 3e-3
"""With the rest shape and the fit of its skeleton: there the layer itself is 1.4e-3 mm from its float64."""

BATCHES = (1, 7, 64)


@pytest.fixture(scope="module")
def layer(tmp_path_factory):
    registry = tiny_registry(tmp_path_factory.mktemp("pair"))
    return SomaLayer("tiny", dtype=torch.float32, canonical=tiny_canonical(), registry=registry)


def off_by(run, model, layer, params=None):
    """Largest distance [mm] from the layer, over all batches."""
    random = np.random.default_rng(3)
    worst = 0.0
    for batch in BATCHES:
        inputs = random_inputs(model, layer, batch, random)
        found = run(inputs)
        assert {name: array.shape for name, array in found.items()} == {
            name: (batch, *shape) for name, shape in model.outputs.items()
        }
        worst = max(worst, compare(found, inputs, layer, params or {}))
    return worst


def as_called(program, model):
    """Runs a program on inputs by their names."""

    def run(inputs):
        with torch.no_grad():
            found = program.module()(*(inputs[name] for name in model.inputs))
        return {name: each.numpy() for name, each in zip(model.outputs, found, strict=True)}

    return run


def test_poses_of_one_body_after_writing_and_reading(layer, tmp_path):
    params = {"size": 1.1, "shape": [0.4, -0.2, 0.1, 0.3]}
    model = deploy(layer, params=params)
    write_program(tmp_path / "model.pt2", model)
    extra = {"about.json": ""}
    program = torch.export.load(tmp_path / "model.pt2", extra_files=extra)
    assert off_by(as_called(program, model), model, layer, params) < AGREES_MM
    assert off_by(as_called(program, model), model, layer, {"size": 1.2}) > 10  # it is that body, no other
    about = json.loads(extra["about.json"])
    assert about["identity"]["size"] == pytest.approx(1.1)
    assert about["joint_names"] == list(layer.joint_names)
    assert np.array_equal(np.reshape(about["triangles"], (-1, 3)), layer.faces)


@pytest.mark.slow
@pytest.mark.parametrize("exact", [False, True])
def test_parameters_are_inputs_and_the_rest_is_fixed(layer, exact):
    whole = SomaLayer(**layer._given | {"exact": exact})
    model = deploy(whole, ModelPart.full, parameters=["size"], params={"shape": [0.5, 0, 0, 0.2]})
    assert [*model.inputs] == ["rotations", "translation", "size"]
    assert off_by(as_called(model.program, model), model, whole, {"shape": [0.5, 0, 0, 0.2]}) < FITTED_MM


def test_a_file_for_onnx_says_what_it_takes(layer, tmp_path):
    for name in ("onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    model = deploy(layer, ModelPart.joints, params={"size": 0.9})
    write_onnx(tmp_path / "model.onnx", model)
    session = open_session(tmp_path / "model.onnx")
    assert off_by(lambda inputs: run_session(session, inputs), model, layer, {"size": 0.9}) < AGREES_MM
    shapes = {each.name: each.shape for each in session.get_inputs()}
    assert {name: shape[1:] for name, shape in shapes.items()} == {
        name: list(shape) for name, shape in model.inputs.items()
    }
    stored = session.get_modelmeta().custom_metadata_map
    assert json.loads(stored["soma.identity"])["size"] == pytest.approx(0.9)
    assert stored["soma.unit"] == "m"
    assert stored["soma.rig_revision"] == layer.rig.revision
    assert str(tmp_path.home()).encode() not in (tmp_path / "model.onnx").read_bytes()


def test_a_layer_that_is_posed_by_its_own_code_gives_the_same(layer):
    plain = SomaLayer(**layer._given | {"repose": False})
    model = deploy(plain, params={"size": 0.9})
    assert off_by(as_called(model.program, model), model, plain, {"size": 0.9}) < AGREES_MM


def test_what_cannot_be_deployed_is_named(layer, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="parameters: got size with what=pose, expected what=full"):
        deploy(layer, parameters=["size"])
    with pytest.raises(InputError, match="got 'sise'.*Did you mean \"size\""):
        deploy(layer, ModelPart.full, parameters=["sise"])
    with pytest.raises(InputError, match="got several bodies"):
        deploy(layer, params={"size": [1.0, 1.1]})

    class Branching(LinearBody):
        def coefficients(self, params):
            return super().coefficients(params) * (2 if params["size"].max() > 2 else 1)

    monkeypatch.setattr(bodies, "LinearBody", Branching)
    registry = bodies.tiny_registry(tmp_path)
    branching = SomaLayer("tiny", dtype=torch.float32, canonical=tiny_canonical(), registry=registry)
    with pytest.raises(InputError, match="full of backend 'tiny', whose generator torch.export cannot"):
        deploy(branching, ModelPart.full)


def test_a_missing_package_is_named(layer, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnxscript", None)
    with pytest.raises(SomaError, match=r"got no onnxscript.*pip install 'soma-body-core\[onnx\]'"):
        write_onnx(tmp_path / "model.onnx", deploy(layer, ModelPart.joints))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(("backend", "part"), [("soma", "full"), ("anny", "pose")])
def test_real_bodies_with_twist_and_correctives(backend, part, tmp_path):
    for name in ("onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    if backend == "anny":
        pytest.importorskip("soma_backend_anny")
    real = SomaLayer(backend, lod="low")
    model = deploy(real, ModelPart(part))
    write_onnx(tmp_path / "model.onnx", model)
    session = open_session(tmp_path / "model.onnx")
    bound = FITTED_MM if part == "full" else AGREES_MM
    assert off_by(lambda inputs: run_session(session, inputs), model, real) < bound
    assert off_by(as_called(model.program, model), model, real) < bound
