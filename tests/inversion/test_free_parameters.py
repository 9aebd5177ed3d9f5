"""Parameters as a vector: there and back, bounded where they should be, spread evenly."""

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.inversion.free_parameters import FreeParameters
from soma_core.layer import SomaLayer
from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import Parameter
from tests.bodies import LinearBody, TinyPlugin, tiny_canonical, tiny_spec, write_pair
from tests.plugin.fakes import FakeEntryPoint

ROUNDING = 1e-12
SHAPE, SIZE = Parameter(name="shape", shape=(4,)), Parameter(name="size", default=1.0, range=(0.6, 1.5))
HAT = Parameter(name="hat", default=0.5, range=(0.0, 1.0), group="clothes")
TAIL = Parameter(name="tail", group="animal")


class DressedPlugin(TinyPlugin):
    """A body that may wear a hat, which changes nothing, and never has a tail."""

    @hookimpl
    def soma_generator(self, device, dtype):
        class Dressed(LinearBody):
            linear_basis = None

            def rest(self, params):
                if "tail" in params:
                    raise InputError("params['tail']", got="a tail", expected="none", fix="Leave it out.")
                return super().rest(params)

        return Dressed(device=device, dtype=dtype)


@pytest.fixture(scope="module")
def layer(tmp_path_factory):
    spec = tiny_spec(write_pair(tmp_path_factory.mktemp("pair")), params=(SHAPE, SIZE, HAT, TAIL))
    registry = Registry([FakeEntryPoint("tiny", DressedPlugin(spec))])
    return SomaLayer("tiny", dtype=torch.float64, canonical=tiny_canonical(), registry=registry)


def test_a_point_is_its_parameters(layer):
    start = {"shape": [[1.0, -2.0, 0.5, 0.0]], "size": 1.2, "hat": 0.25}
    parameters = FreeParameters(layer, start)
    assert parameters.names == ("shape", "size", "hat")
    found = parameters.params(parameters.start[None])
    for name, value in start.items():
        torch.testing.assert_close(found[name], torch.as_tensor(value).double().view(found[name].shape))
    points = np.stack([parameters.start, parameters.start + 0.1])
    bodies, alone = parameters.identities(points), layer.identity(start)
    assert bodies.batch_size == 2
    torch.testing.assert_close(bodies.rest[:1], alone.rest, atol=ROUNDING, rtol=0)


def test_defaults_are_the_origin_and_ranges_are_six_units(layer):
    parameters = FreeParameters(layer)
    assert not parameters.start.any()
    assert np.isinf(parameters.lower[:4]).all()  # deviations have no bounds
    assert np.isinf(parameters.upper[:4]).all()
    np.testing.assert_allclose((parameters.upper - parameters.lower)[4:], 6, atol=ROUNDING)
    np.testing.assert_allclose(parameters.params(parameters.upper[None])["size"], 1.5)


def test_only_what_is_named_moves(layer):
    parameters = FreeParameters(layer, {"shape": [1.0, 2.0]}, ["size"])
    found = parameters.params(np.array([[0.0], [1.0]]))
    torch.testing.assert_close(found["shape"], torch.tensor([[1.0, 2, 0, 0]] * 2, dtype=torch.float64))
    np.testing.assert_allclose(found["size"], [1.0, 1.15])


def test_a_start_outside_the_range_is_brought_inside(layer):
    parameters = FreeParameters(layer, {"size": 2.0}, ["size"])
    np.testing.assert_allclose(parameters.params(parameters.start[None])["size"], [1.5])


def test_limits_are_wider_than_the_range_that_counts_as_six_units(tmp_path):
    tall = Parameter(name="size", default=1.0, range=(0.6, 1.5), limits=(0.3, 1.5))
    spec = tiny_spec(write_pair(tmp_path), params=(SHAPE, tall))
    registry = Registry([FakeEntryPoint("tiny", DressedPlugin(spec))])
    other = SomaLayer("tiny", dtype=torch.float64, canonical=tiny_canonical(), registry=registry)
    parameters = FreeParameters(other, {"size": 0.2}, ["size"])
    np.testing.assert_allclose(parameters.upper - parameters.lower, 6 * 1.2 / 0.9)
    np.testing.assert_allclose(parameters.params(parameters.start[None])["size"], [0.3])


def test_newborns_can_be_found():
    """Anny's youngest are younger than a random population begins."""
    pytest.importorskip("soma_backend_anny")
    parameters = FreeParameters(SomaLayer("anny", lod="low"), {"age": -0.3}, ["age"])
    np.testing.assert_allclose(parameters.params(parameters.lower[None])["age"], [-1 / 3], rtol=1e-6)
    np.testing.assert_allclose(parameters.params(parameters.start[None])["age"], [-0.3], rtol=1e-6)


def test_steps_lead_away_from_the_nearer_bound(layer):
    parameters = FreeParameters(layer, None, ["shape", "size"])
    near_top = np.r_[np.zeros(4), parameters.upper[4]]
    np.testing.assert_array_equal(parameters.inward(near_top, 0.1), [0.1, 0.1, 0.1, 0.1, -0.1])


def test_bodies_spread_over_what_is_bounded(layer):
    parameters = FreeParameters(layer, {"shape": [1.0]}, ["shape", "size", "hat"])
    points = parameters.spread(30)
    assert (points[:, :4] == parameters.start[:4]).all()
    for column in (4, 5):
        share = (points[:, column] - parameters.lower[column]) / 6
        assert (np.histogram(share, 5, (0, 1))[0] >= 5).all()
    assert not len(FreeParameters(layer, None, ["shape"]).spread(30))


@pytest.mark.parametrize(
    ("start", "names", "text"),
    [
        (None, ["girth"], r"free: got 'girth', expected parameters of backend 'tiny'"),
        (None, [], r"free: got no parameter, expected at least one"),
        ({"size": [1.0, 1.1]}, None, r"start: got 2 identities, expected one"),
    ],
)
def test_refusals(layer, start, names, text):
    with pytest.raises(InputError, match=text):
        FreeParameters(layer, start, names)


def test_groups_of_the_real_backend():
    """The six phenotypes and the secondary ones are enabled as they come; local changes are not."""
    pytest.importorskip("soma_backend_anny")
    parameters = FreeParameters(SomaLayer("anny", lod="low"))
    assert len(parameters.names) == 11
    assert {"age", "cupsize", "african"} <= set(parameters.names)
    assert np.isfinite(parameters.upper).all()
