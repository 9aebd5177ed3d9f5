"""Levenberg-Marquardt under a native model with pose blend shapes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.problem import Pose
from soma_core.native.model import NativeBody

__all__ = ["Refinement"]

_START_DAMPING = 1e-4
_LOWER, _RAISE, _MOST_DAMPING = 0.2, 8.0, 1e6
"""Levenberg damping, relative to the diagonal: start, factors after a good and a bad step, largest value."""


_MEMORY = 8
"""Steps that are remembered to correct the Gauss-Newton matrix by what blend shapes add to it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """A pose under the whole model.

    Attributes:
        energy: (F,).
        slope: half its derivative by turns in the axes of the parent, and by the translation, (F, n + 1, 3).
        turns, places: of the joints, (F, J, 3, 3) and (F, J, 3).
    """

    energy: Tensor
    slope: Tensor
    turns: Tensor
    places: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """Lowers the error of the model itself from a pose fitted without its blend shapes; never raises it.

    Energy and slope are exact: one evaluation of the model and one derivative a step. The matrix is that of
    the skinning alone, from moments, corrected by the steps taken so far (L-BFGS; Nocedal and Wright,
    Numerical Optimization, 2006, algorithm 7.4): what blend shapes add to it is small in a good model.

    Attributes:
        body: the model.
        solver, rest: moments of the body without blend shapes, and what steps on them.
        target: (F, n, 3) [m]; finite.
        weights: (n,).
    """

    body: NativeBody
    solver: GaussNewton
    rest: RestMoments
    target: Tensor
    weights: Tensor

    def __call__(self, start: Pose, *, iterations: int, tolerance: float) -> Pose:
        """Refine poses.

        Args:
            start: where to begin; translations are in the frame of `target`.
            iterations: largest number of steps.
            tolerance: a frame rests once a step changed its energy by less, as a root mean square [m].
        """
        mass = self.weights.sum()
        pose = replace(start, accepted=torch.zeros_like(start.accepted))
        view = self._look(pose)
        damping = torch.full_like(start.last_change, _START_DAMPING)
        moving = torch.ones_like(start.accepted, dtype=torch.bool)
        taken: deque[tuple[Tensor, Tensor]] = deque(maxlen=_MEMORY)
        for _ in range(iterations):
            step = self._step(view, damping, taken)
            trial = self.solver.retract(pose, view.turns, self._in_world(view, step))
            seen = self._look(trial)
            change = seen.energy - view.energy
            better = moving & (change < 0)
            taken.append((step, seen.slope - view.slope))
            last = (change.abs() / mass).sqrt().to(pose.last_change)
            pose = Pose(
                relative=_chosen(better, trial.relative, pose.relative),
                translation=_chosen(better, trial.translation, pose.translation),
                accepted=pose.accepted + better,
                last_change=torch.where(moving, last, pose.last_change),
            )
            parts = vars(seen).items()
            view = _View(**{name: _chosen(better, value, getattr(view, name)) for name, value in parts})
            damping = (damping * torch.where(better, _LOWER, _RAISE).to(damping)).clamp_max(_MOST_DAMPING)
            moving = moving & ~(pose.last_change < tolerance)
            if not bool(moving.any()):
                break
        return pose

    def _look(self, pose: Pose) -> _View:
        rotations = pose.relative[:, 1:].detach().requires_grad_()
        pelvis = pose.translation.detach().requires_grad_()
        with torch.enable_grad():
            step = self.body.posed(rotations, pelvis) - self.target
            energy = (self.weights * step.square().sum(-1)).double().sum(1)
            by_rotations, by_pelvis = torch.autograd.grad(energy.sum(), (rotations, pelvis))
        product = (rotations.detach() @ by_rotations.transpose(-1, -2))[:, self.solver.variables - 1]
        torque = torch.stack(
            (
                product[..., 1, 2] - product[..., 2, 1],
                product[..., 2, 0] - product[..., 0, 2],
                product[..., 0, 1] - product[..., 1, 0],
            ),
            -1,
        )
        turns, places = self.solver.walk(pose, self.rest.offsets)
        slope = 0.5 * torch.cat((torque, by_pelvis[:, None]), 1)
        return _View(energy=energy.detach(), slope=slope, turns=turns, places=places)

    def _step(self, view: _View, damping: Tensor, taken: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
        """Step (F, n + 1, 3) in the axes of the parents: the two loops of L-BFGS about the damped matrix."""
        none = view.turns.new_zeros(len(damping), len(self.solver.joints), 3, 4)
        matrix, _ = self.solver.normal_equations(view.turns, view.places, self.rest.second, none)
        slope, memory = view.slope, []
        for step, change in reversed(taken):
            curvature = (step * change).sum((1, 2), keepdim=True)
            share = torch.where(curvature > 0, 1 / curvature.clamp_min(torch.finfo(slope.dtype).tiny), 0.0)
            along = share * (step * slope).sum((1, 2), keepdim=True)
            slope = slope - along * change
            memory.append((step, change, share, along))
        turned = self._in_world(view, slope)
        ahead = self._in_parents(view, self.solver.damped_step(matrix, turned, damping))
        for step, change, share, along in reversed(memory):
            back = share * (change * ahead).sum((1, 2), keepdim=True)
            ahead = ahead - (along + back) * step
        return ahead

    def _in_world(self, view: _View, vectors: Tensor) -> Tensor:
        above = view.turns[:, self.solver.parents[self.solver.variables]]
        return torch.cat(((above @ vectors[:, :-1, :, None]).squeeze(-1), vectors[:, -1:]), 1)

    def _in_parents(self, view: _View, vectors: Tensor) -> Tensor:
        above = view.turns[:, self.solver.parents[self.solver.variables]].transpose(-1, -2)
        return torch.cat(((above @ vectors[:, :-1, :, None]).squeeze(-1), vectors[:, -1:]), 1)


def _chosen(better: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(better.view(-1, *[1] * (new.ndim - 1)), new, old)
