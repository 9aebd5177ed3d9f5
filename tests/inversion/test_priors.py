"""Soft terms and hinges: their derivatives, that the Warp twin agrees, and what they do to a fit."""

import math

import pytest
import torch

from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix, cayley, matrix_to_axis_angle
from soma_core.inversion.priors import (
    HINGES,
    PosePriors,
    hinge_rotation,
    joint_terms,
    neighbour_mean,
    with_references,
)
from tests.bodies import CPU, randn
from tests.inversion.small_problem import pose_about, real

TWIN = 1e-8
"""Warp and torch run the same steps in float64; a dozen of them add up roundings."""
ON_AXIS = 1e-9
"""A hinge is kept to rounding [rad]."""

NAMES = ["LeftForeArm", "RightForeArm", "LeftShin", "RightShin", "Head"]


def terms(priors, names=NAMES):
    return joint_terms(priors, names, dtype=torch.float64, device=CPU)


def all_of(priors, count):
    """Terms for the real rig, with a pull to rotations of every frame."""
    body = real()
    names = [body.rig.joint_names[j] for j in body.structure.variables]
    soft = joint_terms(priors, names, dtype=torch.float64, device=CPU)
    if priors.temporal_strength:
        reference = axis_angle_to_matrix(0.2 * randn(count, len(names), 3, seed=3))
        soft = with_references(soft, reference, priors.temporal_strength)
    return soft


PRIORS = {
    "limits": PosePriors(limits={"LeftForeArm": 0.2, "Head": 0.05}, limit_strength=0.2),
    "hinges": PosePriors(hinges=HINGES),
    "rest": PosePriors(rest_strength=0.01),
    "references": PosePriors(temporal_strength=0.01),
    "together": PosePriors(
        limits={"LeftForeArm": 0.2}, hinges=HINGES, rest_strength=0.003, temporal_strength=0.01
    ),
}


def fitted(priors, *, warp, count=3, iterations=8):
    body = real()
    identity = body.identities(1)
    vertices = body.posed(identity, *body.poses(count)) + 0.003 * randn(count, body.mesh.vertex_count, 3)
    rest = body.rest(identity, body.plain_weights())
    target, origin = body.moments().target(vertices, rest)
    relative = body.start(count).relative
    near = axis_angle_to_matrix(0.1 * randn(count, len(relative[0]) - 1, 3, seed=7)) @ body.poses(count)[0]
    names = body.rig.joint_names
    for name, axis in priors.hinges.items():
        j = names.index(name) - 1
        near[:, j] = hinge_rotation(near[:, j], torch.tensor(axis, dtype=torch.float64).expand(count, 3))
    start = pose_about(near, body.poses(count)[1], origin)
    soft = all_of(priors, count)
    pose = body.solver(warp=warp)(target, rest, start, iterations=iterations, terms=soft)
    return pose, soft, origin


@pytest.mark.parametrize("name", PRIORS)
def test_the_twins_agree(name):
    torch_pose, _, _ = fitted(PRIORS[name], warp=False)
    warp_pose, _, _ = fitted(PRIORS[name], warp=True)
    torch.testing.assert_close(warp_pose.relative, torch_pose.relative, atol=TWIN, rtol=0)
    torch.testing.assert_close(warp_pose.translation, torch_pose.translation, atol=TWIN, rtol=0)


@pytest.mark.parametrize("name", ["limits", "rest", "references", "together"])
def test_half_gradients_are_those_of_automatic_differentiation(name):
    soft, body = all_of(PRIORS[name], 3), real()
    count = len(body.structure.variables)
    rotations = axis_angle_to_matrix(0.4 * randn(3, count, 3, seed=1))
    above = axis_angle_to_matrix(randn(3, count, 3, seed=2))
    _, slope = soft.normal_equations(rotations, above)

    def energy(turn):
        local = (above.transpose(-1, -2) @ turn[..., None]).squeeze(-1)
        return soft.energy(cayley(local) @ rotations).sum()

    gradient = torch.autograd.functional.jacobian(energy, torch.zeros_like(slope))
    torch.testing.assert_close(slope, gradient / 2, atol=1e-12, rtol=1e-9)


def test_blocks_are_never_indefinite_and_plain_for_a_pull_without_free_range():
    soft = terms(PosePriors(limits={"Head": 0.3}, rest_strength=0.1))
    rotations = axis_angle_to_matrix(randn(20, len(NAMES), 3, seed=4))
    above = axis_angle_to_matrix(randn(20, len(NAMES), 3, seed=5))
    blocks, _ = soft.normal_equations(rotations, above)
    assert torch.linalg.eigvalsh(blocks).min() > -1e-12
    plain = 0.1**2 * torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(blocks[:, 0], plain.expand(20, 3, 3), atol=1e-12, rtol=0)


