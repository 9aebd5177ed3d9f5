"""How sure a fit is of each joint's angle: what noise does, what the layer's motions say, what is open."""

import functools
from dataclasses import replace

import pytest
import torch

from soma_core.evaluation.joint_turns import angles_between
from soma_core.evaluation.pose_angle_fits import finger_joints, visible_joints
from soma_core.inversion import PoseInversion
from soma_core.inversion.model import PoseModel
from soma_core.layer import SomaLayer
from tests.bodies import randn
from tests.inversion.driven_layers import as_pose, jacobian, layer_of, poses, problem_of
from tests.inversion.small_problem import real

NOISE_M = 0.005
DRAWS = 64
POSES = 3
EVERY = (0.75, 1.3)
"""Of one joint and pose: three deviations of a root mean square over 64 draws that turn about one axis."""
MEDIAN = (0.95, 1.05)
TYPICAL = (0.8, 1.25)
"""Median under correctives, whose activations have kinks within the reach of the noise."""
OPEN = ("Arm", "ForeArm", "Leg", "Shin")
"""How a limb's twist is shared between its two ends is told by correctives alone: far from linear."""
EXACT_DEGREES = 0.01
"""Where the layer posed the target: float32 rounding of vertices, as noise."""
DIFFERENCES = 1e-5
"""Relative: central differences times the condition of fingers."""
THINNED = 0.3
"""Relative: and those are known for all vertices alike."""
MODES = 0.1
"""Relative: correctives are known to the matrix by their largest modes."""
RIDGE = 1e-9
"""Of the solver, relative to the mean diagonal: a hundredth of what is known of a fingertip at this LOD."""
HIPS = torch.tensor([[0.1, 0.9, -0.2]])


@functools.cache
def plain():
    return PoseInversion(SomaLayer("soma", lod="low", procedural=False, correctives=None), kernels="warp")


@functools.cache
def default():
    return PoseInversion(SomaLayer("soma", lod="low"), kernels="warp")


def posed(layer, count=1):
    """Identity, rotations and vertices of random poses."""
    identity = layer.identity({"shape": randn(1, 16, seed=1, dtype=torch.float32)})
    rotations, _ = real().poses(count, spread=0.2, dtype=torch.float32)
    return identity, rotations, layer.pose(identity, rotations, HIPS).vertices


@functools.cache
def spread(make, weighted=False):
    """Angle found over angle claimed (POSES, joints), root mean squares of the draws, and the joints' names.

    With weights, each vertex has noise of its own, and the weight that it deserves.
    """
    inversion = make()
    layer = inversion.layer
    identity, rotations, vertices = posed(layer, POSES)
    weights = inversion.default_weights
    size = torch.full_like(weights, NOISE_M)
    if weighted:
        own = 0.2 + 2 * torch.rand(len(weights), generator=torch.Generator().manual_seed(4))
        weights, size = weights * own, size / own.sqrt()
    seen, ratios = visible_joints(layer), []
    for index in range(POSES):
        noise = size[:, None] * randn(DRAWS, *vertices.shape[1:], seed=index, dtype=torch.float32)
        result = inversion(vertices[index] + noise, identity, weights=weights)
        truth = rotations[index].expand_as(result.rotations)
        found = torch.as_tensor(angles_between(result.rotations, truth))
        assert result.angle_std.shape == found.shape
        rms = [one[:, seen].square().mean(0).sqrt() for one in (found, result.angle_std)]
        ratios.append(rms[0] / rms[1])
    return torch.stack(ratios), [layer.joint_names[joint] for joint in seen]


@pytest.mark.parametrize("weighted", [False, True], ids=["alike", "weighted"])
def test_noise_turns_every_joint_by_what_is_claimed(weighted):
    ratios, _ = spread(plain, weighted)
    assert EVERY[0] < ratios.min() < ratios.max() < EVERY[1]
    assert MEDIAN[0] < ratios.median() < MEDIAN[1]


@pytest.mark.parametrize("fingers", [False, True], ids=["body", "fingers"])
def test_noise_turns_joints_of_the_whole_model_by_what_is_claimed(fingers):
    ratios, names = spread(default)
    mine = [bool(finger_joints(name)) == fingers and not name.endswith(OPEN) for name in names]
    assert sum(mine) > 10
    assert TYPICAL[0] < ratios[:, mine].median() < TYPICAL[1]


def test_how_limbs_share_a_twist_is_claimed_to_be_open():
    """No number fits there, but the claim is far above that of any other joint of the body."""
    inversion = default()
    identity, _, vertices = posed(inversion.layer)
    noisy = vertices + NOISE_M * randn(*vertices.shape, seed=5, dtype=torch.float32)
    claimed = inversion(noisy, identity).angle_std[0].tolist()
    angles = dict(zip(inversion.layer.joint_names, claimed, strict=True))
    others = max(angles[name] for name in ("Hips", "Chest", "LeftShoulder", "LeftHand", "LeftFoot"))
    assert min(angles[f"Left{name}"] for name in OPEN) > 2 * others


def motions(*, correct, weights=None):
    """Variances (n,) by differences of the layer's own poses, and what :meth:`angle_variance` takes."""
    layer = layer_of(correct=correct)
    model = PoseModel(layer, plain=False, warp=False)
    identity, rotations, hips = layer.identity({}), poses(layer, "random"), HIPS.double()
    columns = jacobian(layer, model, identity, rotations, hips)
    if weights is not None:
        columns = columns * weights[torch.as_tensor(model.fitted), None].sqrt()
    square = columns.flatten(1) @ columns.flatten(1).T
    square += RIDGE * square.diagonal().mean() * torch.eye(len(square))
    variance = torch.linalg.inv(square).diagonal()[:-3].view(-1, 3).sum(1)
    problem = problem_of(model, identity, layer.pose(identity, rotations, hips).vertices)
    return variance, problem, as_pose(rotations, hips - problem.origin)


