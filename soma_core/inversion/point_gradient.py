"""Gradients through a fit to points: what the poses of the minimum do when the points move."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from soma_core.inversion.implicit import EXACT, INDEFINITE, attached, conjugate_gradients
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
    still = points.detach()

    def pulled(
        rotations: Tensor, translation: Tensor, by_rotations: Tensor, by_translation: Tensor
    ) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            leaf = still.clone().requires_grad_()
            solve = rows(leaf)
            pose = solve.model.pose(rotations, translation)
            step = torch.zeros(len(rotations), solve.size).to(rotations).requires_grad_()
            moved = solve.moved(pose, step)
            by_kept = by_rotations[:, solve.model.kept[1:] - 1]
            told = (moved.relative[:, 1:] * by_kept).sum() + (moved.translation * by_translation).sum()
            (wanted,) = torch.autograd.grad(told, step)
            (slope,) = torch.autograd.grad(solve.energy_near(pose, step), step, create_graph=True)
        with torch.no_grad():
            motion, good = _solved(solve, pose, step, slope, wanted)
        (moved_points,) = torch.autograd.grad(slope, leaf, -motion)
        if not bool(good.all()):  # no motion, times the slope of a half turn, which has none
            moved_points = moved_points.nan_to_num(nan=0.0)
        return moved_points, torch.where(good, EXACT, INDEFINITE)

    return attached(points, rotations, translation, pulled)


def _solved(
    solve: PointRows, pose: Pose, step: Tensor, slope: Tensor, wanted: Tensor
) -> tuple[Tensor, Tensor]:
    """Motions (F, d) that the second derivative maps to slopes (F, d), and (F,) whether it is positive."""
    matrix = 2 * solve.system(pose)[0]
    damping = torch.full_like(wanted[:, 0], _DAMPING)

    def inner(first: Tensor, second: Tensor) -> Tensor:
        product = (first * second).sum(1)
        return product if solve.smooth is None else product.sum().expand(len(product))

    return conjugate_gradients(
        lambda way: torch.autograd.grad(slope, step, way, retain_graph=True)[0],
        lambda left: solve.solved(matrix, left, damping, double=2.0),
        wanted, rounds=_ROUNDS, accurate=_ACCURATE, inner=inner,
    )  # fmt: skip
