"""Moments of frames that each have an identity or vertex weights of their own: the twin of the reference."""

import pytest
import torch

from soma_core.kernels import _lanes
from soma_core.kernels import frame_moments_wp as kernel
from tests.inversion.small_problem import real, synthetic

RELATIVE = {torch.float64: 1e-9, torch.float32: 2e-5}
"""To the largest entry: the reference sums in float64; float32 sums thousands of terms one by one."""


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("body", [synthetic, real], ids=["synthetic", "real"])
@pytest.mark.parametrize(("who", "weighted"), [(1, 7), (7, 1), (7, 7), (17, 17)])
def test_the_sums_are_those_of_the_reference(body, who, weighted, dtype):
    compare(body(), who, weighted, dtype)


@pytest.mark.parametrize("batch", [1, 5])
def test_the_layout_of_a_gpu_gives_the_same(batch, monkeypatch):
    for module in (kernel, _lanes):
        monkeypatch.setattr(module, "lane_count", lambda tensor: 1)
    compare(synthetic(), batch, batch, torch.float64)


def compare(body, who, weighted, dtype):
    frames = max(who, weighted)
    identity = body.identities(who, dtype=dtype)
    weights = body.vertex_weights(weighted, dtype=dtype)
    turns, hips = body.poses(frames, dtype=dtype)
    vertices = body.posed(identity, turns, hips)
    offsets = body.animation(dtype).kinematics.local_offsets(identity.bind_world)
    found, target, origin = body.moments(dtype, warp=True).each(vertices, identity, weights, offsets)
    expected, reference, begin = body.moments(dtype).each(vertices, identity, weights, offsets)
    torch.testing.assert_close(origin, begin, atol=0, rtol=0)
    for ours, theirs in ((found.own, expected.own), (found.second, expected.second), (target, reference)):
        theirs = theirs.expand_as(ours)
        torch.testing.assert_close(ours, theirs, atol=RELATIVE[dtype] * float(theirs.abs().max()), rtol=0)
