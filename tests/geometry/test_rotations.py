"""Exponential, logarithm and shortest arc against scipy, with finite gradients at every angle."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from soma_core.geometry.rotations import (
    axis_angle_to_matrix,
    matrix_to_axis_angle,
    orthonormality_error,
    shortest_arc,
    skew,
    vee,
)
from tests.bodies import randn

ROUNDING = {torch.float32: 1e-6, torch.float64: 1e-14}
"""A few units in the last place of numbers of order one."""
LOG_ROUNDING = {torch.float32: 3e-6, torch.float64: 1e-14}
"""Angles up to pi have a coarser last place, and come from quotients of rounded entries."""
NEAR_PI = np.pi - np.array([1e-9, 1e-6, 1e-4, 1e-2])
ANGLES = [0.0, 1e-300, 1e-12, 1e-9, 1e-6, 1e-4, 0.99e-2, 1.01e-2, 0.3, 1.0, 2.0, *NEAR_PI, np.pi]
TURNS_OVER = [np.pi + 1e-3, 4.0, 2 * np.pi, 7.0, 100.0]
DTYPES = [torch.float32, torch.float64]


def axes():
    """Coordinate axes, both ways, and random directions."""
    directions = np.concatenate([np.eye(3), -np.eye(3), randn(10, 3, seed=1).numpy()])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def vectors(angle, dtype=torch.float64):
    return torch.as_tensor(angle * axes(), dtype=dtype)


def test_skew_is_the_cross_product():
    a, b = randn(2, 5, 3, seed=2), randn(2, 5, 3, seed=3)
    torch.testing.assert_close((skew(a) @ b[..., None]).squeeze(-1), torch.linalg.cross(a, b))


def test_vee_takes_the_turn_out_of_any_matrix():
    v, symmetric = torch.randn(5, 3), torch.randn(5, 3, 3)
    symmetric = symmetric + symmetric.mT
    torch.testing.assert_close(vee(symmetric + skew(v)), 2 * v)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES + TURNS_OVER)
def test_exp_is_the_matrix_exponential(angle, dtype):
    given = vectors(angle, dtype)
    expected = np.stack([expm(m) for m in skew(given.double()).numpy()])
    scale = max(1.0, angle)  # the rounding of a long argument
    torch.testing.assert_close(
        axis_angle_to_matrix(given).double(), torch.from_numpy(expected), atol=scale * ROUNDING[dtype], rtol=0
    )


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES + TURNS_OVER)
def test_exp_is_orthonormal(angle, dtype):
    assert orthonormality_error(axis_angle_to_matrix(vectors(angle, dtype))).max() < 2 * ROUNDING[dtype]


def test_exp_takes_any_leading_shape():
    given = randn(2, 0, 4, 3)
    assert axis_angle_to_matrix(given).shape == (2, 0, 4, 3, 3)
    single = randn(3, seed=5)
    torch.testing.assert_close(axis_angle_to_matrix(single), axis_angle_to_matrix(single[None])[0])


@pytest.mark.parametrize("angle", ANGLES + TURNS_OVER)
def test_exp_gradient_is_finite_and_exact(angle):
    given = vectors(angle).requires_grad_()
    (grad,) = torch.autograd.grad((axis_angle_to_matrix(given) * randn(3, 3, seed=6)).sum(), given)
    assert grad.isfinite().all()
    assert torch.autograd.gradcheck(axis_angle_to_matrix, vectors(angle)[4:8].requires_grad_())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-6])
def test_exp_gradient_at_zero_is_the_generator(angle, dtype):
    zero = torch.full((3,), angle, dtype=dtype, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(axis_angle_to_matrix, zero)
    expected = skew(torch.eye(3, dtype=dtype)).permute(1, 2, 0)
    torch.testing.assert_close(jacobian, expected, atol=3e-6, rtol=0)  # the angle itself


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES)
def test_log_agrees_with_scipy(angle, dtype):
    matrices = Rotation.from_rotvec(angle * axes()).as_matrix()
    found = matrix_to_axis_angle(torch.as_tensor(matrices, dtype=dtype)).double().numpy()
    expected = Rotation.from_matrix(matrices).as_rotvec()
    if np.pi - angle < 1e-3:  # both axes are valid answers within rounding of pi: compare rotations
        expected *= np.sign((expected * found).sum(1, keepdims=True))
    # An angle near pi is read off entries that change with its cosine, so only half the digits survive
    # in the angle's complement; the vector itself is good to rounding of the matrix.
    np.testing.assert_allclose(found, expected, atol=LOG_ROUNDING[dtype] * 2, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES)
def test_log_of_any_angle_gives_the_same_rotation(angle, dtype):
    matrices = torch.as_tensor(Rotation.from_rotvec(angle * axes()).as_matrix(), dtype=dtype)
    vector = matrix_to_axis_angle(matrices)
    assert vector.norm(dim=-1).max() <= np.pi + LOG_ROUNDING[dtype]
    again = Rotation.from_rotvec(vector.double().numpy()).as_matrix()
    np.testing.assert_allclose(again, matrices.double(), atol=4 * ROUNDING[dtype])


def test_log_of_tiny_rotations_is_not_doubled():
    for angle in (1e-9, 1e-6, 1e-4, 9e-4, 1.1e-3):
        matrix = torch.as_tensor(Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix())
        torch.testing.assert_close(matrix_to_axis_angle(matrix)[1].item(), angle, rtol=1e-6, atol=1e-16)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_gradient_is_finite(angle):
    matrices = torch.as_tensor(Rotation.from_rotvec(angle * axes()).as_matrix()).requires_grad_()
    (grad,) = torch.autograd.grad((matrix_to_axis_angle(matrices) * randn(3, seed=7)).sum(), matrices)
    assert grad.isfinite().all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0, np.pi - 1e-3])
def test_log_undoes_exp_to_first_order(angle):
    """Derivative of log after exp is the identity wherever log is smooth."""
    given = vectors(angle)[7].requires_grad_()
    jacobian = torch.autograd.functional.jacobian(
        lambda v: matrix_to_axis_angle(axis_angle_to_matrix(v)), given
    )
    torch.testing.assert_close(jacobian, torch.eye(3, dtype=torch.float64), atol=1e-9, rtol=0)


ARC_ANGLES = [0.0, 1e-9, 1e-4, 0.5, np.pi / 2, *NEAR_PI, np.pi - 3e-4, np.pi - 2e-7, np.pi]


def arcs(angle, dtype):
    """Directions, and the same turned by `angle` about a perpendicular axis, with unequal lengths."""
    a = axes()
    side = np.cross(a, a[:, [1, 2, 0]] + [[0.1, 0.2, 0.3]])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    b = np.cos(angle) * a + np.sin(angle) * side
    return torch.as_tensor(0.3 * a, dtype=dtype), torch.as_tensor(7 * b, dtype=dtype)


SWITCH = {torch.float32: 4e-4, torch.float64: 2e-6}
"""Closer than this to the opposite direction any perpendicular axis is taken: the miss is that angle."""


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ARC_ANGLES)
def test_shortest_arc_is_orthonormal_and_arrives(angle, dtype):
    source, target = arcs(angle, dtype)
    rotation = shortest_arc(source, target)
    assert orthonormality_error(rotation).max() < 3 * ROUNDING[dtype]
    arrived = (rotation @ source[..., None]).squeeze(-1) / 0.3
    # The bisector of nearly opposite directions is a small difference: its rounding grows as it shrinks.
    rounding = 4 * ROUNDING[dtype] / max(min(1.0, np.pi - angle), 1e-12)
    miss = SWITCH[dtype] if np.pi - angle < SWITCH[dtype] else rounding
    torch.testing.assert_close(arrived, target / 7, atol=miss, rtol=0)


@pytest.mark.parametrize("angle", ARC_ANGLES)
def test_shortest_arc_turns_no_further_than_needed(angle):
    source, target = arcs(angle, torch.float64)
    turned = Rotation.from_matrix(shortest_arc(source, target).numpy()).magnitude()
    np.testing.assert_allclose(turned, angle, atol=1e-7 if angle < 3 else SWITCH[torch.float64])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ARC_ANGLES)
def test_shortest_arc_gradient_is_finite(angle, dtype):
    source, target = (part.requires_grad_() for part in arcs(angle, dtype))
    loss = (shortest_arc(source, target) * randn(3, 3, seed=8, dtype=dtype)).sum()
    for grad in torch.autograd.grad(loss, (source, target)):
        assert grad.isfinite().all()


@pytest.mark.parametrize("angle", [0.0, 0.5, 3.0, np.pi - 1e-2])
def test_shortest_arc_gradcheck(angle):
    source, target = (part[6:9].requires_grad_() for part in arcs(angle, torch.float64))
    assert torch.autograd.gradcheck(shortest_arc, (source, target))


def test_shortest_arc_of_a_vanished_bone_is_a_rotation():
    """A target of length zero has no direction; the result must still be finite and orthonormal."""
    rotation = shortest_arc(randn(5, 3, seed=9), torch.zeros(5, 3, dtype=torch.float64))
    assert orthonormality_error(rotation).max() < ROUNDING[torch.float64]


def test_orthonormality_error_sees_scale_shear_and_reflection():
    eye = torch.eye(3, dtype=torch.float64)
    assert orthonormality_error(eye) == 0
    assert orthonormality_error(1.01 * eye) > 0.02
    assert orthonormality_error(-eye) == 2
    shear = eye.clone()
    shear[0, 1] = 0.1
    assert orthonormality_error(shear) >= 0.1
