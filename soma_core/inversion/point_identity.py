"""An unknown body from points alone: the backend's parameters, with every frame in its best pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.inversion.free_parameters import FreeParameters
from soma_core.inversion.levenberg import Damping, bounded_step, descend, promising
from soma_core.inversion.point_model import PointModel
from soma_core.inversion.point_rows import PointRows, rows_of
from soma_core.inversion.points import PointInversion
from soma_core.inversion.problem import Pose, part_of
from soma_core.inversion.result import IdentityFit
from soma_core.skeleton.identity import Identity

__all__ = ["fit_point_identity"]

_CANDIDATES, _FEW, _STARTS = 24, 6, 2
"""Bodies looked at on a few frames, and how many of them are followed a few steps beside the given one."""

_FEW_STEPS = 4
_RIDGE = 1e-6
"""Relative to the diagonal of the poses' matrix: keeps its factor defined."""

_STEP = 0.1
"""Length of the steps that derivatives are taken over, in units of the parameters."""

_DAMPING = Damping(tries=4)

_NOTICEABLE = 1e-3
"""A step that lowers what is minimised by less, relatively, is the last."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _State:
    """A body under way: its parameters, poses, what is minimised, and the noise of a coordinate [m]."""

    point: np.ndarray
    identity: Identity
    pose: Pose
    energy: float
    noise: float
    error: float


@torch.no_grad()
def fit_point_identity(
    inversion: PointInversion,
    points: Tensor,
    *,
    weights: Tensor | None = None,
    start: Mapping[str, Any] | None = None,
    free: Sequence[str] | None = None,
    frames: int = 60,
    iterations: int = 12,
) -> IdentityFit:
    """Recover the parameters of a body, and its poses, from points of one person.

    Gauss-Newton steps on what all poses leave, weighed by the noise of the points against a sixth of each
    parameter's range (one standard deviation), from several starts where parameters are bounded.

    Args:
        inversion: of the points, on the backend whose parameters are sought.
        points, weights: as it takes them.
        start: parameters to begin from; what is left out has its default.
        free: names of the parameters to fit; default as in :class:`FreeParameters`.
        frames: how many, spread over the motion, to estimate the body from.
        iterations: largest number of steps.

    Raises:
        InputError: an unknown parameter, no usable frame, or what the inversion refuses.
    """
    for name, value in (("frames", frames), ("iterations", iterations)):
        if value < 1:
            raise InputError(name, got=value, expected="at least 1", fix=f"Leave {name} out for the default.")
    parameters = FreeParameters(inversion.layer, start, free)
    known = torch.isfinite(points).all(-1)
    usable = torch.nonzero(known.sum(1) > 2).flatten()
    if not len(usable):
        raise InputError(
            "points", got="three known points in no frame", expected="points of a person",
            fix="Look at their order, and at their confidence.",
        )  # fmt: skip
    chosen = usable[torch.linspace(0, len(usable) - 1, min(frames, len(usable))).round().long()]
    every = None if weights is None else torch.as_tensor(weights)
    some = every[chosen] if every is not None and every.ndim == 2 and len(every) == len(points) else every
    search = _Search(inversion, points[chosen], some, parameters)
    few, spread = search.few(), parameters.spread(_CANDIDATES)
    starts = promising(parameters, spread, few.errors, _STARTS, at_once=_CANDIDATES)
    begun = [few.descend(point, _FEW_STEPS)[0] for point in starts]
    best = min(begun, key=lambda state: state.error)
    found, converged = search.descend(best.point, iterations)
    return IdentityFit(
        identity=found.identity,
        params=found.identity.params,
        pose=inversion(points, found.identity, weights=weights),
        frames=chosen,
        history=tuple(search.history),
        converged=converged,
    )


class _Search:
    """Levenberg-Marquardt over the parameters on some frames; `history` grows with every accepted step."""

    def __init__(
        self, inversion: PointInversion, points: Tensor, weights: Tensor | None, parameters: FreeParameters
    ) -> None:
        self.inversion, self.points, self.parameters = inversion, points, parameters
        self.given = weights
        known = torch.isfinite(points).all(-1)
        self.weights = known.to(points) if weights is None else known * weights.to(points)
        self.clean = torch.where(known[..., None], points, 0.0)
        self.history: list[float] = []

    def few(self) -> _Search:
        """The same on a few frames."""
        some = torch.linspace(0, len(self.points) - 1, min(_FEW, len(self.points))).round().long()
        apart = self.given is not None and self.given.ndim == 2 and len(self.given) == len(self.points)
        given = self.given[some] if apart else self.given
        return _Search(self.inversion, self.points[some], given, self.parameters)

    def errors(self, points: np.ndarray) -> np.ndarray:
        """Mean squared errors (m,) of several bodies, each in its best pose."""
        count, given = len(self.points), self.given
        bodies = self.parameters.identities(np.repeat(points, count, 0))
        given = given if given is None or given.ndim == 1 else given.repeat(len(points), 1)
        residual = self.inversion(self.points.repeat(len(points), 1, 1), bodies, weights=given).residual
        squares = residual.square().nan_to_num(nan=torch.inf).view(len(points), count)
        return squares.mean(1).cpu().numpy()

    def descend(self, point: np.ndarray, iterations: int) -> tuple[_State, bool]:
        """Lower what is left from `point`; the second value is whether it came to rest."""
        begin = self._noted(self._state(point, None))
        return descend(
            begin, self._attempts, lambda trial: self._noted(self._state(trial.point, None)),
            damping=_DAMPING, iterations=iterations,
        )  # fmt: skip

    def _attempts(self, state: _State) -> Callable[[float], tuple[_State, bool, bool]]:
        matrix, slope = self._normal_equations(state)
        before = self._energy(state, state.noise)

        def attempt(damping: float) -> tuple[_State, bool, bool]:
            step = bounded_step(self.parameters, state.point, matrix, slope, damping)
            trial = self._state(step, state.noise)
            gain = before - trial.energy
            return trial, gain > 0, gain < _NOTICEABLE * before

        return attempt

    def _noted(self, state: _State) -> _State:
        self.history.append(state.error)
        return state

    def _state(self, point: np.ndarray, noise: float | None) -> _State:
        identity = self.parameters.identities(point[None])
        result = self.inversion(self.points, identity, weights=self.given, noise=noise)
        state = _State(
            point=point, identity=identity, energy=0.0, noise=result.noise,
            pose=self.inversion.model.pose(result.rotations, result.translation),
            error=float(result.residual.square().nanmean().sqrt()),
        )  # fmt: skip
        return replace(state, energy=self._energy(state, result.noise))

    def _energy(self, state: _State, noise: float) -> float:
        """What is minimised, under a noise [m]."""
        return float(self._rows(state, noise).energy(state.pose).double().sum()) + float(
            np.square(state.point).sum()
        )

    def _rows(self, state: _State, noise: float) -> PointRows:
        model = self.inversion.model
        rows = rows_of(self.clean - self._shift(state), self.weights, noise)
        return PointRows(model, model.rest(state.identity), rows, smooth=None)

    def _shift(self, state: _State) -> Tensor | float:
        """What twist joints and correctives do to the points beside plain skinning, (F, P, 3) [m]."""
        model = self.inversion.model
        if not model.corrected:
            return 0.0
        posed = model.layer.pose(state.identity, model.rotations(state.pose), state.pose.translation)
        points = model.places(posed.transforms, posed.vertices[:, model.places.vertex_ids])
        return points - _seen(model, state.identity, state.pose)

    def _normal_equations(self, state: _State) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (k, k) and half the slope (k,) of the parameters, the poses of all frames eliminated."""
        steps = self.parameters.inward(state.point, _STEP)
        bodies = self.parameters.identities(state.point + np.diag(steps))
        model, solve = self.inversion.model, self._rows(state, state.noise)
        rest = model.rest(state.identity)
        place = model.walk(state.pose, rest)
        base = model.points(rest, *place)
        fields = torch.stack([
            (_seen(model, part_of(bodies, slice(k, k + 1)), state.pose) - base) / steps[k]
            for k in range(len(steps))
        ], -1)  # fmt: skip
        residual, slopes = solve.rows(base, slice(None))
        by_shape = (slopes @ fields).flatten(1, 2).double()  # (F, r, k)
        by_pose = (slopes @ solve.jacobian(rest, *place)).flatten(1, 2).double()
        left, (matrix, slope) = residual.flatten(1).double(), solve.system(state.pose)
        matrix, slope = matrix.double(), slope.double()
        diagonal = matrix.diagonal(dim1=-2, dim2=-1)
        ridge = _RIDGE * (diagonal + diagonal.mean(1, keepdim=True))
        factor = torch.linalg.cholesky(matrix + torch.diag_embed(ridge))
        crossed = by_pose.mT @ by_shape  # (F, d, k)
        followed = torch.cholesky_solve(crossed, factor)
        whole = (by_shape.mT @ by_shape - crossed.mT @ followed).sum(0)
        right = ((by_shape * left[..., None]).sum(1) - (followed * slope[..., None]).sum(1)).sum(0)
        return whole.cpu().numpy() + np.eye(len(steps)), right.cpu().numpy() + state.point


def _seen(model: PointModel, identity: Identity, pose: Pose) -> Tensor:
    """Points (F, P, 3) [m] of a body in poses of another, by plain skinning."""
    rest = model.rest(identity)
    return model.points(rest, *model.walk(pose, rest))
