"""Parameters of a backend from posed meshes, the poses eliminated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from soma_core.inversion.fit import PoseInversion
from soma_core.inversion.free_parameters import FreeParameters, WithJoints
from soma_core.inversion.levenberg import Bounded, Damping, bounded_step, descend, promising
from soma_core.inversion.result import InversionResult
from soma_core.inversion.shape_response import shape_normal_equations
from soma_core.skeleton.identity import Identity

__all__ = ["Rival", "Sample", "ShapeFound", "evenly", "search_parameters"]

_PLAIN, _ROBUST = 1.0, 5e-4
"""Scale of the loss [m]: vertices whose error lies above it count less. The first leaves all alike."""

_CANDIDATES, _STARTS = 48, 4
_FEW_FRAMES, _FEW_STEPS = 4, 6
"""Bodies looked at, and those of them followed a few steps on a few frames; the best one goes on."""

_CLEARLY = 0.5
"""Share of the error that a rival must stay below."""

_AT_A_TIME = 8
"""Candidates fitted at a time, to bound memory."""

_STEP = 0.1
"""Length of the steps that derivatives are taken over, in units of the parameters."""

_PRIOR = 1e-5
"""Weight of a parameter's square, relative to the mean squared error: decides what the frames do not."""

_DAMPING = Damping(tries=5)

_NOTICEABLE = 3e-4
"""A step that lowers the error by less, relatively, is the last."""


class Unknowns(Bounded, Protocol):
    """What a search moves in: :class:`FreeParameters`, or those :class:`WithJoints`."""

    def identities(self, points: np.ndarray) -> Identity:
        """Identities of (m, k) points."""
        ...

    def inward(self, point: np.ndarray, length: float) -> np.ndarray:
        """Steps (k,) of `length` away from the nearer bound."""
        ...


def evenly(total: int, count: int) -> Tensor:
    """Up to `count` of `total` numbers, evenly spread."""
    return torch.linspace(0, total - 1, min(count, total)).round().long()


