"""Levenberg-Marquardt under a native model with pose blend shapes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from soma_core.inversion.moments import RestMoments
from soma_core.inversion.problem import Pose
from soma_core.native.blend import BlendMoments
from soma_core.native.model import NativeBody, NativeRig
from soma_core.native.view import View, view_pose

__all__ = ["Refinement"]

_START_DAMPING = 1e-4
_LOWER, _RAISE, _MOST_DAMPING = 0.2, 4.0, 1e6
"""Levenberg damping, relative to the diagonal: start, factors after a good and a bad step, largest value."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """Lowers the error of the model itself from a pose fitted without its blend shapes; never raises it.

    Energy and slope are exact: one evaluation of the model and one derivative a step. The matrix comes
    from moments, of the skinning at each step and of the blend shapes at the first.

    Attributes:
        rig, body: the model.
        rest: moments of the body without blend shapes.
        blend: moments of the blend shapes.
        target: (F, n, 3) [m]; finite.
        weights: (n,).
    """

    rig: NativeRig
    body: NativeBody
    rest: RestMoments
    blend: BlendMoments
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
        pose, view = start, self._view(start)
        damping = torch.full_like(start.last_change, _START_DAMPING)
        raising = torch.full_like(damping, _RAISE)
        moving = torch.ones_like(start.accepted, dtype=torch.bool)
        shaped = self.blend.matrix(pose.relative, view.turns, view.places, self.rig.solver)
        for _ in range(iterations):
            matrix = self._matrix(view) + shaped
            step = self.rig.solver.damped_step(matrix, view.slope, damping)
            trial = self.rig.solver.retract(pose, view.turns, step)
            seen = self._view(trial)
            change = seen.energy - view.energy
            flat = step.flatten(1)
            bent = (matrix.flatten(3, 4).flatten(1, 2) @ flat[..., None]).squeeze(-1)
            gain = change / (flat * (bent + 2 * view.slope.flatten(1))).sum(1).double()
            better = moving & (change < 0)
            last = (change.abs() / mass).sqrt().to(pose.last_change)
            pose = Pose(
                relative=_chosen(better, trial.relative, pose.relative),
                translation=_chosen(better, trial.translation, pose.translation),
                accepted=pose.accepted + better,
                last_change=torch.where(moving, last, pose.last_change),
            )
            parts = vars(seen).items()
            view = View(**{name: _chosen(better, value, getattr(view, name)) for name, value in parts})
            lower = (1 - (2 * gain - 1) ** 3).clamp(1 / 5, 2).to(damping)
            damping = (damping * torch.where(better, lower, raising)).clamp_max(_MOST_DAMPING)
            raising = torch.where(better, _RAISE, 2 * raising)
            moving = moving & ~(pose.last_change < tolerance)
            if not bool(moving.any()):
                break
        return pose

    def _view(self, pose: Pose) -> View:
        return view_pose(self.rig, self.body, self.rest, pose, self.target, self.weights)

    def _matrix(self, view: View) -> Tensor:
        """Gauss-Newton matrix (F, n + 1, 3, n + 1, 3) of the skinning, with the residual's own curvature.

        A residual bends the path of each joint's points. Only what raises the energy is added: the matrix
        stays positive, and steps do not overshoot where two models differ.
        """
        none = view.turns.new_zeros(len(view.turns), len(self.rig.solver.joints), 3, 4)
        matrix, _ = self.rig.solver.normal_equations(view.turns, view.places, self.rest.second, none)
        spread = view.spread[:, self.rig.solver.variables]
        trace = spread.diagonal(dim1=-2, dim2=-1).sum(-1)
        bend = 0.5 * (spread + spread.transpose(-1, -2)) - trace[..., None, None] * self.rig.solver.eye
        values, axes = torch.linalg.eigh(bend)
        bend = (axes * values.clamp_min(0)[..., None, :]) @ axes.transpose(-1, -2)
        each = torch.arange(bend.shape[1], device=bend.device)
        matrix[:, each, :, each] += bend.transpose(0, 1)
        return matrix


def _chosen(better: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(better.view(-1, *[1] * (new.ndim - 1)), new, old)
