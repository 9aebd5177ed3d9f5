"""Gradient descent through the forward model: Adam on rotations in 6D (paper, section 3.6).

The 6D parametrisation is that of Zhou et al., "On the continuity of rotation representations", CVPR 2019.
What descends is the turn of each joint from the T-pose to the world, not from its parent: a step of the spine
then carries the arms along without turning them, and a hundred steps reach the optimum, which local rotations
do not.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.engine import Animation
from soma_core.errors import InputError
from soma_core.geometry.constants import constant
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.problem import Pose, Problem, part_of

__all__ = ["Autograd", "AutogradOptions", "from_six"]

_POSED_AT_A_TIME = 64
"""Frames that pass through skinning together, which bounds memory; frames do not influence each other."""

_Loss = Callable[[Tensor, Tensor], Tensor]
"""(F,) from turns (F, J, 3, 3) and translations (F, 3)."""

_MM2 = 1e6
"""Square metres to square millimetres: keeps gradients far above Adam's epsilon."""

_BETAS = (0.8, 0.9)
"""Adam's memory, shorter than usual: of a hundred steps, the first say little about the last."""


@dataclass(frozen=True, kw_only=True)
class AutogradOptions:
    """How gradient descent runs.

    Attributes:
        iterations: number of steps of Adam.
        rate: first learning rate of the turns, about the angle [rad] of a joint's first step.
        shift_rate: first learning rate of the translation, about its first step [m].
        final: last learning rate, relative to the first; it falls along a half cosine.
        regions: factor on the vertex weights of a region of ``body_regions``: body, hands, feet, head or
            face_interior; 1 where not given.
        loss: ``moments``, the squared distances as a quadratic in the joint transforms, at a cost that does
            not depend on the mesh; or ``vertices``, through skinning, for the sake of `penalty`.
        penalty: applied to the squared distance of every vertex [m^2] under ``vertices``; by default the
            squared distance itself counts. Elementwise and differentiable.

    Raises:
        InputError: a number out of range, or a penalty that would not be used.
    """

    iterations: int = 100
    rate: float = 0.02
    shift_rate: float = 0.002
    final: float = 0.005
    regions: Mapping[str, float] = field(default_factory=dict)
    loss: Literal["moments", "vertices"] = "moments"
    penalty: Callable[[Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        for name in ("iterations", "rate", "shift_rate", "final"):
            value, default = getattr(self, name), type(self).__dataclass_fields__[name].default
            if not value >= 0:
                raise InputError(
                    f"autograd.{name}", got=value, expected="at least 0", fix=f"Pass {name}={default}."
                )
        for name, factor in self.regions.items():
            if not factor >= 0:
                raise InputError(
                    f"autograd.regions[{name!r}]",
                    got=factor,
                    expected="at least 0",
                    fix="Use 0 to leave it out.",
                )
        if self.loss not in ("moments", "vertices"):
            raise InputError(
                "autograd.loss",
                got=repr(self.loss),
                expected="'moments' or 'vertices'",
                fix="Correct the name.",
            )
        if self.penalty is not None and self.loss != "vertices":
            raise InputError(
                "autograd.penalty",
                got=f"one with loss={self.loss!r}",
                expected="none: moments know only the squared distance",
                fix="Pass loss='vertices'.",
            )

    def decay(self, step: int) -> float:
        """Learning rate of a step, relative to the first."""
        done = step / max(self.iterations - 1, 1)
        return self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * min(done, 1)))


def from_six(columns: Tensor) -> Tensor:
    """Rotations from two columns, made orthonormal one after the other, (..., 3, 2) -> (..., 3, 3)."""
    first = torch.nn.functional.normalize(columns[..., 0], dim=-1)
    second = columns[..., 1]
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second, dim=-1)), -1)


