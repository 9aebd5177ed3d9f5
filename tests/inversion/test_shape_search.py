"""The descent over shapes: it stays inside the bounds, goes down, and trusts what can be explained."""

import numpy as np
import pytest
import torch

from soma_core.inversion import PoseInversion
from soma_core.inversion.free_parameters import FreeParameters
from soma_core.inversion.shape_search import Sample, search_parameters
from soma_core.layer import SomaLayer
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import Parameter
from tests.bodies import TinyPlugin, randn, tiny_canonical, tiny_spec, write_pair
from tests.plugin.fakes import FakeEntryPoint

FRAMES = 5
NOTHING_M = 5e-5
"""The descent ends where a step no longer changes the error noticeably."""
SAME = 1e-3
"""Relative: the same fit begun from elsewhere."""
NEAR = 0.05
"""Of a coefficient: bulges of three centimetres on a tenth of the skin still count a little."""


@pytest.fixture(scope="module")
def inversion(tmp_path_factory):
    params = (Parameter(name="shape", shape=(4,)), Parameter(name="size", default=1.0, range=(0.6, 1.5)))
    spec = tiny_spec(write_pair(tmp_path_factory.mktemp("tiny")), params=params)
    registry = Registry([FakeEntryPoint("tiny", TinyPlugin(spec))])
    return PoseInversion(
        SomaLayer("tiny", dtype=torch.float64, canonical=tiny_canonical(), registry=registry)
    )


def sample(inversion, params):
    layer = inversion.layer
    turns, hips = 0.3 * randn(FRAMES, 77, 3, seed=2), randn(FRAMES, 3, seed=3)
    vertices = layer.pose_plain(layer.identity(params), turns, hips).vertices
    return Sample(vertices=vertices, weights=inversion.default_weights[None])


def search(inversion, frames, names):
    return search_parameters(inversion, frames, FreeParameters(inversion.layer, None, names), iterations=8)


def test_errors_are_weighted_means_over_frames(inversion):
    frames = sample(inversion, {})
    pose = inversion(frames.vertices, inversion.layer.identity(), weights=frames.weights)
    expected = pose.vertex_error[:, inversion.default_weights > 0].square().mean().sqrt()
    assert frames.error(pose) == pytest.approx(float(expected))
    spoilt = Sample(vertices=frames.vertices * torch.nan, weights=frames.weights)
    assert np.isinf(spoilt.error(inversion(spoilt.vertices, inversion.layer.identity())))
    assert not spoilt.without_gaps().vertices[:, inversion.default_weights == 0].any()
    assert len(frames.some(2).vertices) == 2
    torch.testing.assert_close(frames.some(2).vertices, frames.vertices[[0, -1]], atol=0, rtol=0)


def test_the_error_goes_down_to_nothing_where_a_body_explains_all(inversion):
    found = search(inversion, sample(inversion, {"shape": [0.9, -0.5, 0.4, 0.7]}), ["shape"])
    assert found.converged
    assert found.history[-1] < NOTHING_M


def test_a_body_outside_the_range_is_met_at_the_bound(inversion):
    found = search(inversion, sample(inversion, {"size": 1.6}), ["size"])
    assert float(found.identity.params["size"]) == pytest.approx(1.5)


def test_what_no_body_explains_counts_less(inversion):
    """A bulge on a tenth of the skin, in every frame: clothes, or another model's way of bending."""
    shape = [0.9, -0.5, 0.4, 0.7]
    frames = sample(inversion, {"shape": shape})
    bulging = torch.zeros(frames.vertices.shape[1], dtype=torch.bool)
    bulging[::10] = True
    vertices = frames.vertices + 0.03 * bulging[:, None]
    found = search(inversion, Sample(vertices=vertices, weights=frames.weights), ["shape"])
    np.testing.assert_allclose(found.identity.params["shape"][0], shape, atol=NEAR)


def test_a_single_frame_ends_at_the_least_error_of_the_parameters(inversion):
    """No joint centre is free that would be dropped in the end, and every vertex counts alike."""
    frames = sample(inversion, {"shape": [0.9, -0.5, 0.4, 0.7]})
    frame = Sample(vertices=frames.vertices[:1] + 0.01 * randn(1, 1, 3, seed=4), weights=frames.weights)
    frame.vertices[:, ::10] += 0.03
    found = search(inversion, frame, ["shape"])
    assert list(found.history) == sorted(found.history, reverse=True)
    pose = inversion(frame.vertices, found.identity, weights=frame.weights)
    assert frame.error(pose) == pytest.approx(found.history[-1], rel=SAME)
