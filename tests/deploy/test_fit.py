"""The fit in few operators gives the rotations of the layer's."""

import pytest
import torch

from soma_core.deploy.fit import NearestRotation, ShortRotationFit
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.skeleton.fit import SkeletonFit
from tests.bodies import CPU, randn, tiny_canonical

ONE_STEP = 1e-8
"""In float64: half the square of what the closed form leaves, 1e-5 of the prior's weight and rounding."""

SINGLE = 2e-6
"""Some roundings of float32."""


@pytest.fixture(scope="module")
def fit():
    mesh, rig = tiny_canonical()
    return SkeletonFit(mesh, rig, dtype=torch.float64, device=CPU)


def nearest(covariances):
    kind = NearestRotation(dtype=covariances.dtype, device=CPU)
    return kind(covariances.flatten(1).T.contiguous()).T.unflatten(1, (3, 3))


@pytest.mark.parametrize(
    "values",
    [(1, 0.8, 0.5), (1, 1e-2, 5e-3), (1, 0.7, 0), (1, 1, 1), (1, 1, 0.1), (1, 0.8, -0.3), (1e-9, 5e-10, 0)],
)  # fmt: skip
def test_the_nearest_rotation(values):
    left, right = axis_angle_to_matrix(randn(200, 3)), axis_angle_to_matrix(randn(200, 3))
    covariances = left @ torch.diag(torch.tensor(values, dtype=torch.float64)) @ right
    wanted = rotation_from_covariance(covariances)
    assert (nearest(covariances) - wanted).abs().max() < ONE_STEP
    single = nearest(covariances.float())
    spread = 1 / max(abs(values[1] + values[2]) / values[0], 1e-2)  # of rounding, about a slender cloud
    assert (single - wanted).abs().max() < SINGLE * spread
    assert orthonormality_error(single).max() < SINGLE


def test_no_cloud_turns_nothing():
    assert torch.equal(nearest(torch.zeros(2, 3, 3)), torch.eye(3).expand(2, 3, 3))


def test_a_cloud_on_a_line_is_turned_the_short_way():
    line = torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64) / 3
    turn = axis_angle_to_matrix(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64))
    cloud = ((turn @ line)[:, None] * line)[None]
    assert (nearest(cloud) - rotation_from_covariance(cloud)).abs().max() < ONE_STEP


@pytest.mark.parametrize("angle", [0.0, 0.2, 2.0])
def test_rotations_of_joints(fit, angle):
    count = fit.joint_count
    turns = axis_angle_to_matrix(angle * randn(3, count, 3))
    joints = randn(3, count, 3)
    clouds = turns @ torch.diag(torch.tensor([1, 0.5, 0.3], dtype=torch.float64)) + 0.01 * randn(
        3, count, 3, 3
    )
    short = ShortRotationFit(fit.rotations, dtype=torch.float64, device=CPU)
    assert (short(joints, clouds) - fit.rotations(joints, clouds)).abs().max() < ONE_STEP


def test_a_bone_turned_half_round(fit):
    eye = torch.eye(3, dtype=torch.float64).expand(1, fit.joint_count, 3, 3)
    joints = -fit.rotations.bind[None]
    found = ShortRotationFit(fit.rotations, dtype=torch.float64, device=CPU)(joints, eye)
    assert orthonormality_error(found).max() < SINGLE  # a fan that is folded over has no nearest rotation
