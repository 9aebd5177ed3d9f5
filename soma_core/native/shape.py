"""The parameters of a native body beside its poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from soma_core.inversion.levenberg import Damping, descend
from soma_core.inversion.problem import Pose
from soma_core.native.poses import PoseFit
from soma_core.skeleton.identity import Identity

__all__ = ["fit_shape"]

_DOUBT = 1e-4
"""A parameter away from its start by one costs as much as this error of every vertex [m], so that it decides
only what the frames leave open."""

_RIDGE = 1e-6
"""Relative to the diagonal of the poses' matrix, which is eliminated."""

_RESTING = 1e-3
"""The search ends with a step that lowers the error by less, relatively."""

_HALVINGS = 4
"""How often a step that would raise the error is tried again at half its length."""


def fit_shape(
    prepare: Callable[[Tensor], PoseFit],
    directions: Callable[[Tensor], Identity],
    start: Tensor,
    target: Tensor,
    *,
    iterations: int,
) -> Tensor:
    """Parameters (k,) whose best poses come nearest to the targets.

    Args:
        prepare: the pose fit of the body of some parameters.
        directions: what one unit of each parameter adds to rest vertices and joints there, batch of k [m].
        start: parameters to begin from, (k,).
        target: (F, n, 3) [m], finite.
        iterations: largest number of steps.
    """

    def state(point: Tensor) -> _State:
        fit = prepare(point)
        pose = fit(target)
        return _State(point=point, fit=fit, pose=pose, error=_error(fit, pose, target, point - start))

    def attempts(now: _State) -> Callable[[float], tuple[_State, bool, bool]]:
        step = 2 * _step(now.fit, directions(now.point), now.pose, target, now.point - start)

        def attempt(_damping: float) -> tuple[_State, bool, bool]:
            step.mul_(0.5)
            trial = state(now.point + step)
            return trial, trial.error < now.error, trial.error > (1 - _RESTING) * now.error

        return attempt

    return descend(state(start), attempts, damping=Damping(tries=_HALVINGS), iterations=iterations)[0].point


@dataclass(frozen=True, kw_only=True, eq=False)
class _State:
    """A body under way, its frames in their best poses."""

    point: Tensor
    fit: PoseFit
    pose: Pose
    error: float


def _error(fit: PoseFit, pose: Pose, target: Tensor, away: Tensor) -> float:
    """Sum of squares, the doubt about the parameters included."""
    squares = (fit.posed(pose) - target).square().sum(-1) @ fit.weights
    return float(squares.double().sum()) + _doubt(fit, target) * float(away.double().square().sum())


def _doubt(fit: PoseFit, target: Tensor) -> float:
    return _DOUBT**2 * len(target) * float(fit.weights.sum())


def _step(fit: PoseFit, directions: Identity, pose: Pose, target: Tensor, away: Tensor) -> Tensor:
    """Gauss-Newton step (k,) once each frame follows with its best pose (the Schur complement)."""
    solver, moments, rest, count = fit.rig.solver, fit.rig.moments, fit.rest, len(away)
    turns, places = solver.walk(pose, rest)
    residual = (fit.posed(pose) - target) * fit.weights[:, None]
    matrix = torch.eye(count, dtype=torch.float64, device=target.device) * _doubt(fit, target)
    slope = _doubt(fit, target) * away.double()
    still = target.new_zeros(count, 3)
    for frame in range(len(target)):
        one = slice(frame, frame + 1)
        turned = pose.relative[one, 1:].expand(count, -1, 3, 3)
        columns = fit.rig.animation.pose(directions, turned, still, absolute=False).vertices
        many = turns[one].expand(count, -1, 3, 3), places[one].expand(count, -1, 3)
        coupling = solver.slopes(*many, rest, moments.of_vectors(columns, rest)).flatten(1)
        own, _ = solver.normal_equations(turns[one], places[one], rest)
        own = own.flatten(3, 4).flatten(1, 2)[0]
        factor = torch.linalg.cholesky(own + _RIDGE * torch.diag(own.diagonal()))
        follow = torch.linalg.solve_triangular(factor, coupling.T, upper=False)
        flat = columns.flatten(1)
        matrix += ((columns * fit.weights[:, None]).flatten(1) @ flat.T - follow.T @ follow).double()
        slope += (flat @ residual[frame].flatten()).double()
    factor = torch.linalg.cholesky(matrix)
    return -torch.cholesky_solve(slope[:, None], factor)[:, 0].to(away)
