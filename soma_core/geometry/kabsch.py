"""Orthogonal Procrustes in closed form: the rotation nearest to a covariance (paper, equation 5)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from soma_core.geometry.rotations import vee
from soma_core.geometry.torch_func import transformed

__all__ = ["PRIOR_STRENGTH", "cofactor", "rotation_from_covariance"]

PRIOR_STRENGTH = 1e-5
"""Weight of the reference rotation, relative to the covariance: decides only degenerate clouds.

Far above float32 rounding and far below any limb: 1e-4 would turn slender limbs by up to 5e-3 rad."""

_NEWTON_STEPS = {torch.float32: 4}
"""Scaled Newton steps, five where not said: those after which nothing changes any more. What they begin with
has two singular values alone, which one step of the right scale would make equal."""

_TINY = {torch.float32: 1e-30, torch.float64: 1e-200}


def cofactor(matrix: Tensor) -> Tensor:
    """Cofactor matrix, ``det(M) M^-T`` where M is regular; (..., 3, 3) -> (..., 3, 3)."""
    rows = torch.cat((matrix, matrix), -2)
    around = torch.cat((rows, rows), -1)  # entry (i, j) is that of (i mod 3, j mod 3)
    first, second = around[..., 1:4, :], around[..., 2:5, :]
    return first[..., 1:4] * second[..., 2:5] - first[..., 2:5] * second[..., 1:4]


def _sum(matrix: Tensor) -> Tensor:
    """Sum of all entries, (..., 3, 3) -> (..., 1, 1)."""
    return matrix.sum((-1, -2), keepdim=True)


def _largest_singular_value(matrix: Tensor) -> Tensor:
    """Largest singular value (..., 1, 1), by the largest eigenvalue of ``M^T M`` (a cubic's, by an angle)."""
    mean = _sum(matrix * matrix) / 3
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    centred = matrix.transpose(-1, -2) @ matrix - mean * eye
    spread = (_sum(centred * centred) / 6).sqrt()
    scaled = centred / spread.clamp_min(_TINY[torch.float32] if matrix.dtype == torch.float32 else 1e-100)
    half_det = _sum(scaled * (scaled @ scaled)) / 6  # symmetric without trace: det is a third of tr(A^3)
    angle = torch.acos(half_det.clamp(-1, 1)) / 3
    return (mean + 2 * spread * torch.cos(angle)).clamp_min(0).sqrt()


def _nearest_rotation(covariance: Tensor) -> Tensor:
    """Proper polar factor, for either sign of the determinant and for rank two, without a branch.

    With singular values 1 >= s2 >= s3 and sign s, ``X = H + cof(H)`` has (1 + s s2 s3, s2 + s s3,
    s3 + s s2) in the same bases, so its orthogonal polar factor is the *rotation* nearest to H.
    Scaled Newton then converges quadratically whatever the conditioning.
    """
    scale = _largest_singular_value(covariance)
    unit = covariance / scale.clamp_min(_TINY.get(covariance.dtype, 1e-30))
    x = unit + cofactor(unit)
    for _ in range(_NEWTON_STEPS.get(covariance.dtype, 5)):
        adjugate = cofactor(x)
        det = _sum(x * adjugate) / 3
        det = torch.where(det.abs() < 1e-30, torch.full_like(det, 1e-30), det)
        norm, inverse_norm = (each.norm(dim=(-1, -2), keepdim=True) for each in (x, adjugate))
        stretch = (inverse_norm / (norm * det.abs())).sqrt()
        x = 0.5 * (stretch * x + adjugate / (stretch * det))
    return torch.where(_is_rotation(x), x, torch.eye(3, dtype=x.dtype, device=x.device))


def _is_rotation(x: Tensor) -> Tensor:
    """Whether the iteration arrived, (..., 1, 1): it cannot where s2 + s s3 = 0 to the last digit.

    The maximiser is then any of a family; a reflection exactly along the axes is the usual case.
    """
    adjugate = cofactor(x)
    det = (x[..., 0, :] * adjugate[..., 0, :]).sum(-1)
    return (((x - adjugate).abs().amax((-1, -2)) < 1e-3) & (det > 0))[..., None, None]


def _change(covariance: Tensor, rotation: Tensor, moved: Tensor) -> Tensor:
    """Derivative ``dR = R [xi]x`` with ``(tr(P) I - P) xi = eta``, ``P = R^T H``; its own transpose."""
    stretch = rotation.transpose(-1, -2) @ covariance
    stretch = 0.5 * (stretch + stretch.transpose(-1, -2))
    trace = torch.diagonal(stretch, dim1=-2, dim2=-1).sum(-1)
    eye = torch.eye(3, dtype=moved.dtype, device=moved.device)
    system = trace[..., None, None] * eye - stretch
    torque = vee(rotation.transpose(-1, -2) @ moved)
    adjugate = cofactor(system)  # symmetric, so the cofactor is the adjugate
    det = (system[..., 0, :] * adjugate[..., 0, :]).sum(-1)
    floor = torch.finfo(moved.dtype).tiny + torch.finfo(moved.dtype).eps * trace.abs() ** 3 * 1e-6
    u = (adjugate @ torque[..., None]).squeeze(-1) / torch.where(det.abs() < floor, floor, det)[..., None]
    x, y, z = u.unbind(-1)
    zero = torch.zeros_like(x)
    generator = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
    return rotation @ generator


class _NearestRotation(torch.autograd.Function):
    """The derivative of :func:`_nearest_rotation` in closed form."""

    @staticmethod
    def forward(covariance: Tensor) -> Tensor:
        return _nearest_rotation(covariance)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        covariance, rotation = ctx.saved_tensors
        return _change(covariance, rotation, grad)


class _NearestRotationAnyWay(_NearestRotation):
    """The same for every transform of ``torch.func``."""

    generate_vmap_rule = True

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)
        ctx.save_for_forward(inputs[0], output)

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor) -> Tensor:
        covariance, rotation = ctx.saved_tensors
        return _change(covariance, rotation, tangent)


def rotation_from_covariance(covariance: Tensor, *, reference: Tensor | None = None) -> Tensor:
    """Rotation R in SO(3) that maximises ``<R, H>`` for ``H = sum target source^T``; (..., 3, 3) each.

    A weak pull towards `reference` (identity by default), proportional to ``|H|``, decides clouds of
    rank one or zero: H = 0 returns the reference. Where even so no maximiser stands out, a rotation is
    still returned. Differentiable; the derivative is exact wherever the maximiser is unique. Paper,
    equation 5, in place of its SVD and of the iteration of equation 8.
    """
    if reference is None:
        reference = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    squared = (covariance * covariance).sum((-1, -2))
    floor = 1e-24 if covariance.dtype == torch.float32 else math.ulp(0.0) ** 0.5
    pull = PRIOR_STRENGTH * (squared + floor).sqrt()
    function = _NearestRotationAnyWay if transformed() else _NearestRotation
    return function.apply(covariance + pull[..., None, None] * reference)
