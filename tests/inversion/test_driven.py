"""Twist joints inside the solver: they lie where the layer has them, and their derivative is the model's."""

import functools

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.inversion.driven import half_angle
from soma_core.inversion.model import PoseModel
from tests.bodies import randn
from tests.inversion.driven_layers import MODES, as_pose, jacobian, layer_of, poses, problem_of

EXACT = 1e-12
"""[m] and entries of rotations, float64: the same products in another order."""
DIFFERENCES = 1e-7
"""Relative: central differences over 1e-5 in float64."""
KINDS = ("rest", "random", "turned", "bent")
HIPS = torch.tensor([[0.1, 0.9, -0.2]], dtype=torch.float64)


@functools.cache
def model_of(mode):
    return PoseModel(layer_of(mode), plain=False, warp=False)


def identity_of(layer, count=1):
    return layer.identity({"shape": randn(count, 16, seed=1)})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mode", MODES)
def test_twist_joints_lie_where_the_layer_has_them(mode, kind):
    layer, model = layer_of(mode), model_of(mode)
    identity, rotations = identity_of(layer), poses(layer, kind)
    posed = layer.pose(identity, rotations, HIPS)
    problem = problem_of(model, identity, posed.vertices)
    pose = as_pose(rotations, HIPS - problem.origin)
    turns, places = model.walk(pose, problem.rest)
    helpers = layer.helper_transforms(identity, posed.transforms)
    count = model.driven.public_count
    bind = model.driven.twist.bind_rotations(identity.bind_world)
    found = turns[:, count:] @ (model.orient[count:] @ bind.mT) @ bind  # world rotations
    torch.testing.assert_close(found, helpers[..., :3, :3], atol=EXACT, rtol=0)
    torch.testing.assert_close(
        places[:, count:] + problem.origin[:, None], helpers[..., :3, 3], atol=EXACT, rtol=0
    )
    assert orthonormality_error(turns).max() < EXACT
    distances, _ = model.distances(problem, pose)
    assert distances.max() < EXACT


def test_bone_scales_carry_twist_joints_along():
    layer, model = layer_of(), model_of(MODES[0])
    identity, rotations = identity_of(layer), poses(layer, "random")
    scale = 1 + 0.2 * randn(1, len(layer.joint_names), seed=3).clamp(-1, 1)
    posed = layer.pose(identity, rotations, HIPS, bone_scale=scale)
    problem = problem_of(model, identity, posed.vertices, scale)
    distances, _ = model.distances(problem, as_pose(rotations, HIPS - problem.origin))
    assert distances.max() < EXACT


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mode", MODES)
def test_folded_equations_are_those_of_the_layers_own_skinning(mode, kind):
    layer, model = layer_of(mode), model_of(mode)
    identity, rotations = identity_of(layer), poses(layer, kind)
    columns = jacobian(layer, model, identity, rotations, HIPS).flatten(1)
    reached = layer.pose(identity, rotations, HIPS).vertices
    targets = reached + 0.01 * randn(*reached.shape, seed=2)
    problem = problem_of(model, identity, targets)
    solver, rest = model.solver, problem.rest
    turns, places = solver.walk(as_pose(rotations, HIPS - problem.origin), rest)
    residual = solver.gradient(turns, places, solver.dense(rest.second), problem.target)
    matrix, slope = solver.normal_equations(turns, places, rest, residual)
    away = (reached - targets)[0, torch.as_tensor(model.fitted)].flatten()
    expected = columns @ columns.T, columns @ away
    for mine, theirs in zip((matrix.reshape(expected[0].shape), slope.flatten()), expected, strict=True):
        torch.testing.assert_close(mine, theirs, atol=DIFFERENCES * float(theirs.abs().max()), rtol=0)
    torch.testing.assert_close(solver.slopes(turns, places, rest, residual), slope, atol=0, rtol=0)


def test_the_whole_models_slope_without_offsets_is_that_of_the_moments():
    layer, model = layer_of(), model_of(MODES[0])
    identity, rotations = identity_of(layer), poses(layer, "random")
    targets = layer.pose(identity, rotations, HIPS).vertices
    problem = problem_of(model, identity, targets + 0.01 * randn(*targets.shape, seed=2))
    view = model.view(problem, as_pose(rotations, HIPS - problem.origin))
    solver, rest = model.solver, problem.rest
    residual = solver.gradient(view.turns, view.places, solver.dense(rest.second), problem.target)
    torch.testing.assert_close(view.residual, residual, atol=1e-9, rtol=0)
    expected = solver.slopes(view.turns, view.places, rest, residual)
    torch.testing.assert_close(view.slope, expected, atol=1e-9, rtol=0)


def test_identities_of_their_own_are_read_with_their_own_bones():
    layer, model = layer_of(), model_of(MODES[0])
    identity, rotations = identity_of(layer, 3), poses(layer, "random").repeat(3, 1, 1, 1)
    targets = layer.pose(identity, rotations, HIPS.expand(3, 3)).vertices
    problem = problem_of(model, identity, targets)
    pose = as_pose(rotations, HIPS - problem.origin)
    distances, _ = model.distances(problem, pose)
    assert distances.max() < EXACT
    rows = torch.tensor([2, 0])
    part, _ = model.distances(problem.part(rows), pose.part(rows))
    torch.testing.assert_close(part, distances[rows], atol=EXACT, rtol=0)


def test_half_angles_are_the_twist_and_rise_with_it():
    """Turns about the axis are read as they are, up to half a turn; swings alone read as none."""
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    turns = torch.linspace(-179.9, 179.9, 41, dtype=torch.float64).deg2rad()
    angle, slope = half_angle(axis_angle_to_matrix(turns[:, None] * axis), axis)
    torch.testing.assert_close(angle, turns, atol=1e-9, rtol=0)
    torch.testing.assert_close(slope, axis.expand(41, 3), atol=1e-9, rtol=0)
    across = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    angle, _ = half_angle(axis_angle_to_matrix(turns[:, None] * across), axis)
    torch.testing.assert_close(angle, torch.zeros_like(angle), atol=1e-9, rtol=0)
