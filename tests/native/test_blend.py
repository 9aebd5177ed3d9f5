"""What blend shapes add to the Gauss-Newton matrix, against derivatives of the whole model."""

from __future__ import annotations

import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion.problem import Pose
from soma_core.native.blend import BlendMoments
from tests.native.small_model import make_fit, make_model, make_rig, random_pose

ROUNDING = 1e-6
"""Relative to the largest entry: central differences of a smooth function in float64."""
STEP = 1e-5


def columns(rig, fit, pose):
    """Derivative of the vertices by each turn in world axes and by the translation, (3 n + 3, 3 v)."""
    turns, _ = rig.solver.walk(pose, fit.rest.offsets)
    count = len(rig.solver.variables)
    found = []
    for unit in torch.eye(3 * count + 3).to(turns).view(-1, 1, count + 1, 3):
        ends = [fit.posed(rig.solver.retract(pose, turns, sign * STEP * unit)).flatten() for sign in (1, -1)]
        found.append((ends[0] - ends[1]) / (2 * STEP))
    return torch.stack(found)


def test_matrix_of_rigid_parts_is_that_of_the_derivatives():
    model = make_model(rigid=True)
    rig = make_rig(model)
    fit = make_fit(rig, model)
    rotations, pelvis = random_pose(1)
    eye = torch.eye(3).to(pelvis).expand(1, 1, 3, 3)
    pose = Pose.begin(torch.cat((eye, axis_angle_to_matrix(rotations)), 1), pelvis)
    turns, places = rig.solver.walk(pose, fit.rest.offsets)
    blend = BlendMoments(rig.blend_shapes, rig.moments, fit.rest, fit.weights, rig.above)
    matrix = blend.matrix(pose.relative, turns, places, rig.solver)
    none = turns.new_zeros(1, len(rig.solver.joints), 3, 4)
    matrix = matrix + rig.solver.normal_equations(turns, places, fit.rest.second, none)[0]
    jacobian = columns(rig, fit, pose)
    # The moments are of the rest mesh: arms do not reach to where blend shapes have moved the vertices.
    offsets = model.pose_offsets(pose.relative[:, 1:])
    owner = model.weights.argmax(1)
    carried = (turns[:, 1:][:, owner] @ offsets[..., None]).squeeze(-1)
    above = torch.eye(len(rig.joint_names), dtype=torch.bool)
    for joint, parent in enumerate(model.parents):
        above[joint] |= above[parent] if parent >= 0 else False
    axes = torch.eye(3).to(carried)
    for joint in range(len(rig.joint_names)):
        moved = torch.linalg.cross(axes[:, None].expand(-1, len(owner), 3), carried.expand(3, -1, 3), dim=-1)
        jacobian[3 * joint : 3 * joint + 3] -= (moved * above[owner, joint, None]).flatten(1)
    expected = jacobian @ jacobian.T
    found = matrix[0].flatten(2, 3).flatten(0, 1)
    torch.testing.assert_close(found, expected, atol=ROUNDING * float(expected.abs().max()), rtol=0)
