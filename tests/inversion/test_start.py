"""Where a fit begins: exact for rigid bodies, proper rotations for anything."""

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.inversion.start import ProcrustesStart, best_translation, cloud_extent
from tests.bodies import CPU, randn
from tests.inversion.small_problem import pose_about, synthetic

EXACT = 3e-4
"""Radians: the prior of the Procrustes rotation turns thin clouds by a few times its strength, 1e-5."""
FRAMES = 4
BODY = synthetic()
STRUCTURE = BODY.structure
VERTICES = BODY.mesh.vertex_count


@pytest.fixture(scope="module")
def start():
    return ProcrustesStart(STRUCTURE, dtype=torch.float64, device=CPU)


@pytest.fixture(scope="module")
def rest():
    return BODY.rest(BODY.identities(1), BODY.plain_weights())


def targets(vertices, rest):
    return BODY.moments().target(vertices, rest)


def rigid_turns(seed=1):
    """Whole bodies turned by anything up to half a turn and more, limbs as at T-pose."""
    rotations = torch.eye(3, dtype=torch.float64).repeat(FRAMES, BODY.rig.joint_count - 1, 1, 1)
    rotations[:, 0] = axis_angle_to_matrix(2 * randn(FRAMES, 3, seed=seed))
    return rotations


def test_a_rigid_motion_of_the_bind_pose_is_found(start):
    """Every joint's points have turned together: the world turn of each is that turn of its bind."""
    identity, turn = BODY.identities(1), axis_angle_to_matrix(2 * randn(FRAMES, 3, seed=1))
    rest = BODY.rest(identity, BODY.plain_weights())
    vertices = identity.rest @ turn.transpose(-1, -2) + randn(FRAMES, 1, 3, seed=2)
    target, origin = targets(vertices, rest)
    pose = pose_about(start(target, rest)[:, 1:], torch.zeros_like(origin), torch.zeros_like(origin))
    turns, _ = BODY.solver().walk(pose, rest)
    joints = STRUCTURE.joints
    bind = identity.bind_world[:, joints, :3, :3] @ torch.tensor(BODY.rig.t_pose_world)[joints, :3, :3].mT
    torch.testing.assert_close(turns[:, joints], turn[:, None] @ bind, atol=EXACT, rtol=0)


def test_joints_without_points_follow_their_parent(start, rest):
    target, _ = targets(BODY.posed(BODY.identities(1), *BODY.poses(FRAMES)), rest)
    relative = start(target, rest)
    without = sorted(set(range(1, BODY.rig.joint_count)) - set(STRUCTURE.joints))
    assert without
    eye = torch.eye(3, dtype=torch.float64).expand(FRAMES, len(without), 3, 3)
    torch.testing.assert_close(relative[:, without], eye, atol=1e-12, rtol=0)
    assert torch.equal(relative[:, 0], eye[:, 0])


def test_turning_the_target_turns_the_hips_alone(start, rest):
    vertices = BODY.posed(BODY.identities(1), *BODY.poses(FRAMES))
    turn = axis_angle_to_matrix(2 * randn(1, 3, seed=1))[0]
    before = start(targets(vertices, rest)[0], rest)
    after = start(targets(vertices @ turn.T, rest)[0], rest)
    torch.testing.assert_close(after[:, 1], turn @ before[:, 1], atol=1e-4, rtol=0)
    torch.testing.assert_close(after[:, 2:], before[:, 2:], atol=1e-4, rtol=0)


@pytest.mark.parametrize("case", ["point", "plane", "line", "mirrored", "noise"])
def test_degenerate_targets_give_proper_rotations(start, rest, case):
    vertices = BODY.posed(BODY.identities(1), *BODY.poses(FRAMES))
    vertices = {
        "point": torch.zeros_like(vertices),
        "plane": vertices * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64),
        "line": vertices * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64),
        "mirrored": vertices * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64),
        "noise": randn(*vertices.shape, seed=9),
    }[case]
    assert orthonormality_error(start(targets(vertices, rest)[0], rest)).max() < 1e-10


def test_the_best_translation_leaves_no_mean_residual(rest):
    vertices, (rotations, hips) = (
        BODY.posed(BODY.identities(1), *BODY.poses(FRAMES)),
        BODY.poses(FRAMES, seed=20),
    )
    target, origin = targets(vertices, rest)
    pose = pose_about(rotations, torch.zeros_like(hips), torch.zeros_like(hips))
    turns, places = BODY.solver().walk(pose, rest)
    joints = STRUCTURE.joints
    shift = best_translation(target, rest, turns[:, joints], places[:, joints]) + origin
    fitted = torch.tensor(STRUCTURE.fitted)
    step = (BODY.posed(BODY.identities(1), rotations, shift) - vertices)[:, fitted]
    torch.testing.assert_close(step.mean(1), torch.zeros_like(hips), atol=1e-10, rtol=0)


def test_extent_is_the_scale_and_side_the_mirror(rest):
    identity = BODY.identities(1)
    turn = axis_angle_to_matrix(2 * randn(1, 3, seed=1))[0]
    body = identity.rest @ turn.T + randn(1, 1, 3, seed=3)
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    frames = torch.cat((body, 0.01 * body, 100 * body, body * mirror, torch.ones_like(body)))
    extent, side = cloud_extent(targets(frames, rest)[0], rest)
    ones = torch.ones(len(STRUCTURE.joints), dtype=torch.float64)
    for frame, (scale, sign) in enumerate([(1, 1), (0.01, 1), (100, 1), (1, -1)]):
        torch.testing.assert_close(extent[frame], scale * ones, rtol=1e-9, atol=0)
        assert torch.equal(side[frame], sign * ones)
    assert extent[4].max() < 1e-9


def test_one_collapsed_hand_is_seen_in_its_own_joints(rest):
    vertices = BODY.posed(BODY.identities(1), *BODY.poses(1))
    weights = torch.tensor(BODY.rig.weights.toarray())
    hand = [joint for joint, name in enumerate(BODY.rig.joint_names) if name.startswith("LeftHand")]
    inside = weights[:, hand].sum(1) > 0
    vertices[:, inside] = vertices[:, inside].mean(1, keepdim=True)
    extent, _ = cloud_extent(targets(vertices, rest)[0], rest)
    joints = STRUCTURE.joints
    small = {BODY.rig.joint_names[joint] for joint in joints[extent[0].numpy() < 0.1]}
    assert {"LeftHandIndex2", "LeftHandThumb3"} <= small
    assert not any(name.startswith("Right") for name in small)
    assert VERTICES > inside.sum() > 20
