"""Gradients through a fit: what the pose of the minimum does when the target moves."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from soma_core.inversion.prior_curvature import Priors
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.protocol import Curvature, ForwardModel

__all__ = ["EXACT", "INDEFINITE", "attach_gradient", "attached", "conjugate_gradients"]

_CHUNK = 64
"""Frames treated at a time."""

_ROUNDS, _ACCURATE = 200, 1e-8
"""Largest number of products with the curvature; a frame is done when this share of its slope is left."""

_RIDGE = 1e-13
"""What a turn by one radian costs, as the square of an error of every vertex [m]: gradients of what the
target does not determine stay finite."""

_DAMPING = 1e-6
"""Of the moments' matrix, relative to its diagonal."""

_STEPS, _FINE, _LONGEST = 3, 1e-9, 0.05
"""Newton steps from the fit to the minimum, how near that is as a root mean square over the vertices [m], and
how far a step may go [rad, m]."""

EXACT, _FOLDED, INDEFINITE = 0, 1, 2
_TROUBLE = {
    _FOLDED: "got the gradient of one side: they rest in a fold of the model, where a corrective sets in",
    INDEFINITE: "got no gradient: their error curves downwards where they rest, which is no minimum",
}


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

    At a minimum the slope ``g(pose, x) = J^T O (y - x)``, priors included, is zero, hence
    ``d pose = H^-1 J^T O dx`` with the exact second derivative H of half the error: J^T O J, the curvature
    that the residual adds, and that of the priors. The system is solved in float64 by conjugate gradients
    with the moments' matrix as preconditioner, at the minimum next to the fit.

    Frames that are not valid get no gradient. Frames whose error curves downwards, which are not at a
    minimum, get none either, and frames that rest in a fold of the model that of one side: a
    ``RuntimeWarning`` in the backward pass counts and names both. Exact targets have neither.

    Args:
        vertices: targets (F, v, 3) [m] that the fit was made for.
        rotations: (F, J - 1, 3, 3), T-pose-relative, and translation (F, 3) [m]: the fit.
        model: that was fitted.
        problem: of a chunk of the frames; no gradient reaches its identity and weights.
        valid: (F,) bool.
    """

    def pulled(*frames: Tensor) -> tuple[Tensor, Tensor]:
        found = []
        for first in range(0, len(valid), _CHUNK) or (0,):
            chunk = slice(first, first + _CHUNK)
            with torch.autocast(rotations.device.type, enabled=False):
                own = (one[chunk] for one in (*frames, valid))
                found.append(_pull_back(model, problem(chunk), *own))
        grads, states = (torch.cat(parts) for parts in zip(*found, strict=True))
        return grads, states

    return attached(vertices, rotations, translation, pulled)


def attached(
    target: Tensor,
    rotations: Tensor,
    translation: Tensor,
    pulled: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
) -> tuple[Tensor, Tensor]:
    """Rotations and translation of a fit with a derivative by its target.

    Args:
        target: of the fit.
        rotations, translation: its minimum.
        pulled: from the minimum, and derivatives by both of its parts, that by the target, and what each
            frame is (F,), for a warning.
    """
    return _Implicit.apply(target, rotations, translation, pulled)


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, _target: Tensor, rotations: Tensor, translation: Tensor, pulled: Any
    ) -> tuple[Tensor, Tensor]:
        ctx.pulled = pulled
        ctx.save_for_backward(rotations, translation)
        return rotations.clone(), translation.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_rotations: Tensor, by_translation: Tensor) -> tuple[Tensor, None, None, None]:
        grad, states = ctx.pulled(*ctx.saved_tensors, by_rotations, by_translation)
        _warn(states)
        return grad, None, None, None


def _pull_back(
    model: ForwardModel,
    problem: Problem,
    rotations: Tensor,
    translation: Tensor,
    by_rotations: Tensor,
    by_translation: Tensor,
    valid: Tensor,
) -> tuple[Tensor, Tensor]:
    """Gradient (F, v, 3) by the target of a chunk of frames, and what each is (F,)."""
    eye = model.solver.eye.expand(len(rotations), 1, 3, 3)
    pose = Pose.begin(torch.cat((eye, rotations), 1), translation - problem.origin)
    system, smooth = _System.at(model, problem, pose).settled()
    slope = _slope(system, by_rotations.double(), by_translation.double())
    motion, good = system.solve(torch.where(valid[:, None, None], slope, 0.0))
    moved = problem.weights[..., None] * system.pulled(motion).to(rotations)
    state = torch.where(good, torch.where(smooth, EXACT, _FOLDED), INDEFINITE)
    return torch.where(valid[:, None, None], moved, 0.0), state * valid


def _slope(system: _System, by_rotations: Tensor, by_translation: Tensor) -> Tensor:
    """Derivative (F, n + 1, 3) by turns in world axes and by the translation, from that by matrix entries."""
    solver = system.model.solver
    n = solver.variables
    product = system.pose.relative[:, n] @ by_rotations[:, n - 1].mT
    torque = torch.stack(
        (
            product[..., 1, 2] - product[..., 2, 1],
            product[..., 2, 0] - product[..., 0, 2],
            product[..., 0, 1] - product[..., 1, 0],
        ),
        -1,
    )
    torque = (system.turns[:, solver.parents[n]] @ torque[..., None]).squeeze(-1)
    return torch.cat((torque, by_translation[:, None]), 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class _System:
    """Half the second derivative of what a fit lowers, at poses; hinges turn about their axis alone.

    Attributes:
        pose: in float64.
        turns: world turns of the joints that it holds.
        slope: half the first derivative (F, n + 1, 3).
        inverse: about that of the matrix.
    """

    model: ForwardModel
    problem: Problem
    pose: Pose
    turns: Tensor
    curvature: Curvature
    priors: Priors
    slope: Tensor
    inverse: Callable[[Tensor], Tensor]

    @classmethod
    def at(cls, model: ForwardModel, problem: Problem, pose: Pose) -> _System:
        kind = problem.origin.dtype
        rough = replace(pose, relative=pose.relative.to(kind), translation=pose.translation.to(kind))
        pose = replace(pose, relative=pose.relative.double(), translation=pose.translation.double())
        turns, _ = model.solver.walk_public(pose, problem.rest.offsets.double())
        curvature = model.curvature(problem, pose)
        mass = problem.weights.sum(1).expand(len(turns))
        priors = Priors(model.solver, problem, pose, turns, curvature)
        inverse = model.inverse(
            problem, rough, model.view(problem, rough), torch.full_like(mass, _DAMPING), mass
        )
        return cls(
            model=model, problem=problem, pose=pose, turns=turns, curvature=curvature, priors=priors,
            slope=priors.slope, inverse=lambda slope: inverse(slope.to(kind)).double(),
        )  # fmt: skip

    def settled(self) -> tuple[_System, Tensor]:
        """The same at the minimum next to the poses, and (F,) whether steps led there."""
        system, solver, off = self, self.model.solver, self.decrement()
        smooth = torch.ones_like(off, dtype=torch.bool)
        for _ in range(_STEPS):
            wanted = smooth & (off > _FINE)
            if not bool(wanted.any()):
                break
            step, good = system.solve(torch.where(wanted[:, None, None], -system.slope, 0.0))
            step = torch.where((step.abs().amax((1, 2)) < _LONGEST)[:, None, None], step, 0.0)
            trial = _System.at(self.model, self.problem, solver.retract(system.pose, system.turns, step))
            reached = trial.decrement()
            smooth = smooth & ~(wanted & good & (reached > 0.5 * off))
            better = reached < off
            pose = system.pose
            if bool((wanted & ~better).any()):
                kept = torch.where(better[:, None, None, None], trial.pose.relative, pose.relative)
                place = torch.where(better[:, None], trial.pose.translation, pose.translation)
                trial = _System.at(self.model, self.problem, replace(pose, relative=kept, translation=place))
            system, off = trial, trial.decrement()
        return system, smooth

    def decrement(self) -> Tensor:
        """How far a Newton step would move the vertices, about, as a root mean square (F,) [m]."""
        slope = self.free(self.slope)
        gain = _inner(slope, self.free(self.inverse(slope))).clamp_min(0)
        return (gain / self.problem.weights.double().sum(1)).sqrt()

    def pulled(self, motion: Tensor) -> Tensor:
        """Gradient (F, v, 3) by the target of a motion's derivative, vertex weights left out."""
        return self.priors.pulled(motion)

    def times(self, motion: Tensor) -> Tensor:
        """The matrix times a motion (F, n + 1, 3)."""
        ridge = _RIDGE * self.problem.weights.double().sum(1)[:, None, None]
        return self.free(self.priors.times(motion) + ridge * motion)

    def free(self, motion: Tensor) -> Tensor:
        """The part of a motion that hinges allow."""
        terms = self.problem.terms
        if terms is None:
            return motion
        solver = self.model.solver
        above = self.turns[:, solver.parents[solver.variables]]
        axis = (above @ terms.hinge_axis.double()[..., None]).squeeze(-1)
        along = (motion[:, :-1] * axis).sum(-1, keepdim=True) * axis
        hinge = (terms.hinge_axis != 0).any(-1)[:, None]
        return torch.cat((torch.where(hinge, along, motion[:, :-1]), motion[:, -1:]), 1)

    def solve(self, slope: Tensor) -> tuple[Tensor, Tensor]:
        """Motions (F, n + 1, 3) that the matrix maps to slopes, and (F,) whether it is positive there."""
        return conjugate_gradients(
            self.times, lambda left: self.free(self.inverse(left)), self.free(slope), rounds=_ROUNDS,
            accurate=_ACCURATE,
        )  # fmt: skip


