"""Pose blend shapes of a native model: measured where linear, differentiated by autograd where not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix

if TYPE_CHECKING:
    from soma_core.inversion.gauss_newton import GaussNewton
    from soma_core.inversion.problem import Pose, Problem, View
    from soma_core.skeleton.identity import Identity

__all__ = ["BlendedCurvature", "blend_shapes", "blended_view", "is_linear"]

_BATCH = 64
"""Blend shapes evaluated at a time."""

_ROUNDING = 64
"""Multiples of the dtype's rounding, relative to the largest offset, that linear shapes may be off by."""

_STEP = 1e-4
"""Largest turn [rad] and shift [m] of a central difference along one direction, in float64."""


class PosedModel(Protocol):
    """A skin model that can also pose bodies under all that the native model does."""

    solver: GaussNewton

    def posed(self, identity: Identity, rotations: Tensor, pelvis: Tensor) -> Tensor:
        """Vertices (F, n, 3) [m] under local rotations (F, J, 3, 3); differentiable."""
        ...


def blend_shapes(
    offsets: Callable[[Tensor], Tensor], joint_count: int, *, dtype: torch.dtype, device: torch.device | str
) -> Tensor:
    """What each entry of each local rotation adds to the rest mesh, (9 J, n, 3).

    Args:
        offsets: maps local rotations (batch, J, 3, 3) to (batch, n, 3).
        joint_count: J.
    """
    still = torch.eye(3, dtype=dtype, device=device).expand(1, joint_count, 3, 3)
    entries = torch.eye(9 * joint_count, dtype=dtype, device=device).view(-1, joint_count, 3, 3)
    at_rest = offsets(still)
    return torch.cat([offsets(still + part) - at_rest for part in entries.split(_BATCH)])


def is_linear(offsets: Callable[[Tensor], Tensor], shapes: Tensor) -> bool:
    """Whether offsets are shapes (9 J, n, 3) times the change of the rotations, at poses far from rest."""
    count = len(shapes) // 9
    angles = torch.linspace(-2.5, 2.5, 6 * count).to(shapes).view(2, count, 3)
    turned = axis_angle_to_matrix(torch.cat((0 * angles[:1], angles)))
    change = turned - torch.eye(3).to(shapes)
    found, told = offsets(turned), torch.einsum("bm,mvc->bvc", change.flatten(1), shapes)
    close = _ROUNDING * torch.finfo(shapes.dtype).eps * float(found.abs().max())
    return bool((found - told).abs().max() <= close)


def blended_view(rig: PosedModel, problem: Problem, pose: Pose, view: View) -> View:
    """A view with the error of poses whose blend shapes are not linear, and its derivative by autograd."""
    motion = torch.zeros_like(pose.relative[:, : len(rig.solver.variables) + 1, 0]).requires_grad_()
    turns, _ = rig.solver.walk(pose, problem.rest)
    with torch.enable_grad():
        energy = _energy(rig, problem, rig.solver.retract(pose, turns, motion))
        (slope,) = torch.autograd.grad(0.5 * energy.sum(), motion)
    return replace(view, energy=energy.detach().to(slope), slope=slope)


class BlendedCurvature:
    """Curvature of such a model at poses, by differences of its derivative; see :class:`Curvature`.

    In float64 as far as the model itself is.

    Args:
        rig: the model.
        problem: targets, weights and identity.
        pose: about the problem's origin.

    Attributes:
        energy: of the poses, (F,) [m^2].
        slope: half its derivative (F, n + 1, 3).
    """

    def __init__(self, rig: PosedModel, problem: Problem, pose: Pose) -> None:
        self._rig, self._problem = rig, problem
        kind = problem.origin.dtype
        self._pose = replace(pose, relative=pose.relative.to(kind), translation=pose.translation.to(kind))
        self._turns, _ = rig.solver.walk(self._pose, problem.rest)
        # An ordinary difference of float32 slopes would lose half their digits.
        self._step = _STEP if kind == torch.float64 else 3e-3
        still = torch.zeros_like(self._turns[:, : len(rig.solver.variables) + 1, 0])
        self.slope = self._slope(still).double()
        self.energy = _energy(rig, problem, self._pose).double()

    def times(self, motion: Tensor) -> Tensor:
        """Half the second derivative of the error, times a motion (F, n + 1, 3)."""
        return self._difference(self._slope, motion)

    def moved(self, motion: Tensor) -> Tensor:
        """Velocities (F, v, 3) of the vertices in a motion (F, n + 1, 3)."""
        return self._difference(lambda step: _posed(self._rig, self._problem, self._near(step)), motion)

    def residual(self) -> Tensor:
        """What is left of the targets, (F, v, 3) [m]."""
        problem = self._problem
        there = _posed(self._rig, problem, self._pose) - (problem.vertices - problem.origin[:, None])
        return there.double()

    def _near(self, motion: Tensor) -> Pose:
        return self._rig.solver.retract(self._pose, self._turns, motion)

    def _slope(self, motion: Tensor) -> Tensor:
        with torch.enable_grad():
            at = motion.detach().requires_grad_()
            half = 0.5 * _energy(self._rig, self._problem, self._near(at)).sum()
            return torch.autograd.grad(half, at)[0]

    def _difference(self, function: Callable[[Tensor], Tensor], motion: Tensor) -> Tensor:
        length = motion.norm(dim=-1).amax(1)[:, None, None].clamp_min(1e-100)
        way = (self._step * motion / length).to(self._problem.origin)
        ahead, behind = (function(sign * way).double() for sign in (1, -1))
        return (ahead - behind) * (length / (2 * self._step))


def _posed(rig: PosedModel, problem: Problem, pose: Pose) -> Tensor:
    """Vertices (F, n, 3) about the problem's origin."""
    return rig.posed(problem.identity, pose.relative[:, 1:], pose.translation)


def _energy(rig: PosedModel, problem: Problem, pose: Pose) -> Tensor:
    step = _posed(rig, problem, pose) - (problem.vertices - problem.origin[:, None])
    return (problem.weights * step.square().sum(-1)).double().sum(1)
