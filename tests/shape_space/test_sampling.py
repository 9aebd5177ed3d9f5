"""Random identities: drawn from declarations, reproducible, mixed by shares, standing on the floor."""

from types import SimpleNamespace

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.plugin.spec import BackendSpec, Parameter
from soma_core.shape_space.sampling import HELD_OUT, TRAINING, IdentityStream, sample_parameters

PARAMS = (
    Parameter(name="age", default=0.5, range=(0.2, 0.9)),
    Parameter(name="shape", shape=(3,)),
    Parameter(name="nose", range=(-1.0, 1.0), group="local"),
)


class Layer:
    """A body of two vertices, `height` metres tall, whose lower end is `lift` above the origin."""

    def __init__(self, height=1.0, lift=5.0):
        self.spec = BackendSpec(name="x", unit="m", up="+y", forward="+z", wrap=None, params=PARAMS)
        self._height, self._lift = height, lift

    def identity(self, params=None):
        import torch

        age = torch.as_tensor(params["age"])
        rest = torch.zeros(len(age), 2, 3, dtype=torch.float64)
        rest[:, 0, 1] = self._lift
        rest[:, 1, 1] = self._lift + self._height
        rest[:, 1, 0] = age
        return SimpleNamespace(rest=rest)


def test_uniform_where_the_default_is_not_zero_and_normal_where_it_is():
    drawn = sample_parameters(Layer().spec, 4000, np.random.default_rng(0), spread=0.3)
    assert drawn["age"].shape == (4000,)
    assert drawn["shape"].shape == (4000, 3)
    assert 0.2 <= drawn["age"].min() < 0.21
    assert 0.89 < drawn["age"].max() <= 0.9
    # Standard error of a deviation from 12,000 draws is 0.6 %, from 4,000 about 1.1 %.
    assert drawn["shape"].std() == pytest.approx(0.9, rel=0.03)
    assert drawn["nose"].std() == pytest.approx(0.3, rel=0.05)
    assert np.abs(drawn["nose"]).max() <= 1.0


def test_skipped_groups_are_not_drawn():
    assert list(sample_parameters(Layer().spec, 1, np.random.default_rng(0), skip_groups=["local"])) == [
        "age",
        "shape",
    ]


def test_batches_depend_on_seed_stream_and_number_only():
    def stream(seed=0):
        return IdentityStream({"x": Layer()}, {"x": 1.0}, seed=seed)

    first = stream()
    expected = first.shapes(TRAINING, 3, 70)
    np.testing.assert_array_equal(stream().shapes(TRAINING, 3, 70), expected)
    for other in (
        first.shapes(TRAINING, 4, 70),
        first.shapes(HELD_OUT, 3, 70),
        stream(1).shapes(TRAINING, 3, 70),
    ):
        assert not np.array_equal(other, expected)


def test_shapes_are_centimetres_on_the_floor():
    shapes = IdentityStream({"x": Layer(height=1.8)}, {"x": 1.0}, seed=0).shapes(TRAINING, 0, 5)
    np.testing.assert_allclose(shapes[:, 0, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(shapes[:, 1, 1], 180.0)


def test_shares_decide_how_often_each_backend_is_used():
    layers = {"small": Layer(height=1.0), "tall": Layer(height=2.0)}
    shapes = IdentityStream(layers, {"small": 1.0, "tall": 3.0}, seed=0).shapes(TRAINING, 0, 4000)
    assert (shapes[:, 1, 1] > 150).mean() == pytest.approx(0.75, abs=0.03)  # four standard errors


@pytest.mark.parametrize("mix", [{}, {"x": 0.0}, {"x": -1.0}, {"x": float("nan")}])
def test_unusable_mixture_is_named(mix):
    with pytest.raises(InputError, match=r"mix: got \{.*expected at least one backend"):
        IdentityStream({"x": Layer()}, mix, seed=0)


def test_layers_must_match_the_mixture():
    with pytest.raises(InputError, match=r"layers: got \['x'\], expected \['y'\]"):
        IdentityStream({"x": Layer()}, {"y": 1.0}, seed=0)


@pytest.mark.parametrize(
    ("parameter", "fix"),
    [
        ("nose", r"Enable it in options\.x, or leave its group.*'skip_groups=\[local\]'\.$"),
        ("age", r"Enable it in options\.x\.$"),
    ],
)
def test_a_parameter_that_the_options_leave_out_is_named_with_what_to_change(parameter, fix):
    class Refusing(Layer):
        def identity(self, params=None):
            raise InputError(f"params[{parameter!r}]", got="it", expected="less", fix="Add backend.options.y")

    stream = IdentityStream({"x": Refusing()}, {"x": 1.0}, seed=0)
    with pytest.raises(InputError, match=rf"params\['{parameter}'\]: got it, expected less\. {fix}"):
        stream.shapes(TRAINING, 0, 2)
