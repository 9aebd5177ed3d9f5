"""Gradients through a fit to points: what the poses of the minimum do when the points move."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from soma_core.inversion.point_rows import PointRows
from soma_core.inversion.problem import Pose

__all__ = ["attach_point_gradient"]

_ROUNDS, _ACCURATE = 60, 1e-5
"""Largest number of products with the curvature; solved when this share of the slope is left."""

_DAMPING = 1e-6
"""Of the preconditioner, relative to its diagonal."""


def attach_point_gradient(
    points: Tensor, rotations: Tensor, translation: Tensor, *, rows: Callable[[Tensor], PointRows]
) -> tuple[Tensor, Tensor]:
    """Rotations (F, J - 1, 3, 3) and translation (F, 3) [m] of a fit as functions of its points.

    At a minimum the slope ``g(pose, points)`` of what a fit lowers is zero, hence ``d pose = -H^-1 dg`` with
    its exact second derivative H. The system is solved by conjugate gradients with the Gauss-Newton matrix
    as preconditioner, of all frames together where they are one motion.

    Args:
        points: targets that the fit was made for, of any shape.
        rotations, translation: the fit.
        rows: what it lowers, of points.
    """
    return _Implicit.apply(points, rotations, translation, rows)


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, rotations: Tensor, translation: Tensor, rows: Any
    ) -> tuple[Tensor, Tensor]:
        ctx.rows = rows
        ctx.save_for_backward(points, rotations, translation)
        return rotations.clone(), translation.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_rotations: Tensor, by_translation: Tensor) -> tuple[Tensor, None, None, None]:
        points, rotations, translation = ctx.saved_tensors
        still = torch.eye(3).to(rotations).expand(len(rotations), 1, 3, 3)
        pose = Pose.begin(torch.cat((still, rotations), 1), translation)
        with torch.enable_grad():
            leaf = points.detach().requires_grad_()
            solve = ctx.rows(leaf)
            step = torch.zeros(len(rotations), solve.size).to(rotations).requires_grad_()
            moved = solve.moved(pose, step)
            told = (moved.relative[:, 1:] * by_rotations).sum() + (moved.translation * by_translation).sum()
            (wanted,) = torch.autograd.grad(told, step)
            (slope,) = torch.autograd.grad(solve.energy_near(pose, step), step, create_graph=True)
        with torch.no_grad():
            motion = _solved(solve, pose, step, slope, wanted)
        (moved_points,) = torch.autograd.grad(slope, leaf, -motion)
        return moved_points, None, None, None


def _solved(solve: PointRows, pose: Pose, step: Tensor, slope: Tensor, wanted: Tensor) -> Tensor:
    """Motions (F, d) that the second derivative maps to slopes (F, d), by conjugate gradients."""
    matrix = 2 * solve.system(pose)[0]
    damping = torch.full_like(wanted[:, 0], _DAMPING)

    def near(left: Tensor) -> Tensor:
        return solve.solved(matrix, left, damping, double=2.0)

    def inner(first: Tensor, second: Tensor) -> Tensor:
        product = (first * second).sum(1, keepdim=True)
        return product if solve.smooth is None else product.sum()

    motion, left = torch.zeros_like(wanted), wanted.clone()
    way = close = near(left)
    size, enough = inner(left, close), _ACCURATE**2 * inner(left, left)
    for _ in range(_ROUNDS):
        if bool((inner(left, left) <= enough).all()):
            break
        (bent,) = torch.autograd.grad(slope, step, way, retain_graph=True)
        share = size / inner(way, bent).clamp_min(1e-30)
        motion, left = motion + share * way, left - share * bent
        close = near(left)
        new = inner(left, close)
        way, size = close + new / size.clamp_min(1e-30) * way, new
    return motion
