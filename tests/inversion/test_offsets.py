"""What a pose adds to the rest shape: as the layer adds it, its slope exact, its matrix near the true one."""

import functools

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion.model import PoseModel
from soma_core.inversion.offsets import _LEAST_MODE, PoseOffsets
from tests.bodies import CPU, randn
from tests.inversion.driven_layers import as_pose, jacobian, layer_of, poses, problem_of
from tests.inversion.small_problem import synthetic

EXACT = 1e-12
"""Relative, float64: the same sums in another order."""
DIFFERENCES = 1e-7
"""Relative: central differences over 1e-5 in float64."""
CLOSE = 0.5, 2.0
"""Generalised eigenvalues of the matrix and the dense one: a step is wrong by less than a factor of two."""
KINDS = ("rest", "random", "turned", "bent")
HIPS = torch.tensor([[0.1, 0.9, -0.2]], dtype=torch.float64)


@functools.cache
def shipped():
    layer = layer_of(correct=True)
    return layer, PoseModel(layer, plain=False, warp=False)


@functools.cache
def moving(kind):
    """Targets 10 mm off a pose: its view's ingredients, and the dense motion of the fitted vertices."""
    layer, model = shipped()
    identity, rotations = layer.identity({"shape": randn(1, 16, seed=1)}), poses(layer, kind)
    columns = jacobian(layer, model, identity, rotations, HIPS).flatten(1)
    reached = layer.pose(identity, rotations, HIPS).vertices
    targets = reached + 0.01 * randn(*reached.shape, seed=2)
    problem = problem_of(model, identity, targets)
    away = (reached - targets)[0, torch.as_tensor(model.fitted)]
    return problem, as_pose(rotations, HIPS - problem.origin), columns, away


def with_root(rotations):
    return as_pose(rotations, torch.zeros(len(rotations), 3, dtype=torch.float64)).relative


@pytest.mark.parametrize("kind", KINDS)
def test_activations_and_offsets_are_those_of_the_layer(kind):
    layer, model = shipped()
    rotations, correctives = poses(layer, kind), layer.correctives
    found = model.offsets.activity(with_root(rotations))
    before = correctives.first(correctives.features(rotations).flatten(1).T.contiguous()).T
    torch.testing.assert_close(found.before, before, atol=EXACT * float(before.abs().max()), rtol=0)
    expected = torch.tanh(torch.relu(before)) if correctives.use_tanh else torch.relu(before)
    torch.testing.assert_close(found.value, expected, atol=EXACT * float(before.abs().max()), rtol=0)
    identity = layer.identity({"shape": randn(1, 16, seed=1)})
    scale = correctives.scale(identity.bind_world)
    moved = scale * model.offsets.shapes(found.value.T.contiguous()).view(-1, 3)
    torch.testing.assert_close(moved, correctives(rotations, identity.bind_world)[0], atol=EXACT, rtol=0)


def test_slopes_of_activations_are_those_of_their_values():
    _, model = shipped()
    before = randn(1000, seed=1).requires_grad_()
    value = model.offsets.squashed(before)
    (expected,) = torch.autograd.grad(value.sum(), before)
    rising = (before > 0).to(before)
    found = rising * (1 - value * value) if model.offsets.squash else rising
    torch.testing.assert_close(found, expected, atol=EXACT, rtol=0)


def assert_slopes(offsets, rotations):
    """Against automatic differentiation by world-frame turns of every joint."""
    relative = with_root(rotations)
    pull = randn(len(relative), offsets.shapes.shape[1], seed=7)
    above = axis_angle_to_matrix(randn(*relative.shape[:2], 3, seed=8))  # whatever the joints above do
    step = torch.zeros(*relative.shape[:2], 3, dtype=torch.float64, requires_grad=True)
    local = (above.mT @ step[..., None]).squeeze(-1)
    energy = (offsets.activity(axis_angle_to_matrix(local) @ relative).value * pull).sum()
    (expected,) = torch.autograd.grad(energy, step)
    found = offsets.slopes(pull, offsets.activity(relative), relative, above)
    expected[:, 0] = found[:, 0]  # the root does not turn
    torch.testing.assert_close(found, expected, atol=EXACT * float(expected.abs().max()), rtol=0)
    assert (expected.abs().amax((0, 2)) > 0).sum() > 20


@pytest.mark.parametrize("kind", KINDS)
def test_slopes_are_those_of_automatic_differentiation(kind):
    layer, model = shipped()
    assert_slopes(model.offsets, poses(layer, kind))


def linear_offsets(body):
    """Offsets that are linear in all nine entries of every joint's rotation, as pose blend shapes are."""
    joints, vertices = body.rig.joint_count, body.mesh.vertex_count
    turns = axis_angle_to_matrix(randn(2, joints, 3, seed=1)).numpy()
    random = np.random.default_rng(0)
    shapes = scipy.sparse.random_array((3 * vertices, 9 * joints), density=0.02, rng=random)
    return PoseOffsets(
        left=turns[0], right=turns[1], still=turns[0] @ turns[1], first=None, squash=False,
        shapes=scipy.sparse.csr_array(shapes), owner=np.repeat(np.arange(joints), 9), rig=body.rig,
        joints=body.structure.joints, fitted=body.structure.fitted, dtype=torch.float64, device=CPU,
    )  # fmt: skip


