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
def test_outliers_do_not_matter_to_a_robust_fit(layer, identity, clean, kernels, who):
    if who > 1:
        identity = layer.identity({"shape": [[1.0, -1.0]] * FRAMES})
    outlier = torch.rand(clean.shape[:2], generator=torch.Generator().manual_seed(0)) < 0.05
    spoilt = clean + 0.3 * outlier[..., None]
    plain = PoseInversion(layer, kernels="warp")(spoilt, identity)
    options = {"kernels": kernels, "iterations": 5, "robust_rounds": 6}
    robust = PoseInversion(layer, robust=0.005, **options)(spoilt, identity)
    assert mean_error(layer, identity, plain, clean) > 0.01
    assert mean_error(layer, identity, robust, clean) < 1e-6
    # The report is about the target as it came.
    assert robust.vertex_error[outlier].min() > 0.4


@pytest.mark.parametrize(("share", "moved"), [(0.05, 0.3), (0.3, 1.0), (0.1, 0.05)])
@pytest.mark.parametrize("plain", [False, True])
def test_the_pose_comes_back_whatever_some_vertices_say(share, moved, plain):
    layer = SomaLayer("soma", lod="low", **({"procedural": False, "correctives": None} if plain else {}))
    identity, turns = layer.identity(), 0.3 * randn(FRAMES, 77, 3, seed=5).float()
    posed = layer.pose(identity, turns).vertices
    wrong = torch.rand(posed.shape[:2], generator=torch.Generator().manual_seed(3)) < share
    away = torch.nn.functional.normalize(randn(*posed.shape, seed=4).float(), dim=-1)
    result = PoseInversion(layer, robust=0.01)(posed + moved * wrong[..., None] * away, identity)
    assert result.converged.all()
    variable = result.determined.all(0)
    turn = result.rotations.mT @ axis_angle_to_matrix(turns)
    angle = matrix_to_axis_angle(turn).norm(dim=-1)[:, variable].rad2deg()
    assert angle.max() < 0.2  # that of a fit without outliers


def test_joints_of_which_most_vertices_are_wrong_are_not_determined(layer, identity, clean):
    names = list(layer.rig.joint_names)
    weights = torch.as_tensor(layer.rig.weights.toarray())
    hand = weights[:, [k for k, name in enumerate(names) if name.startswith("LeftHand")]].sum(1) > 0.5
    lost = (
        clean
        + 0.4 * torch.nn.functional.normalize(randn(*clean.shape, seed=8).float(), dim=-1) * hand[:, None]
    )
    result = PoseInversion(layer, robust=0.01)(lost, identity)
    finger, foot = (layer.joint_names.index(name) for name in ("LeftHandMiddle2", "LeftFoot"))
    assert not result.determined[:, finger].any()
    assert result.determined[:, foot].all()
    assert (result.angle_std[:, finger].isnan() & result.angle_std[:, foot].isfinite()).all()


def test_without_outliers_a_robust_fit_changes_nothing(layer, identity, clean):
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


def test_what_turns_against_a_lost_joint_is_not_determined(layer, identity, clean):
    """The upper arm is lost with all its skin: the forearm's turn against it cannot be told."""
    names, weights = list(layer.rig.joint_names), torch.as_tensor(layer.rig.weights.toarray())
    arm = weights[:, names.index("LeftArm")] > 0.1
    away = torch.nn.functional.normalize(randn(*clean.shape, seed=9).float(), dim=-1)
    result = PoseInversion(layer, robust=0.01)(clean + 0.4 * away * arm[:, None], identity)
    upper, below, other = (
        layer.joint_names.index(f"{name}") for name in ("LeftArm", "LeftForeArm", "RightForeArm")
    )
    assert not result.determined[:, [upper, below]].any()
    assert result.determined[:, other].all()
