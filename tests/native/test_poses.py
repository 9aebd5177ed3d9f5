"""Poses of a native model under the whole of it, on a small one."""

from __future__ import annotations

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from tests.native.small_model import make_fit, make_model, make_rig, random_pose

EXACT = 1e-6
"""Metres and radians: float64, and steps until the energy moves by less than a nanometre, squared."""
SLOPE = 1e-6
"""Slope of the energy at a minimum, relative to the slope where the fit of the skinning ends."""
FRAMES = 3


@pytest.fixture(scope="module", params=["linear", "curved", "none"])
def small(request):
    model = make_model(blend=request.param)
    rig = make_rig(model)
    return model, rig, make_fit(rig, model)


def targets(rig, fit):
    turns, pelvis = random_pose(FRAMES)
    rotations = axis_angle_to_matrix(turns)
    return rig.posed(fit.body.identity, rotations, pelvis), rotations, pelvis


def energy(rig, fit, target, turns, pelvis):
    step = rig.posed(fit.body.identity, axis_angle_to_matrix(turns), pelvis) - target
    return step.square().sum()


def test_poses_of_the_model_itself_are_recovered(small):
    _, rig, fit = small
    target, rotations, pelvis = targets(rig, fit)
    pose = fit(target)
    torch.testing.assert_close(pose.relative[:, 1:], rotations, atol=EXACT, rtol=0)
    torch.testing.assert_close(pose.translation, pelvis, atol=EXACT, rtol=0)


@pytest.mark.parametrize("kernels", ["torch", "auto"])
def test_blend_shapes_may_move_nothing(kernels):
    model = make_model(blend="zero")
    rig = make_rig(model, kernels=kernels)
    fit = make_fit(rig, model)
    target, rotations, _ = targets(rig, fit)
    torch.testing.assert_close(fit(target).relative[:, 1:], rotations, atol=EXACT, rtol=0)


def test_no_slope_is_left_where_the_target_is_out_of_reach(small):
    _, rig, fit = small
    target, _, _ = targets(rig, fit)
    noise = torch.randn(target.shape, generator=torch.Generator().manual_seed(1), dtype=target.dtype)
    target = target + 0.02 * noise

    def slope(pose):
        turns = torch.zeros(FRAMES, len(rig.joint_names), 3, dtype=target.dtype, requires_grad=True)
        pelvis = pose.translation.clone().requires_grad_()
        relative = axis_angle_to_matrix(turns) @ pose.relative[:, 1:]
        step = rig.posed(fit.body.identity, relative, pelvis) - target
        return (
            torch.cat([one.flatten() for one in torch.autograd.grad(step.square().sum(), (turns, pelvis))])
            .abs()
            .max()
        )

    start = fit._skinned(fit.problem(target))
    start = type(start)(**(vars(start) | {"relative": start.relative.roll(1, 0)}))
    assert slope(fit(target)) < SLOPE * slope(start)


def test_the_whole_model_is_never_further_off_than_its_skinning(small):
    model, rig, fit = small
    target, _, _ = targets(rig, fit)
    target = target + 0.05 * torch.sin(40 * target)
    skinned = make_fit(rig, model, iterations=0)(target)
    for steps in (1, 3):
        pose = make_fit(rig, model, iterations=steps)(target)
        before, after = ((fit.posed(one) - target).square().sum((1, 2)) for one in (skinned, pose))
        assert bool((after <= before).all())


def test_a_turned_body_far_away_has_the_same_pose(small):
    _, rig, fit = small
    target, _, _ = targets(rig, fit)
    turn = axis_angle_to_matrix(torch.tensor([0.4, -1.0, 2.0], dtype=target.dtype))
    pose, moved = fit(target), fit(target @ turn.T + 5.0)
    torch.testing.assert_close(moved.relative[:, 1], turn @ pose.relative[:, 1], atol=EXACT, rtol=0)
    torch.testing.assert_close(moved.relative[:, 2:], pose.relative[:, 2:], atol=EXACT, rtol=0)
    torch.testing.assert_close(moved.translation, pose.translation @ turn.T + 5.0, atol=EXACT, rtol=0)


def test_joints_without_covered_vertices_keep_still():
    model = make_model()
    covered = model.weights[:, 5] == 0
    rig = make_rig(model, covered=covered)
    fit = make_fit(rig, model)
    target, _, _ = targets(rig, fit)
    fit.weights.copy_(covered)
    pose = fit(torch.where(covered[:, None], target, 0.0))
    assert 6 not in rig.solver.variables.tolist()
    torch.testing.assert_close(pose.relative[:, 6], torch.eye(3).to(target).expand(FRAMES, 3, 3))