def _inner(one: Tensor, other: Tensor) -> Tensor:
    return (one * other).flatten(1).sum(1)


def conjugate_gradients(
    times: Callable[[Tensor], Tensor],
    inverse: Callable[[Tensor], Tensor],
    right: Tensor,
    *,
    rounds: int,
    accurate: float,
    inner: Callable[[Tensor, Tensor], Tensor] = _inner,
) -> tuple[Tensor, Tensor]:
    """Vectors (F, ...) that a matrix maps to others, and (F,) whether it is positive there; else zeros.

    Args:
        times: the matrix times vectors (F, ...).
        inverse: about that of the matrix.
        right: (F, ...).
        rounds: largest number of products with the matrix.
        accurate: a frame is done when this share of it is left.
        inner: products (F,) of two vectors; one number for all where their frames are one system.
    """
    left, found = right, torch.zeros_like(right)
    good = torch.ones(len(left), dtype=torch.bool, device=left.device)
    way = near = inverse(left)
    size, enough = inner(left, near), accurate**2 * inner(left, left)
    moving = size > 0
    for _ in range(rounds):
        if not bool(moving.any()):
            break
        bent = times(way)
        curved = inner(way, bent)
        good = good & ~(moving & ~(curved > 0))
        moving = moving & good
        step = _quotient(size, curved, moving, left)
        found, left = found + step * way, left - step * bent
        near = inverse(left)
        new = inner(left, near)
        moving = moving & (inner(left, left) > enough)
        way = near + _quotient(new, size, moving, left) * way
        size = new
    return torch.where(_along(good, found), found, 0.0), good


def _quotient(above: Tensor, below: Tensor, where: Tensor, like: Tensor) -> Tensor:
    """(F, 1, ...), zero elsewhere."""
    return _along(torch.where(where, above / torch.where(where, below, 1.0), 0.0), like)


def _along(values: Tensor, like: Tensor) -> Tensor:
    return values.view(-1, *[1] * (like.ndim - 1))


def _warn(states: Tensor) -> None:
    for state, trouble in _TROUBLE.items():
        frames = torch.nonzero(states == state).flatten().tolist()
        if frames:
            named = ", ".join(map(str, frames[:5])) + (", ..." if len(frames) > 5 else "")
            text = f"{len(frames)} of {len(states)} frames ({named}) {trouble}"
            warnings.warn(text, RuntimeWarning, stacklevel=2)
