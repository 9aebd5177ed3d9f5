"""Rotations: exponential and logarithm maps, shortest arcs, and checks."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "axis_angle_to_matrix",
    "cayley",
    "matrix_to_axis_angle",
    "matrix_to_quaternion",
    "orthonormality_error",
    "shortest_arc",
    "skew",
    "vee",
]

_SERIES_BELOW = {torch.float32: 1e-4, torch.float64: 1e-8}
"""Squared angle [rad^2] under which sin and cos quotients come from their Taylor series."""


def skew(vector: Tensor) -> Tensor:
    """Cross-product matrix of a vector: ``skew(a) @ b == cross(a, b)``; (..., 3) -> (..., 3, 3)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def vee(matrix: Tensor) -> Tensor:
    """The vector v of the antisymmetric part, ``skew(v) == matrix - matrix^T``; (..., 3, 3) -> (..., 3)."""
    turn = matrix - matrix.transpose(-1, -2)
    return torch.stack((turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]), -1)


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Exponential map of SO(3): rotation vectors [rad] (..., 3) -> matrices (..., 3, 3).

    ``R = I + a [v]x + b [v]x^2`` with ``a = sin(t)/t`` and ``b = (1 - cos t)/t^2`` (Rodrigues), both
    from their series near zero, so value and gradient are finite everywhere.
    """
    squared = (axis_angle * axis_angle).sum(-1)
    small = squared < _SERIES_BELOW.get(axis_angle.dtype, 1e-4)
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    half = torch.sin(0.5 * angle) / (0.5 * angle)
    a = torch.where(small, 1 - squared / 6 + squared * squared / 120, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - squared / 24 + squared * squared / 720, 0.5 * half * half)
    x, y, z = axis_angle.unbind(-1)
    bx, by, bz = b * x, b * y, b * z
    ax, ay, az = a * x, a * y, a * z
    entries = (
        1 - by * y - bz * z, bx * y - az, bx * z + ay,
        bx * y + az, 1 - bx * x - bz * z, by * z - ax,
        bx * z - ay, by * z + ax, 1 - bx * x - by * y,
    )  # fmt: skip
    return torch.stack(entries, -1).unflatten(-1, (3, 3))


def cayley(vector: Tensor) -> Tensor:
    """Cayley map: a rotation about `vector` by ``2 atan(|vector| / 2)``; (..., 3) -> (..., 3, 3).

    Agrees with the exponential map to second order, is orthogonal to rounding and needs no trigonometry.
    """
    half = 0.5 * vector
    factor = 2 / (1 + (half * half).sum(-1))
    turn = skew(half)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + factor[..., None, None] * (turn + turn @ turn)


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Unit quaternion of a rotation, (..., 3, 3) -> (..., 4) in the order w, x, y, z with w >= 0.

    Takes the one of four candidates whose own component is largest, so it is accurate at every angle; at
    exactly half a turn one of the two signs is returned.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrix.flatten(-2).unbind(-1)
    entries = (
        1 + xx + yy + zz, zy - yz, xz - zx, yx - xy,
        zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx,
        xz - zx, xy + yx, 1 + yy - xx - zz, yz + zy,
        yx - xy, xz + zx, yz + zy, 1 + zz - xx - yy,
    )  # fmt: skip
    candidates = torch.stack(entries, -1).unflatten(-1, (4, 4))  # row k is 4 q_k (w, x, y, z)
    largest = torch.diagonal(candidates, dim1=-2, dim2=-1).argmax(-1)
    row = largest[..., None, None].expand(*largest.shape, 1, 4)  # take_along_dim fixes the batch on export
    quaternion = candidates.gather(-2, row).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """Logarithm map of SO(3): matrices (..., 3, 3) -> rotation vectors [rad] (..., 3), angle in [0, pi].

    Goes through :func:`matrix_to_quaternion`, so it is accurate at every angle; at exactly pi one of the
    two valid axes is returned.
    """
    quaternion = matrix_to_quaternion(matrix)
    scalar, vector = quaternion[..., 0], quaternion[..., 1:]
    squared = (vector * vector).sum(-1)
    small = squared < _SERIES_BELOW.get(matrix.dtype, 1e-4)
    safe_scalar = torch.where(small, scalar, torch.ones_like(scalar))
    safe = torch.where(small, torch.ones_like(squared), squared).sqrt()
    series = 2 / safe_scalar - 2 * squared / (3 * safe_scalar**3)
    factor = torch.where(small, series, 2 * torch.atan2(safe, scalar) / safe)
    return vector * factor[..., None]


def shortest_arc(source: Tensor, target: Tensor) -> Tensor:
    """Smallest rotation that turns `source` into the direction of `target`; (..., 3) -> (..., 3, 3).

    Two half turns, about `source` and about the bisector: orthogonal to rounding at every angle. For
    opposite directions any perpendicular axis serves. Lengths are ignored; both must be non-zero.
    """
    a = torch.nn.functional.normalize(source, dim=-1)
    b = torch.nn.functional.normalize(target, dim=-1)
    total = a + b
    opposite = (total * total).sum(-1, keepdim=True) < (1e-7 if source.dtype == torch.float32 else 1e-12)
    smallest = a.detach().abs().argmin(-1)
    axis = torch.nn.functional.one_hot(smallest, 3).to(a.dtype)
    perpendicular = torch.linalg.cross(a, axis, dim=-1)
    middle = torch.nn.functional.normalize(torch.where(opposite, perpendicular, total), dim=-1)
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    first = 2 * a[..., :, None] * a[..., None, :] - eye
    second = 2 * middle[..., :, None] * middle[..., None, :] - eye
    return second @ first


def orthonormality_error(matrix: Tensor) -> Tensor:
    """Largest entry of ``|R^T R - I|`` and of ``|det R - 1|``; (..., 3, 3) -> (...)."""
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    gram = (matrix.transpose(-1, -2) @ matrix - eye).abs().amax((-1, -2))
    determinant = (matrix[..., 0, :] * torch.linalg.cross(matrix[..., 1, :], matrix[..., 2, :], dim=-1)).sum(
        -1
    )
    return torch.maximum(gram, (determinant - 1).abs())
