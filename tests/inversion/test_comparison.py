"""The error of a reconstruction: by the forward model, whatever computes it."""

from types import SimpleNamespace

import pytest
import torch

from soma_core.inversion.comparison import compare, part_of
from soma_core.inversion.problem import Problem
from tests.bodies import randn
from tests.inversion.small_problem import synthetic

BODY = synthetic()
SAME_M = {torch.float64: 1e-13, torch.float32: 2e-6}
"""Metres: the same sums in another order, on a body of two metres."""


def problem(frames, *, who=1, weighted=1, dtype=torch.float64):
    identity, weights = BODY.identities(who, dtype=dtype), BODY.vertex_weights(weighted, dtype=dtype)
    vertices = randn(frames, BODY.mesh.vertex_count, 3, seed=4, dtype=dtype)
    rest = BODY.rest(identity, weights)
    target, origin = BODY.moments(dtype).target(vertices, rest)
    return Problem(
        vertices=vertices, weights=weights, identity=identity, rest=rest, target=target, origin=origin
    )


def layer(dtype=torch.float64):
    """What is asked of a layer that skins by the public joints alone."""
    animation = BODY.animation(dtype)
    return SimpleNamespace(plain=True, animation=animation, pose_checked=animation.pose_body)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
@pytest.mark.parametrize(("who", "weighted"), [(1, 1), (40, 1), (1, 40)])
def test_errors_are_distances_under_the_forward_model(who, weighted, warp, dtype):
    """More frames than are posed at a time."""
    given, (rotations, hips) = (
        problem(40, who=who, weighted=weighted, dtype=dtype),
        BODY.poses(40, dtype=dtype),
    )
    error, residual = compare(layer(dtype), given, rotations, hips, warp=warp)
    expected = (BODY.posed(given.identity, rotations, hips) - given.vertices).norm(dim=-1)
    torch.testing.assert_close(error, expected, atol=SAME_M[dtype], rtol=0)
    mean = (given.weights * expected.square()).sum(1) / given.weights.sum(1)
    torch.testing.assert_close(residual, mean.sqrt(), atol=SAME_M[dtype], rtol=0)


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_the_exact_pose_has_no_error(warp):
    given, (rotations, hips) = problem(3), BODY.poses(3)
    given.vertices[:] = BODY.posed(given.identity, rotations, hips)
    error, residual = compare(layer(), given, rotations, hips, warp=warp)
    assert error.max() < SAME_M[torch.float64]
    assert residual.max() < SAME_M[torch.float64]


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_no_weight_at_all_is_no_division_by_zero(warp):
    given, (rotations, hips) = problem(2), BODY.poses(2)
    given.weights[:] = 0
    _, residual = compare(layer(), given, rotations, hips, warp=warp)
    assert torch.equal(residual, torch.zeros_like(residual))


def test_a_part_of_identities_is_those_of_its_frames():
    many = BODY.identities(5)
    part = part_of(many, slice(1, 3))
    assert part.batch_size == 2
    assert torch.equal(part.rest, many.rest[1:3])
    assert torch.equal(part.bind_world, many.bind_world[1:3])
    one = BODY.identities(1)
    assert part_of(one, slice(1, 3)) is one
