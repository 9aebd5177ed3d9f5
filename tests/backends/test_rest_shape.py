"""What a plugin's own code does wrong on the way to a rest shape is an error of that backend, by stage."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from soma_core.errors import InputError
from soma_core.layer import SomaLayer
from soma_core.plugin.errors import BrokenBackendError
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import BackendSpec, LinearBasis, Parameter
from soma_core.testing.synthetic import synthetic_canonical, synthetic_native, write_wrap_pair
from tests.plugin.fakes import FakeEntryPoint, hooks

CANONICAL = synthetic_canonical()
COUNT = len(synthetic_native()[0])


def _refuse(params):
    raise InputError("params['size']", got="-1", expected="a positive size", fix="Use 1")


def _raise(*_):
    raise RuntimeError("singular")


def _rest(params, count=COUNT):
    vertices = torch.as_tensor(synthetic_native()[0][:count], dtype=params["size"].dtype)
    return params["size"][:, None, None] * vertices


def _model(**parts):
    return SimpleNamespace(**{"rest": _rest, **parts})


def _linear(count=COUNT, coefficients=lambda params: params["size"][:, None]):
    template = torch.as_tensor(synthetic_native()[0][:count], dtype=torch.float32)
    basis = LinearBasis(template=template, basis=template[None], coefficients=coefficients)
    return _model(linear_basis=lambda: basis)


@pytest.fixture
def layer(tmp_path, monkeypatch):
    """A layer around a model that is made of functions."""
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))
    spec = BackendSpec(
        name="acme",
        unit="cm",
        up="+z",
        forward="-y",
        params=(Parameter(name="size", default=1.0),),
        wrap=write_wrap_pair(tmp_path),
        fill_segments=("mouth_bag", "eye_bags"),
    )

    def make(model):
        plugin = hooks(soma_backend=lambda: spec, soma_generator=lambda: model)
        registry = Registry([FakeEntryPoint("acme", plugin)])
        made = SomaLayer("acme", kernels="torch", canonical=CANONICAL, registry=registry)
        made.entries = registry.entries
        return made

    return make


def _fails(act, stage, cause):
    with pytest.raises(BrokenBackendError) as caught:
        act()
    assert caught.value.who == 'backend "acme" (soma-backend-acme 1.0)'
    assert caught.value.stage == stage
    assert cause in caught.value.cause


@pytest.mark.parametrize(
    ("model", "stage", "cause"),
    [
        (_model(linear_basis=_raise), "build", "RuntimeError: singular"),
        (_linear(coefficients=_raise), "build", "RuntimeError: singular"),
        (
            _linear(COUNT - 1),
            "wrap",
            f"native vertices: got (1, {COUNT - 1}, 3), expected (batch, {COUNT}, 3)",
        ),
    ],
)
def test_building_a_layer(layer, model, stage, cause):
    _fails(lambda: layer(model), stage, cause)


@pytest.mark.parametrize(
    ("model", "stage", "cause"),
    [
        (_model(rest=_raise), "rest", "RuntimeError: singular"),
        (_model(rest=lambda params: None), "rest", "rest returned NoneType, expected a tensor (batch, n, 3)"),
        (
            _model(rest=lambda params: _rest(params, COUNT - 1)),
            "wrap",
            f"native vertices: got (1, {COUNT - 1}, 3), expected (batch, {COUNT}, 3)",
        ),
    ],
)
def test_making_an_identity(layer, model, stage, cause):
    made = layer(model)
    _fails(made.identity, stage, cause)
    (entry,) = made.entries()
    assert (entry.state, entry.error.stage) == ("broken", stage)


def test_coefficients_that_fail_for_some_parameters(layer):
    def coefficients(params):
        return _raise() if float(params["size"].min()) < 0 else params["size"][:, None]

    made = layer(_linear(coefficients=coefficients))
    _fails(lambda: made.identity({"size": -1.0}), "rest", "RuntimeError: singular")
    assert made.identity({"size": 1.0}).batch_size == 1


def test_a_parameter_that_the_model_refuses_is_the_callers_to_mend(layer):
    with pytest.raises(InputError, match="got -1, expected a positive size"):
        layer(_model(rest=_refuse)).identity()