class Autograd(torch.nn.Module):
    """Adam from a start, in 6D; returns the best state of each frame, the start included.

    Args:
        solver: keeps the tree and multiplies by the moments.
        animation: the forward model.
        regions: vertex ids of each region that `options` may weigh.
        options: steps, rates and loss.

    Raises:
        InputError: a region that the mesh does not have.
    """

    def __init__(
        self,
        solver: GaussNewton,
        animation: Animation,
        *,
        regions: Mapping[str, np.ndarray],
        options: AutogradOptions,
    ) -> None:
        super().__init__()
        self.solver, self.animation, self.options = solver, animation, options
        for name in options.regions:
            if name not in regions:
                raise InputError(
                    "autograd.regions",
                    got=repr(name),
                    expected=f"among {', '.join(regions)}",
                    fix="Correct it.",
                )
        self.regions = {name: torch.as_tensor(regions[name]) for name in options.regions}
        with torch.inference_mode(mode=False):
            keep = functools.partial(constant, device=solver.joints.device)
            self.joints, self.variables = keep(_usable(solver.joints)), keep(_usable(solver.variables))
            self.parents = keep(_usable(solver.parents))

    def weighted(self, weights: Tensor) -> Tensor:
        """Vertex weights (..., v) times the factors of their regions."""
        weights = weights.clone()
        for name, ids in self.regions.items():
            weights[..., ids.to(weights.device)] *= self.options.regions[name]
        return weights

    def forward(self, problem: Problem, start: Pose) -> Pose:
        """Refine `start`; never worse than it in the loss of the options.

        Works under ``no_grad`` and ``inference_mode``; nothing is differentiable in the result.

        Args:
            problem: the frames; its weights and moments are those of :meth:`weighted`.
            start: poses to begin from.
        """
        with torch.inference_mode(mode=False), torch.enable_grad():
            problem, start = _usable(problem), _usable(start)
            if self.options.loss == "moments":
                return self._descend(start, problem.rest.offsets, self._by_moments(problem, start))
            parts, offsets = [], problem.rest.offsets
            for first in range(0, len(start.relative), _POSED_AT_A_TIME):
                chunk = slice(first, first + _POSED_AT_A_TIME)
                part = Pose(**{name: value[chunk] for name, value in vars(start).items()})
                bones = offsets[chunk] if len(offsets) > 1 else offsets
                parts.append(self._descend(part, bones, self._by_vertices(problem, part, chunk)))
            return Pose(**{name: torch.cat([getattr(part, name) for part in parts]) for name in vars(start)})

    def _by_moments(self, problem: Problem, start: Pose) -> _Loss:
        """Mean squared distance [m^2] beyond that of the start, exact for any step."""
        solver, rest, joints = self.solver, problem.rest, self.joints
        second, mass = solver.dense(rest.second), rest.own[..., 3, 3].sum(1)
        turns, places = solver.walk(start, rest)
        residual = solver.gradient(turns, places, second, problem.target)

        def loss(turned: Tensor, shift: Tensor) -> Tensor:
            above = turned[:, self.parents]
            placed = self.animation.kinematics.positions(above, rest.offsets, shift)
            change = torch.cat((turned - turns, (placed - places)[..., None]), -1)[:, joints]
            product = solver.times_second(change, second)
            return (change * (product + 2 * residual)).sum((1, 2, 3)) / mass

        return loss

    def _by_vertices(self, problem: Problem, start: Pose, chunk: slice) -> _Loss:
        """Weighted mean of the penalised squared distances [m^2] under the forward model."""
        penalty, identity = self.options.penalty, part_of(problem.identity, chunk)
        target = problem.vertices[chunk] - problem.origin[chunk, None]
        weights, scale = (
            value[chunk] if value is not None and len(value) > 1 else value
            for value in (problem.weights, problem.bone_scale)
        )
        assert weights is not None
        total = weights.sum(1).clamp_min(torch.finfo(weights.dtype).tiny)

        def loss(turned: Tensor, shift: Tensor) -> Tensor:
            relative = self._relative(start, turned)[:, 1:]
            posed = self.animation.pose(identity, relative, shift, absolute=False, bone_scale=scale)
            squared = (posed.vertices - target).square().sum(-1)
            return (weights * (squared if penalty is None else penalty(squared))).sum(1) / total

        return loss

    def _descend(self, start: Pose, offsets: Tensor, loss: _Loss) -> Pose:
        """Adam on the first two columns of every variable turn and on the translation."""
        options, n = self.options, self.variables
        turns, _ = self.solver.walk_public(start, offsets)
        six, shift = turns[:, n, :, :2].clone().requires_grad_(), start.translation.clone().requires_grad_()
        groups = [{"params": [six], "lr": options.rate}, {"params": [shift], "lr": options.shift_rate}]
        adam = torch.optim.Adam(groups, betas=_BETAS)
        fall = torch.optim.lr_scheduler.LambdaLR(adam, options.decay)
        with torch.no_grad():
            lowest = value = loss(turns, start.translation)
        best_six, best_shift = six.detach().clone(), start.translation.clone()
        taken = torch.zeros_like(start.accepted)
        for step in range(options.iterations + 1):
            last, value = value.detach(), loss(turns.index_copy(1, n, from_six(six)), shift)
            better = (value.detach() < lowest) & (step > 0)
            taken = taken + better
            lowest = torch.where(better, value.detach(), lowest)
            best_six = torch.where(better[:, None, None, None], six.detach(), best_six)
            best_shift = torch.where(better[:, None], shift.detach(), best_shift)
            if step < options.iterations:
                six.grad, shift.grad = torch.autograd.grad(_MM2 * value.sum(), (six, shift))
                adam.step()
                fall.step()
        found = self._relative(start, turns.index_copy(1, n, from_six(best_six)))
        return replace(
            start,
            relative=torch.where((taken > 0)[:, None, None, None], found, start.relative),
            translation=best_shift,
            accepted=start.accepted + taken,
            last_change=(value.detach() - last).abs().sqrt(),
        )

    def _relative(self, start: Pose, turns: Tensor) -> Tensor:
        """Relative rotations (F, J, 3, 3) of turns; joints that carry no weight follow their parent."""
        n = self.variables
        above = turns[:, self.parents[n]]
        return start.relative.index_copy(1, n, above.transpose(-1, -2) @ turns[:, n])


def _usable(value: Any) -> Any:
    """The same value, of tensors that autograd may save: those made in inference mode are copied."""
    if isinstance(value, Tensor):
        return value.clone() if value.is_inference() else value
    if not is_dataclass(value) or isinstance(value, type):
        return value
    return replace(value, **{one.name: _usable(getattr(value, one.name)) for one in fields(value)})