Rival = Callable[[int, np.ndarray, int], tuple[np.ndarray, float]]
"""Another model with these parameters: frames to look at, where to begin, and the largest number of steps; to
where the search ends and the error [m] that is left there, as a root mean square."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """The frames that an identity is estimated from.

    Attributes:
        vertices: (F, v, 3) [m], canonical.
        weights: (1 or F, v).
    """

    vertices: Tensor
    weights: Tensor

    def without_gaps(self) -> Sample:
        """The same with zeros where a vertex has no weight."""
        return replace(self, vertices=torch.where(self.weights[..., None] > 0, self.vertices, 0.0))

    def some(self, count: int) -> Sample:
        """Up to `count` frames, evenly spread."""
        index = evenly(len(self.vertices), count)
        weights = self.weights[index] if len(self.weights) > 1 else self.weights
        return Sample(vertices=self.vertices[index], weights=weights)

    def squares(self, pose: InversionResult) -> Tensor:
        """Mean squared error (v,) [m^2] of each vertex over the frames; infinite where a frame fails."""
        weights = self.weights.expand(len(self.vertices), -1).double()
        error = torch.where(weights > 0, pose.vertex_error.double(), 0.0).nan_to_num(nan=torch.inf)
        return (weights * error.square()).sum(0) / weights.sum(0).clamp_min(1e-12)

    def error(self, pose: InversionResult) -> float:
        """Root mean square error [m]."""
        return float(self.mean(self.squares(pose)).sqrt())

    def mean(self, values: Tensor) -> Tensor:
        """Mean over vertices of (v,) values, by weight."""
        total = self.weights.double().mean(0)
        return (values * total).sum() / total.sum()


@dataclass(frozen=True, kw_only=True, eq=False)
class ShapeFound:
    """What a search found.

    Attributes:
        identity: batch of 1.
        history: root mean square error [m] at the start, and after each accepted step, joints in their best
            places.
        converged: whether it ended before its steps did.
    """

    identity: Identity
    history: tuple[float, ...]
    converged: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _State:
    """A body under way: its parameters, pose, and squared errors (v,) [m^2]."""

    point: np.ndarray
    identity: Identity
    pose: InversionResult
    squares: Tensor


def search_parameters(
    inversion: PoseInversion,
    sample: Sample,
    parameters: FreeParameters,
    *,
    iterations: int,
    rival: Rival | None = None,
) -> ShapeFound:
    """Minimise the error over the parameters, every frame in its best pose.

    Two models that share a rest shape turn it about other joint centres and bend their skin differently;
    neither is a fault of the shape. Joint centres are therefore unknowns too, to be dropped in the end, and a
    second descent lets vertices count by how well they are explained. A single frame does not tell joints and
    bending from shape: there the parameters are all that is sought. None of this is needed where a `rival`
    explains a few frames better: it goes on alone.
    """
    few = _Search(inversion, sample.some(_FEW_FRAMES), parameters)
    spread = parameters.spread(_CANDIDATES)
    starts = promising(parameters, spread, few.errors, _STARTS - 1, at_once=_AT_A_TIME)
    found = [few.descend(point, _PLAIN, min(iterations, _FEW_STEPS))[0] for point in starts]
    best = min(found, key=lambda state: float(few.sample.mean(state.squares)))
    if rival is not None:
        error = float(few.sample.mean(best.squares).sqrt())
        point, left = min((rival(_FEW_FRAMES, state.point, iterations) for state in found), key=itemgetter(1))
        if left < _CLEARLY * error:
            point, after = rival(len(sample.vertices), point, iterations)
            return ShapeFound(
                identity=parameters.identities(point[None]), history=(error, left, after), converged=True
            )
    count, moving = len(best.point), len(sample.vertices) > 1
    unknowns = WithJoints(parameters, inversion.layer) if moving else parameters
    whole = _Search(inversion, sample, unknowns)
    point = np.concatenate((best.point, unknowns.start[count:]))
    for scale in (_PLAIN, _ROBUST) if moving else (_PLAIN,):
        state, converged = whole.descend(point, scale, iterations)
        point = state.point
    identity = parameters.identities(point[None, :count])
    return ShapeFound(identity=identity, history=tuple(whole.history), converged=converged)


class _Search:
    """Levenberg-Marquardt over the unknowns on some frames; `history` grows with every accepted step."""

    def __init__(self, inversion: PoseInversion, sample: Sample, unknowns: Unknowns) -> None:
        self.inversion, self.sample, self.unknowns = inversion, sample, unknowns
        self.history: list[float] = []

    def errors(self, points: np.ndarray) -> np.ndarray:
        """Mean squared errors (m,) of several bodies, each in its best pose."""
        count = len(self.sample.vertices)
        bodies = self.unknowns.identities(np.repeat(points, count, 0))
        vertices = self.sample.vertices.repeat(len(points), 1, 1)
        weights = self.sample.weights
        weights = weights.repeat(len(points), 1) if len(weights) > 1 else weights
        residual = self.inversion(vertices, bodies, weights=weights).residual.double()
        squares = residual.square().nan_to_num(nan=torch.inf).view(len(points), count)
        return squares.mean(1).cpu().numpy()

    def descend(self, point: np.ndarray, scale: float, iterations: int) -> tuple[_State, bool]:
        """Lower the error from `point`; the second value is whether it came to rest."""
        begin = self._noted(self._state(point, torch.ones_like(self.sample.weights[0])))
        return descend(
            begin, lambda state: self._attempts(state, scale), self._noted, damping=_DAMPING,
            iterations=iterations,
        )  # fmt: skip

    def _attempts(self, state: _State, scale: float) -> Callable[[float], tuple[_State, bool, bool]]:
        trust = (scale**2 / (scale**2 + state.squares)).to(self.sample.weights)
        prior = _PRIOR * float(self._loss(state, scale))
        matrix, slope = self._normal_equations(state, trust, prior)
        before = self._objective(state, scale, prior)

        def attempt(damping: float) -> tuple[_State, bool, bool]:
            trial = self._state(bounded_step(self.unknowns, state.point, matrix, slope, damping), trust)
            gain = before - self._objective(trial, scale, prior)
            return trial, gain > 0, gain < _NOTICEABLE * before

        return attempt

    def _noted(self, state: _State) -> _State:
        self.history.append(float(self.sample.mean(state.squares).sqrt()))
        return state

    def _state(self, point: np.ndarray, trust: Tensor) -> _State:
        identity = self.unknowns.identities(point[None])
        pose = self.inversion(self.sample.vertices, identity, weights=self.sample.weights * trust)
        return _State(point=point, identity=identity, pose=pose, squares=self.sample.squares(pose))

    def _loss(self, state: _State, scale: float) -> Tensor:
        """Mean of ``s^2 log(1 + e^2 / s^2)`` over vertices [m^2]: e^2 for errors below the scale."""
        return self.sample.mean(scale**2 * torch.log1p(state.squares / scale**2))

    def _objective(self, state: _State, scale: float, prior: float) -> float:
        return float(self._loss(state, scale)) + prior * float((state.point**2).sum())

    def _normal_equations(self, state: _State, trust: Tensor, prior: float) -> tuple[np.ndarray, np.ndarray]:
        steps = self.unknowns.inward(state.point, _STEP)
        points = state.point + np.concatenate((np.zeros((1, len(steps))), np.diag(steps)))
        left, right = shape_normal_equations(
            self.inversion,
            self.sample.vertices,
            self.sample.weights * trust,
            state.pose,
            self.unknowns.identities(points),
            torch.as_tensor(steps, device=trust.device),
        )
        total = float(self.sample.weights.expand(len(self.sample.vertices), -1).double().sum())
        matrix, slope = left.cpu().numpy() / total, right.cpu().numpy() / total
        return matrix + prior * np.eye(len(slope)), slope + prior * state.point
