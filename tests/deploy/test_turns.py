"""Rotations and twist in few operators are those of the layer."""

import pytest
import torch

from soma_core.animation.twist import Twist
from soma_core.deploy.turns import AxisAngle, ShortTwist, product
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.rig import load_canonical
from tests.bodies import CPU, randn

ROUNDING = 1e-12
"""Of float64, in numbers of order one."""

SERIES = 2e-11
"""What two terms leave out below 1e-2 rad; float32 rounds by a thousand times as much."""


@pytest.mark.parametrize("bound", [0.0, 1e-3, 9e-3, 0.1, 3.0])
def test_rotations_of_vectors(bound):
    vectors = bound * torch.nn.functional.normalize(randn(50, 3), dim=-1)
    found = AxisAngle(dtype=torch.float64, device=CPU).exponential(vectors.T)
    assert (found.T.unflatten(1, (3, 3)) - axis_angle_to_matrix(vectors)).abs().max() < SERIES


def test_products():
    left, right = randn(5, 3, 3), randn(5, 3, 3)
    first, second = left.permute(1, 2, 0), right.permute(1, 2, 0)
    assert (product(first, second).permute(2, 0, 1) - left @ right).abs().max() < ROUNDING
    assert (product(first, second, transposed=True).permute(2, 0, 1) - left.mT @ right).abs().max() < ROUNDING


@pytest.mark.parametrize("angle", [0.0, 0.4, 3.0])
@pytest.mark.parametrize("bodies", [1, 4])
def test_twist_of_the_shipped_rig(angle, bodies):
    rig = load_canonical("low")[1]
    twist = Twist(rig, dtype=torch.float64, device=CPU)
    short = ShortTwist(twist, dtype=torch.float64, device=CPU)
    bind = torch.as_tensor(rig.bind_world.copy())[None].repeat(bodies, 1, 1, 1)
    bind[..., :3, 3] *= 1 + 0.1 * randn(bodies, 1, 1)
    bind[:, int(short.start[0]), :3, 3] = bind[:, int(twist.high[0]), :3, 3]  # a bone without a direction
    given = bind, axis_angle_to_matrix(angle * randn(4, rig.joint_count, 3)), randn(4, rig.joint_count, 3)
    assert (short(*given) - twist(*given)).abs().max() < ROUNDING
