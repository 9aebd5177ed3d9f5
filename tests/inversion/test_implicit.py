"""Gradients through a fit, against differences of fits."""

import pytest
import torch

from soma_core.errors import InputError
from soma_core.inversion import PoseInversion, PosePriors
from soma_core.layer import SomaLayer
from tests.bodies import randn

FRAMES = 2
DIFFERENCE = 1e-5
AGREES = 1e-4
"""Relative: central differences of float64 fits, whose last step is below a nanometre."""


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", dtype=torch.float64, procedural=False)


@pytest.fixture(scope="module")
def identity(layer):
    return layer.identity({"shape": [1.0, -1.0]})


@pytest.fixture(scope="module")
def targets(layer, identity):
    turns = 0.25 * randn(FRAMES, 77, 3, seed=1)
    return layer.pose(identity, turns, 0.3 * randn(FRAMES, 3, seed=2)).vertices


def exact(layer, **options):
    return PoseInversion(layer, iterations=20, tolerance=1e-12, **options)


def loss(result):
    """A number that knows every determined rotation and the translation."""
    turns = randn(FRAMES, 77, 3, 3, seed=3) * result.determined[..., None, None]
    return (turns * result.rotations).sum() + (randn(FRAMES, 3, seed=4) * result.translation).sum()


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("who", [1, FRAMES])
def test_the_gradient_is_that_of_differences(layer, identity, targets, weighted, who):
    inversion = exact(layer)
    if who > 1:
        identity = layer.identity({"shape": [[1.0, -1.0]] * FRAMES})
    weights = None
    if weighted:
        weights = inversion.default_weights * (1 + torch.arange(layer.mesh.vertex_count) % 3)
    vertices = targets.clone().requires_grad_()
    loss(inversion(vertices, identity, weights=weights)).backward()
    step = DIFFERENCE * randn(*targets.shape, seed=5)
    ahead, behind = (loss(inversion(targets + sign * step, identity, weights=weights)) for sign in (1, -1))
    torch.testing.assert_close((vertices.grad * step).sum(), (ahead - behind) / 2, atol=0, rtol=AGREES)


def test_native_vertices_carry_gradients_too(layer, identity, targets):
    native = (100 * layer_mid(targets, layer)).requires_grad_()
    result = exact(layer)(native, identity, topology="native")
    loss(result).backward()
    vertices = targets.clone().requires_grad_()
    loss(exact(layer)(vertices, identity)).backward()
    # Of the mid mesh the low one is a part: the others have no say.
    torch.testing.assert_close(native.grad[:, : layer.mesh.vertex_count], vertices.grad / 100)
    assert not native.grad[:, layer.mesh.vertex_count :].any()


def layer_mid(low, layer):
    """Vertices in the number of the mid mesh, of which the low one is the beginning."""
    mid = SomaLayer("soma", dtype=torch.float64).mesh.vertex_count
    return torch.cat((low, low[:, :1].expand(-1, mid - layer.mesh.vertex_count, 3)), 1)


def test_frames_that_are_not_valid_get_no_gradient(layer, identity, targets):
    broken = targets.clone()
    broken[0] = broken[0, 0]
    vertices = broken.requires_grad_()
    result = exact(layer)(vertices, identity)
    (result.rotations.sum() + result.translation.sum()).backward()
    assert not vertices.grad[0].any()
    assert vertices.grad[1].any()


def test_vertices_without_weight_get_no_gradient(layer, identity, targets):
    inversion = exact(layer)
    weights = inversion.default_weights.clone()
    weights[::7] = 0
    vertices = targets.clone().requires_grad_()
    loss(inversion(vertices, identity, weights=weights)).backward()
    assert not vertices.grad[:, weights == 0].any()


@pytest.mark.parametrize("options", [{"robust": 0.01}, {"priors": PosePriors(temporal_strength=0.01)}])
def test_what_has_no_derivative_here_says_so(layer, identity, targets, options):
    vertices = targets.clone().requires_grad_()
    with pytest.raises(InputError, match="a tensor that requires a gradient"):
        PoseInversion(layer, **options)(vertices, identity)
