"""Outliers and motion over time: the loops around the solver."""

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from soma_core.inversion import PoseInversion, PosePriors
from soma_core.layer import SomaLayer
from tests.bodies import randn

FRAMES = 3


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", procedural=False)


@pytest.fixture(scope="module")
def identity(layer):
    return layer.identity({"shape": [1.0, -1.0]})


@pytest.fixture(scope="module")
def clean(layer, identity):
    turns = 0.25 * randn(FRAMES, 77, 3, seed=1).float()
    return layer.pose(identity, turns, 0.3 * randn(FRAMES, 3, seed=2).float()).vertices


def mean_error(layer, identity, result, truth):
    """Mean distance [m] of the reconstruction to what was there before it was spoilt."""
    again = layer.pose(identity, result.rotations, result.translation).vertices
    return float((again - truth).norm(dim=-1).mean())


@pytest.mark.parametrize(("kernels", "who"), [("torch", 1), ("warp", 1), ("warp", FRAMES)])
def test_outliers_hardly_matter_to_the_robust_loss(layer, identity, clean, kernels, who):
    if who > 1:
        identity = layer.identity({"shape": [[1.0, -1.0]] * FRAMES})
    outlier = torch.rand(clean.shape[:2], generator=torch.Generator().manual_seed(0)) < 0.05
    spoilt = clean + 0.3 * outlier[..., None]
    plain = PoseInversion(layer, kernels="warp")(spoilt, identity)
    options = {"kernels": kernels, "iterations": 5, "robust_rounds": 6}
    robust = PoseInversion(layer, robust=0.005, **options)(spoilt, identity)
    assert mean_error(layer, identity, plain, clean) > 0.01
    assert mean_error(layer, identity, robust, clean) < 0.001
    # The report is about the target as it came.
    assert robust.vertex_error[outlier].min() > 0.4


def test_without_outliers_the_robust_loss_changes_nothing(layer, identity, clean):
    result = PoseInversion(layer, robust=0.005)(clean, identity)
    assert mean_error(layer, identity, result, clean) < 1e-5


def test_a_temporal_prior_smooths_and_still_fits(layer, identity):
    still = axis_angle_to_matrix(0.25 * randn(1, 77, 3, seed=1).float())
    steady = layer.pose(identity, still.expand(20, -1, -1, -1)).vertices
    noisy = steady + 0.01 * randn(*steady.shape, seed=6).float()
    results = [
        PoseInversion(layer, priors=PosePriors(temporal_strength=strength))(noisy, identity)
        for strength in (0.0, 0.02)
    ]
    jumps = [
        float(matrix_to_axis_angle(one.rotations[1:] @ one.rotations[:-1].mT).norm(dim=-1).mean())
        for one in results
    ]
    assert jumps[1] < 0.7 * jumps[0]
    errors = [mean_error(layer, identity, one, steady) for one in results]
    assert errors[1] < errors[0]
