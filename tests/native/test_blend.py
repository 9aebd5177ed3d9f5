"""Pose blend shapes of a native model: what of them is linear, and the model that has them."""

from __future__ import annotations

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion.problem import Pose
from soma_core.native.blend import blend_shapes, is_linear
from tests.native.small_model import make_fit, make_model, make_rig, random_pose

ROUNDING = 1e-9
"""Relative: float64."""
DIFFERENCE = 1e-6
"""Relative: central differences of a smooth function in float64."""


@pytest.mark.parametrize(("blend", "linear"), [("linear", True), ("curved", False)])
def test_what_is_linear_is_told_from_what_is_not(blend, linear):
    offsets = make_model(blend=blend).pose_offsets
    shapes = blend_shapes(offsets, 6, dtype=torch.float64, device="cpu")
    assert is_linear(offsets, shapes) is linear
    assert make_rig(make_model(blend=blend)).linear is linear


@pytest.mark.parametrize("blend", ["none", "linear", "curved"])
def test_error_and_slope_are_those_of_the_model(blend):
    model = make_model(blend=blend)
    rig = make_rig(model)
    fit = make_fit(rig, model)
    rotations, pelvis = random_pose(2)
    turned = axis_angle_to_matrix(rotations)
    target = rig.posed(fit.body.identity, turned.roll(1, 0), pelvis)
    problem = fit.problem(target)
    eye = torch.eye(3).to(pelvis).expand(2, 1, 3, 3)
    pose = Pose.begin(torch.cat((eye, turned), 1), pelvis - problem.origin)

    def error(pose):
        there = rig.posed(fit.body.identity, pose.relative[:, 1:], pose.translation + problem.origin)
        return (there - target).square().sum((1, 2))

    view = rig.view(problem, pose)
    torch.testing.assert_close(view.energy, error(pose), rtol=ROUNDING, atol=0)
    step = 1e-6 * torch.randn(view.slope.shape, generator=torch.Generator().manual_seed(0)).double()
    ends = [error(rig.solver.retract(pose, view.turns, sign * step)) for sign in (1, -1)]
    told = 2 * (view.slope * step).sum((1, 2))
    torch.testing.assert_close(told, (ends[0] - ends[1]) / 2, rtol=DIFFERENCE, atol=0)
