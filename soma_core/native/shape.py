"""The parameters of a native body beside its poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from soma_core.inversion.levenberg import Bounded, Damping, bounded_step, descend
from soma_core.inversion.problem import Pose
from soma_core.native.poses import PoseFit
from soma_core.skeleton.identity import Identity

__all__ = ["Unknowns", "fit_shape"]

_DOUBT = 1e-4
"""A parameter away from its start by one costs as much as this error of every vertex [m], so that it decides
only what the frames leave open."""

_RIDGE = 1e-6
"""Relative to the diagonal of the poses' matrix, which is eliminated."""

_RESTING = 1e-3
"""The search ends with a step that lowers the error by less, relatively."""

_DAMPING = Damping(tries=5, start=1e-6)


class Unknowns(Bounded, Protocol):
    """What a search moves in, such as :class:`FreeParameters`."""

    def params(self, points: np.ndarray) -> dict[str, Tensor]:
        """Parameters of (m, k) points, each (m, *shape)."""
        ...

    def inward(self, point: np.ndarray, length: float) -> np.ndarray:
        """Steps (k,) of `length` away from the nearer bound."""
        ...


def fit_shape(
    prepare: Callable[[np.ndarray], PoseFit],
    directions: Callable[[np.ndarray], Identity],
    unknowns: Unknowns,
    target: Tensor,
    *,
    start: np.ndarray,
    iterations: int,
) -> tuple[np.ndarray, float]:
    """Parameters (k,) whose best poses come nearest to the targets, and the error [m] as a root mean square.

    Args:
        prepare: the pose fit of the body of a point (k,).
        directions: what one unit of each parameter adds to rest vertices and joints there, batch of k [m].
        unknowns: the parameters.
        target: (F, n, 3) [m], finite.
        start: where to begin, (k,).
        iterations: largest number of steps.
    """

    def state(point: np.ndarray) -> _State:
        fit = prepare(point)
        pose = fit(target)
        squares = float(((fit.posed(pose) - target).square().sum(-1) @ fit.weights).double().sum())
        away = float(np.square(point - unknowns.start).sum())
        error = squares + _doubt(fit, target) * away
        return _State(point=point, fit=fit, pose=pose, squares=squares, error=error)

    def attempts(now: _State) -> Callable[[float], tuple[_State, bool, bool]]:
        matrix, slope = _normal_equations(now.fit, directions(now.point), now.pose, target)
        matrix += _doubt(now.fit, target) * np.eye(len(slope))
        slope += _doubt(now.fit, target) * (now.point - unknowns.start)

        def attempt(damping: float) -> tuple[_State, bool, bool]:
            trial = state(bounded_step(unknowns, now.point, matrix, slope, damping))
            return trial, trial.error < now.error, trial.error > (1 - _RESTING) * now.error

        return attempt

    found, _ = descend(state(start), attempts, damping=_DAMPING, iterations=iterations)
    return found.point, (found.squares / (len(target) * float(found.fit.weights.sum()))) ** 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class _State:
    """A body under way, its frames in their best poses."""

    point: np.ndarray
    fit: PoseFit
    pose: Pose
    squares: float
    error: float


def _doubt(fit: PoseFit, target: Tensor) -> float:
    return _DOUBT**2 * len(target) * float(fit.weights.sum())


def _normal_equations(
    fit: PoseFit, directions: Identity, pose: Pose, target: Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and slope by the parameters, each frame in its best pose (the Schur complement)."""
    solver, moments, rest, count = fit.rig.solver, fit.rig.moments, fit.rest, len(directions)
    turns, places = solver.walk(pose, rest)
    residual = (fit.posed(pose) - target) * fit.weights[:, None]
    matrix = torch.zeros(count, count, dtype=torch.float64, device=target.device)
    slope = matrix[0].clone()
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
    return matrix.cpu().numpy(), slope.cpu().numpy()
