"""Pose inversion through the full model: what twist adds to skinning does not leak into the pose."""

import itertools

import pytest
import torch

from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.layer import SomaLayer
from tests.bodies import randn

FRAMES = 6
EXACT_MM = 0.1
"""Mean error of a target that the full model can meet; a fit of plain skinning is off by 1.6 mm."""
SAME_M = 1e-5
SAME_MM = 0.02
"""Both solvers stop within their tolerance of the same minimum, round for round."""


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low")


@pytest.fixture(scope="module")
def identity(layer):
    return layer.identity({"shape": [1.0, -1.0]})


@pytest.fixture(scope="module")
def target(layer, identity):
    turns = 0.35 * randn(FRAMES, 77, 3, seed=1).float()
    return layer.pose(identity, turns, 0.3 * randn(FRAMES, 3, seed=2).float()).vertices


def mean_mm(result, inversion):
    return 1e3 * float(result.vertex_error[:, inversion.default_weights > 0].mean())


def test_a_target_of_the_full_model_is_met(layer, identity, target):
    ignoring = PoseInversion(layer, refreshes=0)
    full = PoseInversion(layer, refreshes=8)
    result = full(target, identity)
    assert layer.procedural
    assert mean_mm(result, full) < EXACT_MM < 0.1 * mean_mm(ignoring(target, identity), ignoring)
    again = layer.pose(identity, result.rotations, result.translation).vertices
    error = (again - target).norm(dim=-1)
    torch.testing.assert_close(result.vertex_error, error, rtol=0, atol=1e-6)


def test_more_rounds_never_cost_accuracy(layer, identity, target):
    noisy = target + 0.005 * randn(*target.shape, seed=3).float()
    residuals = [PoseInversion(layer, refreshes=n)(noisy, identity).residual for n in (0, 1, 2, 4)]
    for worse, better in itertools.pairwise(residuals):
        assert (better <= worse + 1e-6).all()


def test_the_reference_and_its_twin_agree(layer, identity, target):
    one, other = (PoseInversion(layer, refreshes=4, kernels=kernels) for kernels in ("torch", "warp"))
    expected, got = one(target, identity), other(target, identity)
    assert abs(mean_mm(expected, one) - mean_mm(got, other)) < SAME_MM


def test_identities_of_their_own_fit_as_alone(layer, identity, target):
    inversion = PoseInversion(layer, refreshes=3)
    other = layer.identity({"shape": [-1.0, 2.0]})
    both = layer.identity({"shape": [[1.0, -1.0], [-1.0, 2.0]]})
    second = layer.pose(other, 0.3 * randn(1, 77, 3, seed=4).float()).vertices
    joint = inversion(torch.cat((target[:1], second)), both)
    for row, (vertices, who) in enumerate(((target[:1], identity), (second, other))):
        alone = inversion(vertices, who)
        assert (joint.vertex_error[row] - alone.vertex_error[0]).abs().max() < 1e-4


@pytest.mark.parametrize("kernels", ["torch", "warp"])
def test_a_frame_does_not_depend_on_those_beside_it(layer, identity, target, kernels):
    inversion = PoseInversion(layer, refreshes=4, kernels=kernels)
    whole = inversion(target, identity)
    parts = [inversion(part, identity) for part in (target[:1], target[1:])]
    together = torch.cat([part.vertex_error for part in parts])
    assert (together - whole.vertex_error).abs().max() < SAME_M


def test_outliers_hardly_matter_with_twist_either(layer, identity, target):
    outlier = torch.rand(target.shape[:2], generator=torch.Generator().manual_seed(0)) < 0.05
    result = PoseInversion(layer, robust=0.005)(target + 0.3 * outlier[..., None], identity)
    again = layer.pose(identity, result.rotations, result.translation).vertices
    assert (again - target).norm(dim=-1).mean() < 1e-3


def test_a_negative_number_of_rounds_is_refused(layer):
    with pytest.raises(InputError, match=r"refreshes: got -1, expected at least 0"):
        PoseInversion(layer, refreshes=-1)
