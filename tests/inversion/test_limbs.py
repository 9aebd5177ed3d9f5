"""Upper arms and thighs: where their fit begins, and the search of how a limb's twist is shared."""

import functools
import math
from dataclasses import replace

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from soma_core.inversion.limbs import _SHARES
from soma_core.inversion.model import PoseModel
from soma_core.inversion.priors import PosePriors, twist_doubt
from soma_core.layer import SomaLayer
from tests.bodies import randn
from tests.inversion.driven_layers import as_pose, layer_of, problem_of

READ = 0.8
"""Radians: a start is good enough where every further step leads to the true twist, not round the bone."""
STEP = 2 * math.pi / (_SHARES - 1)
"""Radians between two shares that are looked at."""
ROUNDING = 1e-9
LIMBS = {"arm": ("Arm", "ForeArm", "Hand"), "leg": ("Leg", "Shin", "Foot")}
HIPS = torch.tensor([[0.1, 0.9, -0.2]], dtype=torch.float64)


@functools.cache
def model_of(*, correct=False):
    return PoseModel(layer_of(correct=correct), plain=False, warp=False)


@functools.cache
def identity_of(*, correct=False):
    return layer_of(correct=correct).identity({"shape": randn(1, 16, seed=1)})


def bone_axis(model, joint):
    """World axis at the T-pose of the bone that begins at a joint, or leads to it where no bone begins."""
    driven, parents = model.driven, model.solver.parents
    known = driven.start.tolist()
    return driven.spin_axis[known.index(joint if joint in known else int(parents[joint]))]


def twisted(model, names, degrees, seed=None):
    """Rotations (1, J - 1, 3, 3) with joints turned about their bones, the rest straight or random."""
    vectors = torch.zeros(1, len(names), 3, dtype=torch.float64)
    if seed is not None:
        vectors = 0.3 * randn(*vectors.shape, seed=seed)
    for name, angle in degrees.items():
        joint = names.index(name)
        vectors[0, joint] = bone_axis(model, joint + 1) * math.radians(angle)
    return axis_angle_to_matrix(vectors)


def started(model, layer, identity, rotations):
    """True and starting world turns, and both poses' twist angles."""
    problem = problem_of(model, identity, layer.pose(identity, rotations, HIPS).vertices)
    start = model.start(problem.target, problem.rest)
    walked = [
        model.walk(as_pose(one, torch.zeros_like(HIPS)), problem.rest)[0] for one in (rotations, start[:, 1:])
    ]
    return walked, [model.driven.read(turns, problem.rest.driven)[0][0] for turns in walked]


@pytest.mark.parametrize("side", ["Left", "Right"])
@pytest.mark.parametrize("limb", LIMBS)
@pytest.mark.parametrize("degrees", [0, 60, 120, 138, -90, -148])
def test_twists_along_a_limb_are_read_on_their_branch(limb, side, degrees):
    """Up to 300 degrees along an upper arm, half at each end, counted from the bind pose, where arms hang."""
    layer, model = layer_of(), model_of()
    upper, lower, last = (side + name for name in LIMBS[limb])
    names = list(layer.joint_names)
    rotations = twisted(model, names, dict.fromkeys((upper, lower, last), degrees))
    (true, found), (angles, read) = started(model, layer, identity_of(), rotations)
    for name in (upper, lower):
        joint = names.index(name) + 1
        off = matrix_to_axis_angle(found[0, joint].mT @ true[0, joint]).norm()
        assert off < READ, (name, float(off))
    channels = model.driven.joint.tolist()
    one, other = (channels.index(names.index(name) + 1) for name in (upper, lower))
    total = angles[one] + angles[other]
    assert abs(float(total)) < math.radians(300)
    torch.testing.assert_close(read[one] + read[other], total, atol=READ, rtol=0)


@pytest.mark.parametrize("degrees", [-170, -60, 0, 90, 170])
def test_a_forearms_and_a_shins_twist_is_read_as_it_is(degrees):
    layer, model = layer_of(), model_of()
    names = list(layer.joint_names)
    ends = {"LeftHand": "LeftForeArm", "RightHand": "RightForeArm", "LeftFoot": "LeftShin"}
    rotations = twisted(model, names, dict.fromkeys(ends, degrees), seed=3)
    (true, found), _ = started(model, layer, identity_of(), rotations)
    for bone in ends.values():
        joint = names.index(bone) + 1
        assert matrix_to_axis_angle(found[0, joint].mT @ true[0, joint]).norm() < READ


def test_the_start_turns_with_the_body():
    layer, model = layer_of(), model_of()
    identity, rotations = identity_of(), twisted(model, list(layer.joint_names), {"LeftForeArm": 100}, seed=4)
    turn = axis_angle_to_matrix(randn(1, 3, seed=5))[0]
    vertices = layer.pose(identity, rotations, HIPS).vertices
    starts = []
    for one in (vertices, vertices @ turn.T):
        problem = problem_of(model, identity, one)
        starts.append(model.start(problem.target, problem.rest))
    torch.testing.assert_close(starts[1][:, 2:], starts[0][:, 2:], atol=1e-4, rtol=0)
    torch.testing.assert_close(starts[1][:, 1], turn @ starts[0][:, 1], atol=1e-4, rtol=0)


def limb_of(model, joint):
    (found,) = [limb for limb in model.share.limbs if limb.own == joint]
    return found