def test_linear_offsets_vanish_at_rest_and_have_exact_slopes():
    body = synthetic()
    offsets, (rotations, _) = linear_offsets(body), body.poses(3)
    rest = torch.eye(3, dtype=torch.float64).repeat(1, body.rig.joint_count, 1, 1)
    assert offsets.activity(rest).value.abs().max() < EXACT
    assert offsets.activity(rest).before is None
    assert_slopes(offsets, rotations)


@pytest.mark.parametrize("kind", KINDS)
def test_the_slope_of_the_whole_model_is_that_of_its_vertices(kind):
    """And its matrix, of moments and modes, close to that of the vertices."""
    _, model = shipped()
    problem, pose, columns, away = moving(kind)
    view = model.view(problem, pose)
    torch.testing.assert_close(view.energy, away.square().sum()[None], rtol=1e-9, atol=0)
    slope = columns @ away.flatten()
    bound = DIFFERENCES * float(slope.abs().max())
    torch.testing.assert_close(view.slope.flatten(), slope, atol=bound, rtol=0)
    matrix, dense = (
        model.matrix(problem, pose, view.turns, view.places, view.activity).reshape(len(columns), -1),
        columns @ columns.T,
    )
    torch.testing.assert_close(matrix, matrix.T, atol=EXACT * float(matrix.max()), rtol=0)
    values = scipy.linalg.eigh(matrix.numpy(), dense.numpy(), eigvals_only=True)
    assert CLOSE[0] < values.min()
    assert values.max() < CLOSE[1]


def test_clipped_residuals_have_the_slope_of_the_clipped_energy():
    _, model = shipped()
    problem, pose, columns, away = moving("random")
    bound = torch.tensor([0.015], dtype=torch.float64)
    view = model.view(problem, pose, bound)
    far = away.norm(dim=-1)
    near = far.minimum(bound)
    assert 0.2 < (far > bound).double().mean() < 0.8
    torch.testing.assert_close(view.energy[0], (near * (2 * far - near)).sum(), rtol=1e-9, atol=0)
    slope = columns @ (away * (near / far)[:, None]).flatten()
    bound = DIFFERENCES * float(slope.abs().max())
    torch.testing.assert_close(view.slope.flatten(), slope, atol=bound, rtol=0)


def test_modes_of_a_joint_are_orthonormal_and_hold_its_shapes():
    _, model = shipped()
    offsets = model.offsets
    blocks, width = offsets.modes.shape[:2]
    size = offsets.gram.view(blocks, width, blocks, width).diagonal(dim1=0, dim2=2).diagonal(dim1=0, dim2=1)
    for modes, gained in zip(offsets.modes, size, strict=True):
        kept = modes.norm(dim=1) > 0
        eye = torch.eye(int(kept.sum()), dtype=torch.float64)
        torch.testing.assert_close(modes[kept] @ modes[kept].T, eye, atol=1e-9, rtol=0)
        assert (gained[~kept] == 0).all()


def test_what_a_limbs_joints_see_is_what_its_activations_read_and_move():
    """Coordinates of `seen_by` move the fitted vertices by as much as the activations do."""
    layer, model = shipped()
    names = list(layer.rig.joint_names)
    own, end = names.index("LeftArm"), names.index("LeftForeArm")
    seen = model.offsets.seen_by(own, end)
    change = torch.zeros(1, model.offsets.shapes.shape[1], dtype=torch.float64)
    change[0, seen["ids"]] = randn(len(seen["ids"]), seed=3)
    moved = model.offsets.shapes(change.T.contiguous()).view(-1, 3)[torch.as_tensor(model.fitted)]
    found = (change[0, seen["ids"]] @ seen["shapes"]).square().sum()
    left_out = change.square().sum() * _LEAST_MODE**2 * model.fitted.sum()
    assert 0 <= moved.square().sum() - found < left_out
    relative = with_root(poses(layer, "random"))
    turned = relative.clone()
    for joint, which in ((own, 1), (end, 2)):
        turned[:, joint] = axis_angle_to_matrix(randn(1, 3, seed=which)) @ turned[:, joint]
    before, after = (model.offsets.activity(one).before[0] for one in (relative, turned))
    steps = [
        (model.offsets.features(turned[0, joint], joint) - model.offsets.features(relative[0, joint], joint))
        for joint in (own, end)
    ]
    expected = seen["by_own"] @ steps[0] + seen["by_end"] @ steps[1]
    found = after - before
    torch.testing.assert_close(found[seen["ids"]], expected, atol=1e-9, rtol=0)
    found[seen["ids"]] = 0
    assert found.abs().max() < 1e-9
