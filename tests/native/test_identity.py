"""An unknown identity from posed meshes: what made them is found, whatever it was."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion
from soma_core.inversion.free_parameters import FreeParameters, WithJoints
from soma_core.layer import SomaLayer
from soma_core.native.identity import fit_identity
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import Parameter
from tests.bodies import TinyPlugin, randn, tiny_canonical, tiny_spec, write_pair
from tests.plugin.fakes import FakeEntryPoint

FRAMES = 8
REST_MM = 0.05
"""Own-model meshes hold their shape exactly; the descent ends when it no longer changes noticeably."""
ELSEWHERE_MM = 0.05
"""The fingers keep their centres; a shape that made up for those of the others would be 0.4 off."""
UNPOSED_MM = 1.0
"""Every vertex is free, and joints are where the free surface says."""


@pytest.fixture(scope="module")
def layer(tmp_path_factory):
    params = (Parameter(name="shape", shape=(4,)), Parameter(name="size", default=1.0, range=(0.6, 1.5)))
    spec = tiny_spec(write_pair(tmp_path_factory.mktemp("tiny")), params=params)
    registry = Registry([FakeEntryPoint("tiny", TinyPlugin(spec))])
    return SomaLayer("tiny", dtype=torch.float64, canonical=tiny_canonical(), registry=registry)


@pytest.fixture(scope="module")
def truth(layer):
    return layer.identity({"shape": 0.8 * randn(1, 4, seed=1), "size": 0.95})


@pytest.fixture(scope="module")
def vertices(layer, truth):
    return layer.pose_plain(truth, 0.3 * randn(FRAMES, 77, 3, seed=2), randn(FRAMES, 3, seed=3)).vertices


def rest_error(layer, found, truth):
    """Mean distance [mm] of the skin of two rest shapes about their means."""
    skin = PoseInversion(layer).default_weights > 0
    step = (found.rest - truth.rest)[0, skin]
    return float((step - step.mean(0)).norm(dim=-1).mean() * 1e3)


@pytest.mark.slow
def test_parameters_of_our_own_bodies_are_found(layer, truth, vertices):
    found = fit_identity(layer, vertices)
    assert found.converged
    assert rest_error(layer, found.identity, truth) < REST_MM
    default = PoseInversion(layer)(vertices, layer.identity({}))
    assert found.pose.residual.mean() < 0.02 * default.residual.mean()
    assert set(found.params) == {"shape", "size"}


def test_unposing_needs_no_parameters(layer, truth, vertices):
    found = fit_identity(layer, vertices, method="unpose", free=())
    assert rest_error(layer, found.identity, truth) < UNPOSED_MM
    default = PoseInversion(layer)(vertices, layer.identity({}))
    assert found.pose.residual.mean() < 0.1 * default.residual.mean()


def test_parameters_that_are_not_free_stay(layer, vertices):
    found = fit_identity(layer, vertices, start={"size": 1.2}, free=("shape",), frames=2, iterations=1)
    assert float(found.params["size"]) == 1.2
    assert len(found.frames) == 2
    assert len(found.pose.rotations) == FRAMES


def test_joints_that_are_elsewhere_do_not_bend_the_shape(layer, truth):
    """Another model turns the same body about centres up to two centimetres away."""
    unknowns = WithJoints(FreeParameters(layer), layer)
    count = len(unknowns.parameters.start)
    point = unknowns.start.copy()
    point[count:] = np.random.default_rng(5).uniform(-1, 1, len(point) - count)
    shifts = unknowns.identities(point[None]).bind_world - layer.identity().bind_world
    other = replace(truth, bind_world=truth.bind_world + shifts)
    turns = axis_angle_to_matrix(0.3 * randn(FRAMES, 77, 3, seed=2))
    vertices = layer.animation.pose(other, turns, randn(FRAMES, 3, seed=3), absolute=False).vertices
    found = fit_identity(layer, vertices)
    assert rest_error(layer, found.identity, truth) < ELSEWHERE_MM
    known = PoseInversion(layer)(vertices, truth)
    assert found.pose.residual.mean() < 1.01 * known.residual.mean()


def test_frames_that_cannot_be_used_are_left_out(layer, truth, vertices):
    spoilt = vertices.clone()
    spoilt[2] = torch.nan
    found = fit_identity(layer, spoilt, frames=FRAMES, free=("shape",), iterations=1)
    assert found.frames.tolist() == [0, 1, 3, 4, 5, 6, 7]
    assert not found.pose.valid[2]
    with pytest.raises(InputError, match="vertices: got 1 frames of which none can be used"):
        fit_identity(layer, spoilt[2:3])


@pytest.mark.parametrize(
    ("options", "text"),
    [({"method": "guess"}, "'guess'"), ({"free": ("shoe",)}, "shoe"), ({"frames": 0}, "0")],
)
def test_options_that_make_no_sense_are_refused(layer, vertices, options, text):
    with pytest.raises(InputError, match=text):
        fit_identity(layer, vertices, **options)
