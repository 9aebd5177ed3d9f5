"""Gradients through a fit: what the pose of the minimum does when the target moves."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from soma_core.inversion.priors import JointTerms
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.protocol import Curvature, ForwardModel

__all__ = ["attach_gradient", "slope_of_cotangents"]

_CHUNK = 64
"""Frames treated at a time."""

_ROUNDS = 200
"""Largest number of products with the curvature."""

_ACCURATE = {torch.float32: 1e-6, torch.float64: 1e-10}
"""A frame is done when the slope that is left is this share of the first."""

_RIDGE = 1e-13
_DAMPING = 1e-6
"""What a turn by one radian costs as the square of an error of every vertex [m], so that gradients of what the target does not
determine stay finite; and what the moments' matrix is damped by, relative to its diagonal."""


def attach_gradient(
    vertices: Tensor,
    rotations: Tensor,
    translation: Tensor,
    *,
    model: ForwardModel,
    problem: Callable[[slice], Problem],
    valid: Tensor,
) -> tuple[Tensor, Tensor]:
    """Rotations and translation of a fit as differentiable functions of its target.

    At a minimum the slope ``g(pose, x) = J^T O (y - x)``, terms included, is zero, hence
    ``d pose = H^-1 J^T O dx`` with the exact second derivative H of half the error: J^T O J, the curvature that the
    residual adds, and the terms. The system is solved by conjugate gradients with the moments' matrix as
    preconditioner.

    Frames that are not valid get no gradient. Nor do frames whose error curves downwards somewhere, which are not at
    a minimum and have no derivative: a ``RuntimeWarning`` in the backward pass names them.

    Args:
        vertices: targets (F, v, 3) [m] that the fit was made for.
        rotations: (F, J - 1, 3, 3), T-pose-relative, and translation (F, 3) [m]: the fit.
        model: that was fitted.
        problem: of a chunk of the frames; no gradient reaches its identity and weights.
        valid: (F,) bool.
    """
    return _Implicit.apply(vertices, rotations, translation, (model, problem, valid))


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx, _vertices, rotations, translation, parts):
        ctx.parts = parts
        ctx.save_for_backward(rotations, translation)
        return rotations.clone(), translation.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_rotations, by_translation):
        model, problem, valid = ctx.parts
        frames = *ctx.saved_tensors, by_rotations, by_translation, valid
        grads, good = [], []
        for first in range(0, len(valid), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            moved, fine = _pull_back(model, problem(chunk), *(one[chunk] for one in frames))
            grads.append(moved)
            good.append(fine)
        _warn(torch.cat(good) if good else valid)
        return torch.cat(grads) if grads else None, None, None, None


def _pull_back(
    model: ForwardModel,
    problem: Problem,
    rotations: Tensor,
    translation: Tensor,
    by_rotations: Tensor,
    by_translation: Tensor,
    valid: Tensor,
) -> tuple[Tensor, Tensor]:
    """Gradient (F, v, 3) by the target of a chunk of frames, and whether each frame has one."""
    eye = model.solver.eye.expand(len(rotations), 1, 3, 3)
    pose = Pose.begin(torch.cat((eye, rotations), 1), translation - problem.origin)
    turns, _ = model.solver.walk(pose, problem.rest)
    slope = slope_of_cotangents(model, rotations, turns, by_rotations, by_translation)
    system = _System(model, problem, pose, turns, model.curvature(problem, pose))
    motion, good = system.solve(torch.where(valid[:, None, None], slope, 0.0))
    moved = system.curvature.moved(motion) * problem.weights[..., None]
    return torch.where(valid[:, None, None], moved, 0.0), good | ~valid


def slope_of_cotangents(
    model: ForwardModel, rotations: Tensor, turns: Tensor, by_rotations: Tensor, by_translation: Tensor
) -> Tensor:
    """Derivative (F, n + 1, 3) by turns in world axes, and by the translation, from that by matrix entries.

    Args:
        model: whose variables count.
        rotations: (F, J - 1, 3, 3) T-pose-relative.
        turns: world turns, the virtual root's included, (F, J or more, 3, 3).
        by_rotations, by_translation: derivatives (F, J - 1, 3, 3) and (F, 3).
    """
    n = model.solver.variables
    product = rotations[:, n - 1] @ by_rotations[:, n - 1].mT
    torque = torch.stack(
        (
            product[..., 1, 2] - product[..., 2, 1],
            product[..., 2, 0] - product[..., 0, 2],
            product[..., 0, 1] - product[..., 1, 0],
        ),
        -1,
    )
    torque = (turns[:, model.solver.parents[n]] @ torque[..., None]).squeeze(-1)
    return torch.cat((torque, by_translation[:, None]), 1)


@dataclass(frozen=True, kw_only=False, eq=False)
class _System:
    """The second derivative of half the error, terms included, at poses; hinges turn about their axis alone."""

    model: ForwardModel
    problem: Problem
    pose: Pose
    turns: Tensor
    curvature: Curvature

    def solve(self, slope: Tensor) -> tuple[Tensor, Tensor]:
        """Motions (F, n + 1, 3) that the matrix maps to slopes, and (F,) whether it is positive on the way."""
        problem, kind = self.problem, slope.dtype
        mass = problem.weights.sum(1).expand(len(slope))
        view = self.model.view(problem, self.pose)
        damping = torch.full_like(mass, _DAMPING)
        inverse = self.model.inverse(problem, self.pose, view, damping, mass)
        blocks = None if problem.terms is None else _term_blocks(self, problem.terms, mass)
        ridge = (_RIDGE * mass)[:, None, None]
        left = self._free(slope)
        motion, good = torch.zeros_like(left), torch.ones_like(mass, dtype=torch.bool)
        near = self._free(inverse(left))
        way, size = near, _inner(left, near)
        enough = _ACCURATE[kind] ** 2 * _inner(left, left)
        moving = size > 0
        for _ in range(_ROUNDS):
            if not bool(moving.any()):
                break
            bent = self.curvature.times(way) + ridge * way
            if blocks is not None:
                bent[:, :-1] += (blocks @ way[:, :-1, :, None]).squeeze(-1)
            bent = self._free(bent)
            curved = _inner(way, bent)
            good = good & ~(moving & ~(curved > 0))
            moving = moving & good
            step = torch.where(moving, size / torch.where(moving, curved, 1.0), 0.0)[:, None, None]
            motion, left = motion + step * way, left - step * bent
            near = self._free(inverse(left))
            new = _inner(left, near)
            moving = moving & (_inner(left, left) > enough)
            way = near + torch.where(moving, new / torch.where(moving, size, 1.0), 0.0)[:, None, None] * way
            size = new
        return torch.where(good[:, None, None], motion, 0.0), good

    def _free(self, motion: Tensor) -> Tensor:
        """The part of a motion that hinges allow."""
        terms = self.problem.terms
        return motion if terms is None else self.model.solver._along_hinges(motion, self.turns, terms)


def _inner(one: Tensor, other: Tensor) -> Tensor:
    return (one * other).sum((1, 2))


def _term_blocks(system: _System, terms: JointTerms, mass: Tensor) -> Tensor:
    """Half the second derivative of the terms, (F, n, 3, 3) by world turns.

    Along the arc back a term is quadratic; across it, it curves with ``(angle - free) / (2 tan(angle / 2))``.
    """
    n = system.model.solver.variables
    relative = system.pose.relative[:, n]
    axis, over, angle = terms._deviation(relative)
    above = system.turns[:, system.model.solver.parents[n]]
    world = (above[:, terms.variable] @ axis[..., None]).squeeze(-1)
    small = angle < 1e-4
    round_arc = torch.where(small, 1.0, 0.5 * over / torch.tan(0.5 * torch.where(small, 1.0, angle)))
    across = terms.stiffness * torch.where(small & (terms.free > 0), 0.0, round_arc)
    along = torch.where((over > 0) | (terms.free == 0), terms.stiffness.expand_as(across), 0.0)
    eye = system.model.solver.eye
    outer = world[..., :, None] * world[..., None, :]
    block = across[..., None, None] * eye + (along - across)[..., None, None] * outer
    return mass[:, None, None, None] * torch.zeros_like(relative).index_add(1, terms.variable, block)


def _warn(good: Tensor) -> None:
    if bool(good.all()):
        return
    bad = torch.nonzero(~good).flatten().tolist()
    warnings.warn(
        f"{len(bad)} of {len(good)} frames got no gradient through the fit, the first is {bad[0]}: their error "
        "curves downwards where they rest, which is no minimum. Fit with more steps (refreshes), or leave them out.",
        RuntimeWarning,
        stacklevel=2,
    )
