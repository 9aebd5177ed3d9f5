"""The loop of all searches over a few unknowns: a damped step, a look at where it leads, another damping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import scipy.linalg

__all__ = ["Damping", "bounded_step", "descend", "promising"]

State = TypeVar("State")


@dataclass(frozen=True, kw_only=True)
class Damping:
    """Levenberg-Marquardt damping, relative to the diagonal of the matrix.

    Attributes:
        tries: bad steps in a row before a search ends.
        lower, higher: factors after a good and a bad step.
        start: of the first step.
    """

    tries: int
    lower: float = 0.2
    higher: float = 8.0
    start: float = 1e-3


class Bounded(Protocol):
    """Unknowns (k,) and their bounds."""

    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def descend(
    state: State,
    attempts: Callable[[State], Callable[[float], tuple[State, bool, bool]]],
    accepted: Callable[[State], State] = lambda state: state,
    *,
    damping: Damping,
    iterations: int,
) -> tuple[State, bool]:
    """Lower what is minimised, from a state; the second value is whether it came to rest.

    Args:
        state: where to begin.
        attempts: prepares the steps from a state: what a damping leads to, whether that is better, and
            whether so little that it is the last.
        accepted: what a good step is followed by.
        damping: of the steps.
        iterations: largest number of good steps.
    """
    now = damping.start
    for _ in range(iterations):
        attempt = attempts(state)
        for _ in range(damping.tries):
            trial, better, last = attempt(now)
            if better:
                break
            now *= damping.higher
        else:
            return state, True
        now *= damping.lower
        state = accepted(trial)
        if last:
            return state, True
    return state, False


def bounded_step(
    unknowns: Bounded, point: np.ndarray, matrix: np.ndarray, slope: np.ndarray, damping: float
) -> np.ndarray:
    """The minimum of the damped quadratic inside the bounds."""
    from scipy.optimize import lsq_linear  # ninety modules, which a motion without a fit does not need

    damped = matrix + damping * np.diag(np.diag(matrix))
    factor = np.linalg.cholesky(damped)
    goal = scipy.linalg.solve_triangular(factor, -slope, lower=True)
    bounds = unknowns.lower - point, unknowns.upper - point
    return point + lsq_linear(factor.T, goal, bounds, method="bvls").x


def promising(
    unknowns: Bounded,
    spread: np.ndarray,
    errors: Callable[[np.ndarray], np.ndarray],
    count: int,
    *,
    at_once: int,
) -> list[np.ndarray]:
    """The start, and the `count` points of least error among those spread over the bounds.

    Args:
        unknowns: whose start it is.
        spread: (m, k) points; none where nothing is bounded.
        errors: of several points.
        count: how many of them.
        at_once: points looked at together, to bound memory.
    """
    found = [errors(spread[first : first + at_once]) for first in range(0, len(spread), at_once)]
    order = np.argsort(np.concatenate((np.zeros(0), *found)))
    return [unknowns.start, *spread[order[:count]]]
