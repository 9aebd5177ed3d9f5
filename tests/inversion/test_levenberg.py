"""The loop of searches over a few unknowns, and the linear solver of gradients through a fit."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from soma_core.inversion.implicit import conjugate_gradients
from soma_core.inversion.levenberg import Damping, bounded_step, descend, promising
from tests.bodies import randn

NEAR = 1e-6
"""Where steps lower a residual of order one by less than a hundred billionth."""
SOLVED = 1e-9
"""Relative, in float64."""


def valley(point):
    """Residuals of Rosenbrock's function, and their derivative."""
    x, y = point
    return np.array([10 * (y - x * x), 1 - x]), np.array([[-20 * x, 10.0], [-1.0, 0.0]])


def searched(start, *, iterations=100, upper=np.inf, seen=None):
    unknowns = SimpleNamespace(lower=np.full(2, -np.inf), upper=np.array([upper, np.inf]))

    def attempts(point):
        residual, slope = valley(point)
        before = residual @ residual

        def attempt(damping):
            trial = bounded_step(unknowns, point, slope.T @ slope, slope.T @ residual, damping)
            after = valley(trial)[0]
            return trial, after @ after < before, before - after @ after < 1e-20

        return attempt

    def noted(point):
        if seen is not None:
            seen.append(point)
        return point

    return descend(start, attempts, noted, damping=Damping(tries=12), iterations=iterations)


def test_a_curved_valley_is_followed_to_its_end_and_never_upwards():
    seen = []
    point, rests = searched(np.array([-1.2, 1.0]), seen=seen)
    assert rests
    np.testing.assert_allclose(point, 1, atol=NEAR)
    costs = [float(np.square(valley(one)[0]).sum()) for one in seen]
    assert costs == sorted(costs, reverse=True)


def test_bounds_hold_and_a_search_that_is_cut_off_says_so():
    point, rests = searched(np.array([-1.2, 1.0]), upper=0.5)
    assert rests
    np.testing.assert_allclose(point, [0.5, 0.25], atol=NEAR)
    assert searched(np.array([-1.2, 1.0]), iterations=2)[1] is False


@pytest.mark.parametrize("at_once", [1, 3, 10])
def test_starts_are_the_given_one_and_the_best_of_those_spread(at_once):
    unknowns = SimpleNamespace(start=np.zeros(1))
    spread = np.array([[4.0], [-1.0], [3.0], [2.0]])
    found = promising(unknowns, spread, lambda points: points[:, 0] ** 2, 2, at_once=at_once)
    assert [float(point[0]) for point in found] == [0, -1, 2]
    assert len(promising(unknowns, spread[:0], lambda points: points[:, 0], 2, at_once=at_once)) == 1


def frames(count=3, size=6):
    root = randn(count, size, size, seed=1)
    return root @ root.mT + torch.eye(size).double(), randn(count, size, seed=2)


def solved(matrix, right, **options):
    diagonal = matrix.diagonal(dim1=1, dim2=2)
    return conjugate_gradients(
        lambda way: (matrix @ way[..., None]).squeeze(-1), lambda left: left / diagonal.abs(), right,
        rounds=60, accurate=1e-12, **options,
    )  # fmt: skip


def test_systems_are_solved_apart_or_as_one():
    matrix, right = frames()
    expected = torch.linalg.solve(matrix, right)
    for options in ({}, {"inner": lambda one, other: (one * other).sum().expand(len(one))}):
        found, good = solved(matrix, right, **options)
        assert good.all()
        torch.testing.assert_close(found, expected, rtol=SOLVED, atol=SOLVED)


def test_a_frame_that_is_at_no_minimum_gets_nothing_and_leaves_the_others():
    matrix, right = frames()
    matrix[1, 0] = 0
    matrix[1, :, 0] = 0
    matrix[1, 0, 0] = -1
    found, good = solved(matrix, right)
    assert good.tolist() == [True, False, True]
    assert not found[1].any()
    torch.testing.assert_close(found[0], torch.linalg.solve(matrix[0], right[0]), rtol=SOLVED, atol=SOLVED)