def test_a_term_is_zero_inside_its_free_range_and_grows_with_the_square_of_what_is_over():
    soft = terms(PosePriors(limits={"Head": 0.5}, limit_strength=0.2))
    angles = torch.tensor([0.0, 0.3, 0.5, 0.6, 0.9], dtype=torch.float64)
    rotations = torch.eye(3, dtype=torch.float64).repeat(5, len(NAMES), 1, 1)
    vector = torch.zeros(5, 3, dtype=torch.float64)
    vector[:, 1] = angles
    rotations[:, -1] = axis_angle_to_matrix(vector)
    expected = 0.2**2 * (angles - 0.5).clamp_min(0) ** 2
    torch.testing.assert_close(soft.energy(rotations), expected, atol=1e-14, rtol=1e-9)


@pytest.mark.parametrize("warp", [False, True])
def test_limits_pull_back_what_is_beyond_them(warp):
    free, _, _ = fitted(PosePriors(), warp=warp)
    held, _, _ = fitted(PRIORS["limits"], warp=warp)
    arm = real().rig.joint_names.index("LeftForeArm")
    before, after = (matrix_to_axis_angle(pose.relative[:, arm]).norm(dim=-1) for pose in (free, held))
    beyond = before > 0.25
    assert beyond.any()
    assert (after[beyond] < before[beyond]).all()
    assert after.max() < before.max() - 0.1


@pytest.mark.parametrize("warp", [False, True])
def test_hinges_turn_about_their_axis_alone(warp):
    pose, _, _ = fitted(PRIORS["hinges"], warp=warp)
    for name, axis in HINGES.items():
        vector = matrix_to_axis_angle(pose.relative[:, real().rig.joint_names.index(name)])
        across = vector - (vector @ torch.tensor(axis, dtype=torch.float64))[:, None] * torch.tensor(axis)
        assert across.abs().max() < ON_AXIS
        assert vector.abs().max() > 0.01


def test_the_part_of_a_rotation_about_an_axis():
    axis = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    turn = axis_angle_to_matrix(torch.tensor([[0.0, 0.7, 0.0], [0.0, -3.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(hinge_rotation(turn, axis.expand(2, 3)), turn)
    any_turn = axis_angle_to_matrix(randn(2, 3, seed=9))
    kept = matrix_to_axis_angle(hinge_rotation(any_turn, axis.expand(2, 3)))
    assert kept[:, [0, 2]].abs().max() < ON_AXIS
    torch.testing.assert_close(hinge_rotation(any_turn, torch.zeros(2, 3, dtype=torch.float64)), any_turn)


def test_the_mean_of_neighbours_leaves_out_frames_that_are_not_valid():
    vectors = torch.zeros(5, 1, 3, dtype=torch.float64)
    vectors[:, 0, 2] = torch.tensor([0.0, 0.1, 9.0, 0.3, 0.4], dtype=torch.float64)
    valid = torch.tensor([True, True, False, True, True])
    mean = matrix_to_axis_angle(neighbour_mean(axis_angle_to_matrix(vectors), valid))[:, 0, 2]
    # Frame 1 has one valid neighbour, frame 0; frame 2 two; frame 3 one, frame 4.
    torch.testing.assert_close(
        mean, torch.tensor([0.1, 0.0, 0.2, 0.4, 0.3], dtype=torch.float64), atol=1e-4, rtol=0
    )


def test_no_priors_are_no_terms():
    assert terms(PosePriors()) is None


@pytest.mark.parametrize(
    ("priors", "text"),
    [
        (PosePriors(limits={"LeftEye": 1.0}), r"priors\.limits.*'LeftEye'"),
        (PosePriors(hinges={"Nose": (1.0, 0.0, 0.0)}), r"priors\.hinges.*'Nose'"),
        (PosePriors(hinges={"Head": (0.0, 0.0, 0.0)}), r"priors\.hinges\['Head'\].*\(0\.0, 0\.0, 0\.0\)"),
        (PosePriors(rest_strength=-1.0), r"priors\.rest_strength.*-1\.0"),
    ],
)
def test_priors_that_make_no_sense_are_refused(priors, text):
    with pytest.raises(InputError, match=text):
        terms(priors)


def test_strengths_are_in_metres_of_vertex_error():
    # A whole-body error of s a costs s^2 a^2 for each unit of weight, and so does the term.
    soft = terms(PosePriors(rest_strength=0.02), names=["Head"])
    turn = axis_angle_to_matrix(torch.tensor([[[0.0, 0.0, 0.5]]], dtype=torch.float64))
    assert math.isclose(float(soft.energy(turn)), (0.02 * 0.5) ** 2, rel_tol=1e-9)
