"""The moments: the skinning error as a quadratic, for any identities, weights and places."""

import numpy as np
import pytest
import torch

from tests.bodies import randn
from tests.inversion.small_problem import pose_about, synthetic

EXACT = 1e-10
"""Relative, float64: the same sums in another order."""
SINGLE = 2e-5
"""Relative to the largest entry, float32: a few thousand roundings."""
FRAMES = 3
BODY = synthetic()
STRUCTURE = BODY.structure
VERTICES = BODY.mesh.vertex_count


def by_definition(identity, weights, transforms, vertices):
    """Energies (F,) of arbitrary transforms (F, T, 3, 4): every vertex, one joint at a time, in numpy."""
    found = []
    joints = STRUCTURE.joints
    for frame in range(len(transforms)):
        who = min(frame, identity.batch_size - 1)
        reached = np.zeros((VERTICES, 3))
        for index, joint in enumerate(joints):
            bind = identity.bind_world[who, joint].numpy()
            turn = BODY.rig.t_pose_world[joint, :3, :3] @ bind[:3, :3].T
            local = (identity.rest[who].numpy() - bind[:3, 3]) @ turn.T
            transform = transforms[frame, index].numpy()
            moved = local @ transform[:, :3].T + transform[:, 3]
            reached += BODY.skin_weights[:, joint : joint + 1] * moved
        off = ((reached - vertices[frame].numpy()) ** 2).sum(1)
        found.append((weights[min(frame, len(weights) - 1)].numpy() * off).sum())
    return torch.tensor(found)


def quadratic(rest, target, origin, weights, transforms, vertices):
    """``<G N, G> - 2 <G, R> + const`` of transforms about the world's origin."""
    about = transforms.clone()
    about[..., 3] -= origin[:, None]
    second = BODY.solver().dense(rest.second)
    product = BODY.solver().times_second(about, second)
    constant = (weights * (vertices - origin[:, None]).square().sum(-1)).sum(1)
    return (product * about).sum((1, 2, 3)) - 2 * (about * target).sum((1, 2, 3)) + constant


def random_transforms(count, seed=0):
    """No rigid motions: the quadratic holds for every matrix."""
    return randn(count, len(STRUCTURE.joints), 3, 4, seed=seed)


@pytest.mark.parametrize("who", [1, FRAMES], ids=["one identity", "one a frame"])
@pytest.mark.parametrize("weighted", [1, FRAMES], ids=["same weights", "weights a frame"])
@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_the_quadratic_is_the_error_of_every_vertex(who, weighted, warp):
    identity, weights = BODY.identities(who), BODY.vertex_weights(weighted)
    vertices = randn(FRAMES, VERTICES, 3, seed=4)
    offsets = BODY.animation().kinematics.local_offsets(identity.bind_world)
    moments = BODY.moments(warp=warp)
    if who == weighted == 1:
        rest = moments.rest(identity, weights, offsets)
        target, origin = moments.target(vertices, rest)
    else:
        rest, target, origin = moments.each(vertices, identity, weights, offsets)
    transforms = random_transforms(FRAMES)
    expected = by_definition(identity, weights, transforms, vertices)
    found = quadratic(rest, target, origin, weights, transforms, vertices)
    torch.testing.assert_close(found, expected, rtol=EXACT, atol=0)


def test_at_a_pose_it_is_the_error_of_the_forward_model():
    identity, weights, (rotations, hips) = (
        BODY.identities(FRAMES),
        BODY.vertex_weights(FRAMES),
        BODY.poses(FRAMES),
    )
    rest = BODY.rest(identity, weights)
    vertices = BODY.posed(identity, rotations, hips) + 0.1 * randn(FRAMES, VERTICES, 3, seed=3)
    target, origin = BODY.moments().target(vertices, rest)
    pose = pose_about(rotations, hips, torch.zeros_like(origin))
    turns, places = BODY.solver().walk(pose, rest)
    transforms = torch.cat((turns, places[..., None]), -1)[:, STRUCTURE.joints]
    found = quadratic(rest, target, origin, weights, transforms, vertices)
    expected = (weights * (BODY.posed(identity, rotations, hips) - vertices).square().sum(-1)).sum(1)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=0)


def test_own_moments_are_the_sums_over_each_joints_points():
    identity, weights = BODY.identities(1), BODY.vertex_weights(1)
    rest = BODY.rest(identity, weights)
    local = BODY.moments().local_points(identity)[0].numpy()
    for index, joint in enumerate(STRUCTURE.joints):
        mine = STRUCTURE.influence_joint == index
        point = np.column_stack((local[mine], np.ones(mine.sum())))
        weight = (
            BODY.skin_weights[STRUCTURE.influence_vertex[mine], joint]
            * weights[0].numpy()[STRUCTURE.influence_vertex[mine]]
        )
        np.testing.assert_allclose(rest.own[0, index], (point * weight[:, None]).T @ point, atol=1e-12)


