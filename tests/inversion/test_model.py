"""The forward model as a fit sees it: its errors are distances to what the layer poses."""

import functools

import numpy as np
import pytest
import torch

from soma_core.inversion.model import PoseModel
from soma_core.inversion.problem import part_of
from tests.bodies import randn
from tests.inversion.driven_layers import as_pose, layer_of
from tests.inversion.small_problem import real, synthetic

SAME_M = 1e-12
"""Metres, float64: the same sums in another order."""
FRAMES = 33
"""More than the reference poses at a time."""


@functools.cache
def model_of(*, correct, warp, plain=False):
    return PoseModel(layer_of(correct=correct), plain=plain, warp=warp)


def given(layer, frames, who, weighted):
    """Identity, weights, rotations and Hips; targets 50 mm off what the layer poses."""
    identity = layer.identity({"shape": randn(who, 16, seed=1)})
    weights = real().vertex_weights(weighted)
    rotations, hips = real().poses(frames)
    return identity, weights, rotations, hips


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
@pytest.mark.parametrize("plain", [False, True], ids=["whole", "plain"])
@pytest.mark.parametrize(("who", "weighted"), [(1, 1), (FRAMES, 1), (1, FRAMES)])
def test_errors_are_distances_under_the_forward_model(who, weighted, plain, warp):
    layer, model = layer_of(correct=True), model_of(correct=True, warp=warp, plain=plain)
    identity, weights, rotations, hips = given(layer, FRAMES, who, weighted)
    reached = (layer.pose_plain if plain else layer.pose)(identity, rotations, hips).vertices
    vertices = reached + 0.05 * randn(*reached.shape, seed=4)
    problem = model.problem(vertices, identity, weights, None, None, None)
    pose = as_pose(rotations, hips - problem.origin)
    error, energy = model.distances(problem, pose)
    expected = (reached - vertices).norm(dim=-1)
    torch.testing.assert_close(error, expected, atol=SAME_M, rtol=0)
    torch.testing.assert_close(energy, (weights * expected.square()).sum(1), rtol=1e-12, atol=0)
    none, same = model.distances(problem, pose, energy_only=True)
    assert none is None
    torch.testing.assert_close(same, energy, rtol=1e-12, atol=0)


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_no_weight_at_all_is_no_error(warp):
    layer, model = layer_of(correct=True), model_of(correct=True, warp=warp)
    identity, weights, rotations, hips = given(layer, 2, 1, 1)
    vertices = randn(2, layer.mesh.vertex_count, 3, seed=4)
    problem = model.problem(vertices, identity, 0 * weights, None, None, None)
    _, energy = model.distances(problem, as_pose(rotations, hips - problem.origin))
    assert torch.equal(energy, torch.zeros_like(energy))


def test_a_model_of_some_vertices_sees_those_alone():
    layer = layer_of(correct=True)
    some = np.sort(np.random.default_rng(0).choice(layer.mesh.vertex_count, 900, replace=False))
    some.setflags(write=False)
    model = PoseModel(layer, plain=False, warp=False, some=some)
    identity, weights, rotations, hips = given(layer, 2, 1, 1)
    reached = layer.pose(identity, rotations, hips).vertices
    vertices = reached + 0.05 * randn(*reached.shape, seed=4)
    problem = model.problem(vertices, identity, weights, None, None, None)
    error, _ = model.distances(problem, as_pose(rotations, hips - problem.origin))
    torch.testing.assert_close(
        error, (reached - vertices).norm(dim=-1)[:, some.tolist()], atol=SAME_M, rtol=0
    )


def test_a_part_of_identities_is_those_of_its_frames():
    body = synthetic()
    many, one = body.identities(5), body.identities(1)
    part = part_of(many, slice(1, 3))
    assert part.batch_size == 2
    assert torch.equal(part.rest, many.rest[1:3])
    assert torch.equal(part.bind_world, many.bind_world[1:3])
    assert part_of(one, slice(1, 3)) is one
