"""Normal equations of the shape, against errors of fits: what is left after every frame has moved again."""

import numpy as np
import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion
from soma_core.inversion.shape_response import shape_normal_equations
from soma_core.layer import SomaLayer
from tests.bodies import randn

FRAMES, COUNT, STEP, SHORT = 3, 3, 0.05, 0.01
CURVED = 0.05
"""Relative: the error is not quite quadratic over the step, and poses are held back a little."""
SLOPE = 0.02
"""Relative to the largest slope, which is exact at a best pose; differences see the curvature change."""


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", dtype=torch.float64, procedural=False)


@pytest.fixture(scope="module")
def inversion(layer):
    return PoseInversion(layer, iterations=40, tolerance=1e-9, kernels="torch")


@pytest.fixture(scope="module")
def targets(layer):
    turns = axis_angle_to_matrix(0.25 * randn(FRAMES, 77, 3, seed=1))
    hips = 0.3 * randn(FRAMES, 3, seed=2)
    return layer.animation.pose(layer.identity(), turns, hips, absolute=False).vertices


def bodies(layer, points):
    """Bodies along components of the shape space, stature left out: knees bend to make up for it."""
    stature = np.zeros((len(points), 1))
    return layer.identity({"shape": torch.as_tensor(np.concatenate((stature, points), 1))})


def near(layer):
    return bodies(layer, np.concatenate((np.zeros((1, COUNT)), STEP * np.eye(COUNT))))


def weighting(inversion, kind):
    plain = inversion.default_weights[None]
    if kind == "plain":
        return plain
    count = FRAMES if kind == "each" else 1
    return plain * (0.5 + torch.rand(count, plain.shape[1], generator=torch.Generator().manual_seed(4)))


def energy(inversion, targets, weights, pose, point):
    """Squared error of all frames, each in its best pose near a given one."""
    result = inversion(targets, bodies(inversion.layer, point[None]), weights=weights, initial=pose)
    return float((weights * result.vertex_error.square()).sum())


@pytest.mark.parametrize("kind", ["plain", "one", "each"])
def test_curvature_is_the_error_that_poses_cannot_undo(layer, inversion, targets, kind):
    weights = weighting(inversion, kind)
    pose = inversion(targets, layer.identity(), weights=weights)
    steps = torch.full((COUNT,), STEP)
    matrix, slope = shape_normal_equations(inversion, targets, weights, pose, near(layer), steps)
    assert slope.abs().max() < 1e-6 * matrix.diagonal().max()  # the target is met
    directions = [*np.eye(COUNT), np.array([1.0, -2.0, 0.5])]
    for direction in directions:
        found = energy(inversion, targets, weights, pose, STEP * direction)
        expected = STEP**2 * direction @ matrix.numpy() @ direction
        np.testing.assert_allclose(expected, found, rtol=CURVED)


def test_slope_is_that_of_differences(layer, inversion, targets):
    weights = weighting(inversion, "plain")
    noisy = targets + 0.003 * randn(*targets.shape, seed=5)
    pose = inversion(noisy, layer.identity(), weights=weights)
    steps = torch.full((COUNT,), STEP)
    _, slope = shape_normal_equations(inversion, noisy, weights, pose, near(layer), steps)
    differences = [
        (energy(inversion, noisy, weights, pose, axis) - energy(inversion, noisy, weights, pose, -axis))
        / (4 * SHORT)
        for axis in SHORT * np.eye(COUNT)
    ]
    np.testing.assert_allclose(slope.numpy(), differences, atol=SLOPE * max(map(abs, differences)))


def test_directions_that_poses_undo_cost_nothing_and_stay_positive(layer, inversion, targets):
    """A rest shape that is turned and moved is the same body to a posed mesh."""
    weights = weighting(inversion, "plain")
    pose = inversion(targets, layer.identity(), weights=weights)
    rest = layer.identity().rest[0]
    moved = torch.stack((rest, rest + torch.tensor([0.01, 0, 0]), rest * 1.001))
    matrix, _ = shape_normal_equations(
        inversion, targets, weights, pose, layer.identity_from_rest(moved), torch.ones(2)
    )
    assert 0 < matrix[0, 0] < 1e-6 * FRAMES * float(weights.sum()) * 0.01**2
    assert matrix[1, 1] > 10 * matrix[0, 0]
    assert torch.linalg.eigvalsh(matrix).min() > 0
