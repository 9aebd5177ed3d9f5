"""Features: bind-relative rotations, six numbers a joint."""

import torch

from soma_core.animation.kinematics import Kinematics, absolute_from_relative
from soma_core.correctives.features import PoseFeatures, local_bind_rotations
from soma_core.geometry.rotations import axis_angle_to_matrix
from tests.bodies import CPU, randn

ROUNDING = 1e-12


def test_zero_at_the_bind_pose(body, bind_pose):
    features = PoseFeatures(body.rig, dtype=torch.float64, device="cpu")(bind_pose)
    assert features.shape == (1, body.rig.joint_count, 6)
    assert features.abs().max() < ROUNDING


def test_they_are_the_first_two_columns_of_the_bind_relative_rotation(body):
    relative = axis_angle_to_matrix(randn(3, body.rig.joint_count - 1, 3))
    kinematics = Kinematics(body.rig, dtype=torch.float64, device=CPU)
    absolute = absolute_from_relative(relative, kinematics.orient[1:], kinematics.parent_orient[1:])
    turned = torch.as_tensor(local_bind_rotations(body.rig)[1:]).mT @ absolute
    features = PoseFeatures(body.rig, dtype=torch.float64, device="cpu")(relative)
    expected = (turned - torch.eye(3))[..., :2].flatten(-2)
    torch.testing.assert_close(features[:, 1:], expected, atol=ROUNDING, rtol=0)
    assert not features[:, 0].any()
