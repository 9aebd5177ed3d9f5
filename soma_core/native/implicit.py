"""Gradients through a native fit: what the pose of the minimum does when the target moves."""

from __future__ import annotations

import torch
from torch import Tensor

from soma_core.inversion.problem import Pose
from soma_core.native.poses import PoseFit
from soma_core.native.view import turned_slope, view_pose

__all__ = ["attach_gradient"]

_ROUNDS = 6
"""Corrections of the moments' solution by the model itself; each takes the error down about tenfold."""

_STEP = {torch.float32: 1e-3, torch.float64: 1e-5}
"""Largest turn [rad] and shift [m] of a central difference along one direction."""

_RIDGE = {torch.float32: 1e-6, torch.float64: 1e-12}
"""Relative to the diagonal: gradients of what the target does not determine stay finite."""


def attach_gradient(target: Tensor, pose: Pose, fit: PoseFit, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (F, J, 3, 3) and root places (F, 3) of a fit as differentiable functions of its target.

    At a minimum ``J^T O (y - x) = 0``, hence ``d pose = (J^T O J)^-1 J^T O dx`` with the derivative J of the
    whole model: exact where the residual is zero, the Gauss-Newton approximation elsewhere.

    Args:
        target: (F, n, 3) [m] that the fit was made for.
        pose: the fit.
        fit: of the body.
        valid: (F,) bool; other frames get no gradient.
    """
    return _Implicit.apply(target, pose.relative[:, 1:], pose.translation, (pose, fit, valid))


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx, _target, rotations, pelvis, parts):
        ctx.parts = parts
        return rotations.clone(), pelvis.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_rotations, by_pelvis):
        pose, fit, valid = ctx.parts
        solver = fit.rig.solver
        posed = fit.posed(pose)
        turns, places = solver.walk(pose, fit.rest.offsets)
        left = turned_slope(fit.rig, pose.relative[:, 1:], turns, by_rotations, by_pelvis)
        left = slope = torch.where(valid[:, None, None], left, 0.0)
        dense = fit.matrix(pose, turns, places).flatten(3, 4).flatten(1, 2)
        ridge = _RIDGE[dense.dtype] * dense.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12)
        factor, _ = torch.linalg.cholesky_ex(dense + torch.diag_embed(ridge))
        motion, moved = torch.zeros_like(left), torch.zeros_like(posed)
        for _ in range(_ROUNDS):
            motion = motion + torch.cholesky_solve(left.flatten(1)[..., None], factor).view_as(left)
            moved = _moved(fit, pose, turns, motion)
            # The slope of the error against a target that lies back by `moved` is J^T O moved.
            pulled = view_pose(fit.rig, fit.body, fit.rest, pose, posed - moved, fit.weights).slope
            left = slope - pulled
        return fit.weights[:, None] * moved, None, None, None


def _moved(fit: PoseFit, pose: Pose, turns: Tensor, motion: Tensor) -> Tensor:
    """What a motion (F, n + 1, 3) of the joints does to the vertices, ``J u`` (F, n, 3), to first order."""
    length = motion.norm(dim=-1).amax(1)[:, None, None].clamp_min(torch.finfo(motion.dtype).tiny)
    step = _STEP[motion.dtype] / length
    ahead, behind = (fit.posed(fit.rig.solver.retract(pose, turns, sign * step * motion)) for sign in (1, -1))
    return (ahead - behind) / (2 * step)
