"""Gradient descent through the forward model: Adam on 6D rotations (paper, section 3.6; Zhou et al., 2019)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from soma_core.animation.engine import Animation
from soma_core.errors import InputError
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.problem import Pose, Problem

__all__ = ["Autograd", "AutogradOptions", "from_six", "to_six"]

_POSED_AT_A_TIME = 64
"""Frames that pass through skinning together, which bounds memory; frames do not influence each other."""

_MM2 = 1e6
"""Square metres to square millimetres: keeps gradients far above Adam's epsilon."""


@dataclass(frozen=True, kw_only=True)
class AutogradOptions:
    """How gradient descent runs.

    Attributes:
        iterations: number of steps of Adam.
        rate: first learning rate of the rotations, about the angle [rad] of a joint's first step.
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
    final: float = 0.02
    regions: Mapping[str, float] = field(default_factory=dict)
    loss: Literal["moments", "vertices"] = "moments"
    penalty: Callable[[Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        for name in ("iterations", "rate", "shift_rate", "final"):
            value, default = getattr(self, name), type(self).__dataclass_fields__[name].default
            if value < 0:
                raise InputError(
                    f"autograd.{name}", got=value, expected="at least 0", fix=f"Pass {name}={default}."
                )
        for name, factor in self.regions.items():
            if factor < 0:
                raise InputError(
                    f"autograd.regions[{name!r}]",
                    got=factor,
                    expected="at least 0",
                    fix="Use 0 to leave it out.",
                )
        if self.loss not in ("moments", "vertices"):
            raise InputError(
                "autograd.loss", got=repr(self.loss), expected="'moments' or 'vertices'", fix="Correct the name."
            )
        if self.penalty is not None and self.loss != "vertices":
            raise InputError(
                "autograd.penalty",
                got=f"one with loss={self.loss!r}",
                expected="none: moments know only the squared distance",
                fix="Pass loss='vertices'.",
            )


def to_six(rotation: Tensor) -> Tensor:
    """First two columns of rotations, (..., 3, 3) -> (..., 3, 2)."""
    return rotation[..., :2]


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
        animation: the forward model, for ``loss="vertices"``.
    """

    def __init__(self, solver: GaussNewton, animation: Animation) -> None:
        super().__init__()
        self.solver, self.animation = solver, animation

    def forward(self, problem: Problem, start: Pose, options: AutogradOptions) -> Pose:
        """Refine `start`; never worse than it in the loss of `options`.

        Args:
            problem: the frames; its weights are final, regions included.
            start: poses to begin from.
            options: steps, rates and loss.
        """
        if options.loss == "moments":
            return self._descend(start, options, *self._moments(problem, start))
        parts = []
        for first in range(0, len(start.relative), _POSED_AT_A_TIME):
            chunk = slice(first, first + _POSED_AT_A_TIME)
            part = Pose(**{name: value[chunk] for name, value in vars(start).items()})
            parts.append(self._descend(part, options, *self._vertices(problem.part(chunk), options)))
        return Pose(**{name: torch.cat([getattr(part, name) for part in parts]) for name in vars(start)})