def test_local_points_follow_their_joint_at_any_pose():
    """Posed, a vertex that one joint alone moves lies at ``D b + c``."""
    identity, (rotations, hips) = BODY.identities(1), BODY.poses(2)
    vertices = BODY.posed(identity, rotations, hips)
    pose = pose_about(rotations, hips, torch.zeros(2, 3, dtype=torch.float64))
    turns, places = BODY.solver().walk(pose, BODY.rest(identity, BODY.plain_weights()))
    local = BODY.moments().local_points(identity)
    alone = np.flatnonzero(STRUCTURE.influence_weight > 1 - 1e-12)
    assert len(alone) > 20
    joint, vertex = STRUCTURE.joints[STRUCTURE.influence_joint[alone]], STRUCTURE.influence_vertex[alone]
    reached = (turns[:, joint] @ local[0, alone, :, None]).squeeze(-1) + places[:, joint]
    torch.testing.assert_close(reached, vertices[:, vertex], atol=1e-12, rtol=0)


def test_second_moments_are_symmetric_and_never_negative():
    second = BODY.solver().dense(BODY.rest(BODY.identities(2), BODY.vertex_weights(1)).second)
    torch.testing.assert_close(second, second.transpose(-1, -2), rtol=0, atol=1e-14)
    values = torch.linalg.eigvalsh(second)
    assert (values[:, 0] > -1e-12 * values[:, -1]).all()


def test_the_target_is_read_linearly():
    rest = BODY.rest(BODY.identities(1), BODY.vertex_weights(1))
    one, other = randn(2, FRAMES, VERTICES, 3, seed=6)
    read = BODY.moments().target

    def about_zero(vertices):
        target, origin = read(vertices, rest)
        return target + origin[:, None, :, None] * rest.own[:, :, None, 3]

    expected = 2 * about_zero(one) - 3 * about_zero(other)
    torch.testing.assert_close(about_zero(2 * one - 3 * other), expected, rtol=EXACT, atol=1e-10)


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_far_from_the_origin_nothing_is_lost(warp):
    """float32 vertices a kilometre away, as they are stored, give the moments of the same body at home."""
    moments = BODY.moments(torch.float32, warp=warp)
    identity, weights = BODY.identities(1, dtype=torch.float32), BODY.vertex_weights(1, dtype=torch.float32)
    rest = BODY.rest(identity, weights)
    far = BODY.posed(identity, *BODY.poses(FRAMES, dtype=torch.float32)) + torch.tensor(
        [1024.0, -2048.0, 512.0]
    )
    home = far - torch.tensor([1024.0, -2048.0, 512.0])
    target, origin = moments.target(far, rest)
    expected, near = moments.target(home, rest)
    torch.testing.assert_close(origin - near, far[:, 0] - home[:, 0], rtol=0, atol=0)
    torch.testing.assert_close(target, expected, rtol=0, atol=SINGLE * float(expected.abs().max()))


def test_frames_do_not_touch_each_other():
    rest = BODY.rest(BODY.identities(1), BODY.vertex_weights(1))
    vertices = randn(FRAMES, VERTICES, 3, seed=6)
    target, origin = BODY.moments().target(vertices, rest)
    for frame in range(FRAMES):
        alone, its = BODY.moments().target(vertices[frame : frame + 1], rest)
        torch.testing.assert_close(alone[0], target[frame], rtol=EXACT, atol=1e-12)
        assert torch.equal(its[0], origin[frame])


def test_vertices_without_weight_do_not_count():
    identity, weights = BODY.identities(1), BODY.vertex_weights(1)
    rest = BODY.rest(identity, weights)
    vertices = randn(FRAMES, VERTICES, 3, seed=6)
    changed = vertices.clone()
    changed[:, weights[0] == 0] += 5
    origin_vertex = int(STRUCTURE.influence_vertex[0])
    changed[:, origin_vertex] = vertices[:, origin_vertex]
    for one, other in zip(
        BODY.moments().target(vertices, rest), BODY.moments().target(changed, rest), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)


def test_results_have_the_asked_dtype_and_lie_near_float64():
    identity, weights = BODY.identities(1), BODY.vertex_weights(1)
    exact = BODY.rest(identity, weights)
    single = BODY.rest(BODY.identities(1, dtype=torch.float32), weights.float())
    for name in ("own", "second"):
        found, expected = getattr(single, name), getattr(exact, name)
        assert found.dtype == torch.float32
        torch.testing.assert_close(
            found.double(), expected, rtol=0, atol=SINGLE * float(expected.abs().max())
        )
