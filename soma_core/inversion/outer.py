"""The loop around the solver: residuals that are clipped, and what the full model adds to skinning.

The solver knows linear blend skinning by the public joints and least squares. Twist joints and correctives
are evaluated at the pose under way and taken from the target, so that its moments are made anew once a
round. Where that comes to rest, the full model meets a target that it can meet. On its own it approaches
that point in small steps along what twist leaves nearly open, such as a straight arm turned against its
forearm; Anderson's acceleration takes them together (Walker and Ni 2011).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from soma_core.inversion.comparison import linear_targets
from soma_core.inversion.moments import SkinMoments
from soma_core.inversion.problem import Pose, Problem
from soma_core.layer import SomaLayer

__all__ = ["OuterLoop"]

_MEMORY = 4
"""Earlier rounds that a new pose is combined from."""

_RIDGE = 1e-8
"""Of the combination, relative to the mean of its diagonal."""


class OuterLoop:
    """Repeats a solve against targets made anew.

    Args:
        layer: the forward model.
        moments: of its rig.
        plain: fit plain skinning, whatever the forward model adds.
        robust: residuals beyond this count linearly [m]; None is least squares.
    """

    def __init__(self, layer: SomaLayer, moments: SkinMoments, *, plain: bool, robust: float | None) -> None:
        self.layer, self.moments, self.plain, self.robust = layer, moments, plain, robust

    def __call__(
        self, problem: Problem, pose: Pose, solve: Callable[[Problem, Pose], Pose], *, rounds: int
    ) -> Pose:
        """The pose after `rounds` solves; under least squares, the best of those met, frame by frame."""
        if self.plain:
            for _ in range(rounds):
                targets, _ = self._targets(problem, pose)
                pose = self._solved(problem, targets, pose, solve)
            return pose
        mixing = _Mixing()
        targets, energy = self._targets(problem, pose)
        best, least = replace(pose, last_change=torch.full_like(pose.last_change, torch.inf)), energy
        for _ in range(rounds):
            solved = self._solved(problem, targets, pose, solve)
            pose = mixing(pose, solved)
            targets, energy = self._targets(problem, pose)
            change = (self._deviation(problem, energy) - self._deviation(problem, least)).abs()
            pose = replace(pose, last_change=torch.maximum(solved.last_change, change))
            better = torch.ones_like(energy, dtype=torch.bool) if self.robust else energy < least
            best, least = _chosen(better, pose, best), torch.where(better, energy, least)
        return best

    def _targets(self, problem: Problem, pose: Pose) -> tuple[Tensor, Tensor]:
        turns, places = pose.relative[:, 1:], pose.translation + problem.origin
        return linear_targets(self.layer, problem, turns, places, plain=self.plain, robust=self.robust)

    def _solved(
        self, problem: Problem, targets: Tensor, pose: Pose, solve: Callable[[Problem, Pose], Pose]
    ) -> Pose:
        """The solution for other targets; its translation is about the origin of `problem`."""
        if problem.rest.local.numel():
            target, origin = self.moments.target(targets, problem.rest)
        else:
            _, target, origin = self.moments.each(
                targets, problem.identity, problem.weights, problem.rest.offsets
            )
        moved = replace(problem, vertices=targets, target=target, origin=origin)
        pose = solve(moved, replace(pose, translation=pose.translation + problem.origin - origin))
        return replace(pose, translation=pose.translation + origin - problem.origin)

    @staticmethod
    def _deviation(problem: Problem, energy: Tensor) -> Tensor:
        """Root mean square error (F,) [m]."""
        tiny = torch.finfo(energy.dtype).tiny
        return (energy / problem.weights.sum(1).clamp_min(tiny)).sqrt()


class _Mixing:
    """Anderson's acceleration of a fixed point of poses, frame by frame.

    In float64, so that the difference of two near poses keeps its digits.
    """

    def __init__(self) -> None:
        self.earlier: deque[tuple[Pose, Tensor]] = deque(maxlen=_MEMORY)

    def __call__(self, pose: Pose, solved: Pose) -> Pose:
        """The next pose, from one and its solution, and from earlier such pairs."""
        step = change = _difference(pose, solved)
        if self.earlier:
            steps = torch.stack([step - other for _, other in self.earlier], -1)
            moves = torch.stack([_difference(other, pose) for other, _ in self.earlier], -1)
            square = steps.mT @ steps
            scale = square.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(torch.finfo(torch.float64).tiny)
            eye = torch.eye(square.shape[-1], dtype=square.dtype, device=square.device)
            factor, _ = torch.linalg.cholesky_ex(square + _RIDGE * scale[:, None, None] * eye)
            share = torch.cholesky_solve(steps.mT @ step[..., None], factor)
            change = step - ((moves + steps) @ share).squeeze(-1)
            change = torch.where(torch.isfinite(change).all(-1, keepdim=True), change, step)
        self.earlier.append((pose, step))
        turns = axis_angle_to_matrix(change[:, :-3].unflatten(1, (-1, 3)))
        return replace(
            solved,
            relative=(pose.relative.double() @ turns).to(pose.relative.dtype),
            translation=(pose.translation + change[:, -3:]).to(pose.translation.dtype),
        )


def _difference(first: Pose, second: Pose) -> Tensor:
    """Turn of every joint [rad] and shift [m] from one pose to another, (F, 3 J + 3), float64."""
    turns = matrix_to_axis_angle(first.relative.double().mT @ second.relative.double())
    return torch.cat((turns.flatten(1), second.translation.double() - first.translation.double()), 1)


def _chosen(which: Tensor, first: Pose, second: Pose) -> Pose:
    """Frames of one pose where `which` (F,), of another elsewhere."""

    def pick(name: str) -> Tensor:
        one, other = getattr(first, name), getattr(second, name)
        return torch.where(which.view(-1, *[1] * (one.dim() - 1)), one, other)

    return Pose(**{name: pick(name) for name in ("relative", "translation", "accepted", "last_change")})