def searched(model, problem, pose, held=(), **options):
    view, scale = model.view(problem, pose), model.scale(problem).expand(len(pose.relative))
    return model.share(pose, view, problem, scale, model.solver.variables, held, **options)


@pytest.mark.parametrize("joint", ["LeftArm", "RightArm", "LeftLeg", "RightLeg"])
@pytest.mark.parametrize("off", [-1.2, 0.5, 1.2])
def test_the_share_of_a_straight_limb_is_found(joint, off):
    """From a pose with the same skin but for correctives: the bone turned, the next one turned back."""
    layer, model = layer_of(correct=True), model_of(correct=True)
    names, identity = list(layer.joint_names), identity_of(correct=True)
    rotations = twisted(model, names, {joint: 40})
    problem = problem_of(model, identity, layer.pose(identity, rotations, HIPS).vertices)
    true = as_pose(rotations, HIPS - problem.origin)
    limb, wrong = limb_of(model, names.index(joint) + 1), true.relative.clone()
    model.share.turn(wrong, limb, torch.tensor([off], dtype=torch.float64))
    found = searched(model, problem, as_pose(wrong[:, 1:], true.translation))
    left = matrix_to_axis_angle(true.relative[:, limb.own].mT @ found.relative[:, limb.own])
    assert left.norm() < STEP


def test_a_pose_that_is_right_stays():
    layer, model = layer_of(correct=True), model_of(correct=True)
    identity = identity_of(correct=True)
    rotations = axis_angle_to_matrix(0.3 * randn(1, 77, 3, seed=2))
    problem = problem_of(model, identity, layer.pose(identity, rotations, HIPS).vertices)
    true = as_pose(rotations, HIPS - problem.origin)
    found = searched(model, problem, true)
    turned = matrix_to_axis_angle(true.relative.mT @ found.relative).norm(dim=-1)
    assert turned.max() < STEP / 4  # the least of a parabola through three shares


def test_a_share_moves_only_its_bone_and_the_next():
    layer, model = layer_of(correct=True), model_of(correct=True)
    rotations = axis_angle_to_matrix(0.3 * randn(2, 77, 3, seed=2))
    before = as_pose(rotations, HIPS.expand(2, 3))
    relative = before.relative.clone()
    limb = limb_of(model, list(layer.joint_names).index("LeftArm") + 1)
    model.share.turn(relative, limb, torch.tensor([0.4, -0.9], dtype=torch.float64))
    offsets = model.bone_offsets(identity_of(correct=True), None)
    (turns, places), (old, stood) = (
        model.solver.walk_public(as_pose(one[:, 1:], before.translation), offsets)
        for one in (relative, before.relative)
    )
    others = [j for j in range(turns.shape[1]) if j != limb.own]
    torch.testing.assert_close(turns[:, others], old[:, others], atol=ROUNDING, rtol=0)
    torch.testing.assert_close(places, stood, atol=2e-3, rtol=0)  # the next joint lies nearly on the axis
    angle = matrix_to_axis_angle(old[:, limb.own].mT @ turns[:, limb.own]).norm(dim=-1)
    torch.testing.assert_close(angle, torch.tensor([0.4, 0.9], dtype=torch.float64), atol=1e-6, rtol=0)


@functools.cache
def _by_kernels(dtype):
    layer = layer_of(correct=True) if dtype == torch.float64 else SomaLayer("soma", lod="low")
    return layer, PoseModel(layer, plain=False, warp=True)


@pytest.mark.parametrize("bodies", [1, 19])
@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize(
    ("dtype", "rounding"),
    [(torch.float32, 2e-5), pytest.param(torch.float64, 1e-9, marks=pytest.mark.slow)],  # 8 s to compile
)
def test_a_kernel_finds_the_same_shares(dtype, rounding, near, bodies):
    """Of more frames than lanes, with doubt of twists, from poses that miss by noise and turned limbs."""
    layer, model = _by_kernels(dtype)
    names = list(layer.joint_names)
    identity = layer.identity({"shape": randn(bodies, 16, seed=1).to(dtype)})
    rotations = axis_angle_to_matrix(0.3 * randn(19, 77, 3, seed=2)).to(dtype)
    target = layer.pose(identity, rotations, HIPS.to(dtype)).vertices
    problem = problem_of(model, identity, target + 2e-3 * randn(*target.shape, seed=3).to(dtype))
    variables = [names[j - 1] for j in model.solver.variables.tolist()]
    doubt = twist_doubt(PosePriors(), variables, dtype=dtype, device="cpu")
    problem = replace(problem, doubt=doubt)
    pose = as_pose(rotations, HIPS.to(dtype) - problem.origin)
    for number, limb in enumerate(model.share.limbs):
        off = 0.8 * torch.sin(torch.arange(19.0) + number).to(dtype)
        model.share.turn(pose.relative, limb, off)
    kernels = {"steps": model.steps, "constants": model.constants(problem.rest)}
    held = {model.share.limbs[1].end}
    twin, found = (searched(model, problem, pose, held, near=near, **one) for one in ({}, kernels))
    moved = (twin.relative - pose.relative).abs().amax((0, 2, 3)) > 0
    assert moved.sum() == 2 * (len(model.share.limbs) - 1)
    torch.testing.assert_close(found.relative, twin.relative, atol=rounding, rtol=0)


def test_hinges_are_left_alone():
    _, model = layer_of(correct=True), model_of(correct=True)
    elbow = model.share.limbs[0].end
    assert len(model.share.free({elbow})) == len(model.share.limbs) - 1
