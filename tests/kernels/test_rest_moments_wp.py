"""Moments of one rest shape in Warp: those of the torch reference, to rounding of float64."""

import pytest
import torch

from soma_core.inversion.moments import SkinMoments
from soma_core.kernels import rest_moments_wp
from tests.inversion.small_problem import real, synthetic
from tests.kernels.parity import DEVICES, DTYPES

FIELDS = ("local", "weight", "own", "second")
SAME = {torch.float32: 1e-7, torch.float64: 1e-15}
"""Relative to the largest entry; float32 is a rounded float64."""


def moments(body, dtype, *, warp, device="cpu", **changes):
    run = SkinMoments(body.structure, body.rig, dtype=dtype, device=device, warp=warp)
    identity, weights = body.identities(1, dtype=dtype), body.vertex_weights(1, dtype=dtype)
    offsets = body.animation(dtype).kinematics.local_offsets(identity.bind_world)
    names = ("rest", "bind_world", "fitted_rest", "fitted_world")
    given = {name: getattr(identity, name).to(device) for name in names}
    return run.rest(type(identity)(**given | changes), weights.to(device), offsets.to(device))


def assert_near(found, expected):
    for name in FIELDS:
        ours, theirs = getattr(found, name), getattr(expected, name)
        bound = SAME[theirs.dtype] * float(theirs.abs().max())
        torch.testing.assert_close(ours, theirs, atol=bound, rtol=0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("body", [synthetic, real], ids=["synthetic", "real"])
def test_the_twin_agrees(body, dtype, device):
    expected = moments(body(), dtype, warp=False, device=device)
    assert_near(moments(body(), dtype, warp=True, device=device), expected)


def test_the_layout_of_a_gpu_gives_the_same(monkeypatch):
    expected = moments(synthetic(), torch.float64, warp=True)
    monkeypatch.setattr(rest_moments_wp, "_lanes", lambda tensor: 1)
    assert_near(moments(synthetic(), torch.float64, warp=True), expected)


def test_a_derivative_goes_by_the_reference():
    rest = synthetic().identities(1).rest.requires_grad_()
    found = moments(synthetic(), torch.float64, warp=True, rest=rest)
    assert torch.isfinite(torch.autograd.grad(found.second.sum(), rest)[0]).all()