@pytest.mark.parametrize(("correct", "bound"), [(False, DIFFERENCES), (True, MODES)])
@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_variances_are_those_of_the_layers_own_motions(correct, bound, warp):
    expected, *given = motions(correct=correct)
    found = PoseModel(layer_of(correct=correct), plain=False, warp=warp).angle_variance(*given)[0]
    torch.testing.assert_close(found.sqrt(), expected.sqrt(), rtol=bound, atol=0)


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_thinned_out_vertices_leave_variances_of_the_whole_model(warp):
    """Three in ten are left out, wherever they lie."""
    model = PoseModel(layer_of(correct=True), plain=False, warp=warp)
    kept = torch.rand(len(model.fitted), generator=torch.Generator().manual_seed(7)) > 0.3
    weights = kept * torch.as_tensor(model.fitted, dtype=torch.float64)
    expected, problem, pose = motions(correct=True, weights=weights)
    thin = model.problem(problem.vertices, problem.identity, weights[None], None, None, None)
    pose = replace(pose, translation=pose.translation + problem.origin - thin.origin)
    found = model.angle_variance(thin, pose)[0]
    torch.testing.assert_close(found.sqrt(), expected.sqrt(), rtol=THINNED, atol=0)


def test_the_noise_is_what_is_left_over_what_is_spare():
    inversion = plain()
    identity, _, vertices = posed(inversion.layer)
    noisy = vertices + NOISE_M * randn(*vertices.shape, seed=5, dtype=torch.float32)
    result = inversion(noisy, identity)
    model, counted = inversion.model, inversion.default_weights.sum()
    problem = problem_of(model, identity, noisy)
    variance = model.angle_variance(problem, as_pose(result.rotations, result.translation - problem.origin))
    variables = model.solver.variables
    noise = result.residual.square() * counted / (3 * counted - 3 * len(variables) - 3)
    assert noise.sqrt().item() == pytest.approx(NOISE_M, rel=0.03)
    expected = (variance * noise[:, None]).sqrt().rad2deg()
    torch.testing.assert_close(result.angle_std[:, variables - 1], expected, rtol=1e-4, atol=0)


def test_weights_count_beside_each_other_alone():
    """Four times all weights are the same weights; what is four times as large, and its root, round alike."""
    inversion = plain()
    identity, _, vertices = posed(inversion.layer)
    noisy = vertices + NOISE_M * randn(*vertices.shape, seed=5, dtype=torch.float32)
    once, again = (inversion(noisy, identity, weights=w * inversion.default_weights) for w in (1, 4))
    torch.testing.assert_close(again.angle_std, once.angle_std, rtol=1e-3, atol=0, equal_nan=True)


@pytest.mark.parametrize("make", [plain, default])
def test_exact_targets_leave_no_doubt(make):
    inversion = make()
    identity, _, vertices = posed(inversion.layer, 4)
    result = inversion(vertices, identity)
    assert result.determined.any()
    assert result.angle_std[result.determined].max() < EXACT_DEGREES


def test_nothing_is_claimed_of_what_nothing_is_known_of():
    """A frame that could not be used, joints without skin, and a hand whose vertices are left out."""
    inversion = default()
    layer = inversion.layer
    identity, _, vertices = posed(layer, 3)
    vertices[1] = torch.nan
    hand = layer.joint_names.index("LeftHand")
    below = torch.as_tensor(layer.rig.weights.toarray()[:, hand + 1 : hand + 25].sum(1)) > 0
    weights = inversion.default_weights.expand(3, -1).clone()
    weights[2, below] = 0
    result = inversion(vertices, identity, weights=weights)
    assert torch.equal(result.angle_std.isfinite(), result.determined)
    assert result.angle_std[1].isnan().all()
    thumb = layer.joint_names.index("LeftHandThumb2")
    assert result.angle_std[2, thumb].isnan()
    assert not result.angle_std[0, thumb].isnan()


def test_fewer_numbers_than_unknowns_say_nothing_of_the_noise():
    inversion = plain()
    identity, _, vertices = posed(inversion.layer)
    weights = torch.zeros_like(inversion.default_weights)
    weights[torch.nonzero(inversion.default_weights).flatten()[::80]] = 1
    result = inversion(vertices, identity, weights=weights)
    assert 3 * weights.sum() < 3 * len(inversion.model.solver.variables)
    assert result.angle_std.isnan().all()


def test_frames_are_told_apart_and_cut_with_the_result():
    inversion = default()
    identity, _, vertices = posed(inversion.layer, 4)
    size = torch.tensor([1.0, 2.0, 3.0, 4.0])[:, None, None] * 1e-3
    noisy = vertices[:1] + size * randn(1, *vertices.shape[1:], seed=5, dtype=torch.float32)
    result = inversion(noisy, identity)
    hips = result.angle_std[:, inversion.layer.joint_names.index("Hips")]
    torch.testing.assert_close(hips / hips[0], size.flatten() * 1e3, rtol=0.1, atol=0)
    cut = result.part(slice(1, 3)).angle_std
    torch.testing.assert_close(cut, result.angle_std[1:3], rtol=0, atol=0, equal_nan=True)
