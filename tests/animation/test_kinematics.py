"""Forward kinematics against a plain loop in the rig's own axes, and the T-pose as zero."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.animation.kinematics import (
    Kinematics,
    absolute_from_relative,
    relative_from_absolute,
    to_homogeneous,
)
from soma_core.geometry.rotations import orthonormality_error
from soma_core.geometry.tree import joint_levels
from soma_core.rig import load_canonical
from tests.bodies import CPU, randn, tiny_canonical

ROUNDING_M = 1e-12
"""float64, a dozen products deep."""
SINGLE_M = 2e-6
"""float32, a dozen products deep, bodies of two metres."""
T_POSE_MM = 1e-3
"""The stored T-pose positions against chains of stored bind offsets."""


def rigs():
    return {"tiny": tiny_canonical()[1], "low": load_canonical("low")[1]}


@pytest.fixture(scope="module", params=["tiny", "low"])
def rig(request):
    return rigs()[request.param]


@pytest.fixture(scope="module")
def kinematics(rig):
    return Kinematics(rig, dtype=torch.float64, device=CPU)


def turns(rig, batch, seed=0, dtype=torch.float64):
    joints = rig.joint_count - 1
    matrices = Rotation.random(batch * joints, random_state=seed).as_matrix()
    return torch.as_tensor(matrices.reshape(batch, joints, 3, 3), dtype=dtype)


def bodies(rig, batch, seed=0):
    """Bind transforms of other bodies: bones of other lengths, frames turned a little; (batch, J, 4, 4)."""
    random = np.random.default_rng(seed)
    bind = np.repeat(rig.bind_world[None], batch, 0)
    bind[:, 1:, :3, 3] = 0.9 * bind[:, 1:, :3, 3] + random.normal(scale=0.02, size=bind[:, 1:, :3, 3].shape)
    bend = Rotation.from_rotvec(random.normal(scale=0.1, size=(batch * (rig.joint_count - 1), 3))).as_matrix()
    bind[:, 1:, :3, :3] = bend.reshape(batch, -1, 3, 3) @ bind[:, 1:, :3, :3]
    return torch.as_tensor(bind)


def plain_fk(rig, bind, relative, translation):
    """One body, one joint at a time, by absolute local rotations ``A_j = O_p^T R_j O_j``."""
    orient = rig.t_pose_world[:, :3, :3]
    world = np.tile(np.eye(4), (rig.joint_count, 1, 1))
    for joint in range(1, rig.joint_count):
        parent = rig.parents[joint]
        local = np.linalg.inv(bind[parent]) @ bind[joint]
        local[:3, :3] = orient[parent].T @ relative[joint - 1] @ orient[joint]
        if joint == 1:
            local[:3, 3] = translation
        world[joint] = world[parent] @ local
    return world


def run(kinematics, bind, relative, translation):
    rotations, positions = kinematics(relative, kinematics.local_offsets(bind), translation)
    return to_homogeneous(rotations, positions)


def test_equals_a_plain_loop(rig, kinematics):
    bind, relative, translation = bodies(rig, 3), turns(rig, 3), randn(3, 3, seed=1)
    found = run(kinematics, bind, relative, translation)
    for index in range(3):
        expected = plain_fk(rig, bind[index].numpy(), relative[index].numpy(), translation[index].numpy())
        np.testing.assert_allclose(found[index], expected, atol=ROUNDING_M)


def test_float32(rig):
    kinematics = Kinematics(rig, dtype=torch.float32, device=CPU)
    bind, relative, translation = bodies(rig, 2), turns(rig, 2), randn(2, 3, seed=1)
    found = run(kinematics, bind.float(), relative.float(), translation.float())
    for index in range(2):
        expected = plain_fk(rig, bind[index].numpy(), relative[index].numpy(), translation[index].numpy())
        np.testing.assert_allclose(found[index], expected, atol=SINGLE_M)
    assert orthonormality_error(found[..., :3, :3]).max() < SINGLE_M


@pytest.mark.parametrize("lod", ["tiny", "low", "mid"])
def test_zero_is_the_t_pose(lod):
    rig = tiny_canonical()[1] if lod == "tiny" else load_canonical(lod)[1]
    kinematics = Kinematics(rig, dtype=torch.float64, device=CPU)
    t_pose = torch.from_numpy(np.array(rig.t_pose_world))
    zero = torch.eye(3, dtype=torch.float64).expand(1, rig.joint_count - 1, 3, 3)
    found = run(kinematics, torch.from_numpy(np.array(rig.bind_world))[None], zero, t_pose[None, 1, :3, 3])[0]
    torch.testing.assert_close(found[:, :3, :3], t_pose[:, :3, :3], atol=1e-9, rtol=0)
    torch.testing.assert_close(1e3 * found[:, :3, 3], 1e3 * t_pose[:, :3, 3], atol=T_POSE_MM, rtol=0)


def test_zero_turns_frames_to_the_t_pose_whatever_the_body(rig, kinematics):
    """Rotations at zero are the rig's, not the body's; bones point where its T-pose points."""
    zero = torch.eye(3, dtype=torch.float64).expand(2, rig.joint_count - 1, 3, 3)
    found = run(kinematics, bodies(rig, 2), zero, torch.zeros(2, 3, dtype=torch.float64))
    expected = torch.from_numpy(np.array(rig.t_pose_world[:, :3, :3])).expand(2, -1, 3, 3)
    torch.testing.assert_close(found[..., :3, :3], expected, atol=1e-9, rtol=0)


def test_bind_relative_rotations_give_the_bind_pose(rig, kinematics):
    bind = torch.from_numpy(np.array(rig.bind_world))[None]
    found = run(kinematics, bind, kinematics.bind_relative[None], bind[:, 1, :3, 3])
    torch.testing.assert_close(found, bind, atol=1e-9, rtol=0)


def test_bind_positions_are_the_walk_with_bind_rotations(rig, kinematics):
    bind, hips = bodies(rig, 3), randn(3, 3, seed=3)
    offsets = kinematics.local_offsets(bind)
    _, expected = kinematics(kinematics.bind_relative.expand(3, -1, 3, 3), offsets, hips)
    torch.testing.assert_close(kinematics.bind_positions(offsets, hips), expected, atol=ROUNDING_M, rtol=0)


def test_translation_is_the_place_of_the_hips(rig, kinematics):
    bind, relative, translation = bodies(rig, 2), turns(rig, 2), randn(2, 3, seed=4)
    found = run(kinematics, bind, relative, translation)
    torch.testing.assert_close(found[:, 1, :3, 3], translation)
    moved = bind.clone()
    moved[:, 1:, :3, 3] += 7  # where the rest shape stands does not matter
    torch.testing.assert_close(run(kinematics, moved, relative, translation), found, atol=1e-11, rtol=0)


def test_root_stays_at_the_origin(rig, kinematics):
    found = run(kinematics, bodies(rig, 2), turns(rig, 2), randn(2, 3))
    assert torch.equal(found[:, 0], torch.eye(4, dtype=torch.float64).expand(2, 4, 4))


def test_bones_keep_their_lengths(rig, kinematics):
    bind = bodies(rig, 2)
    found = run(kinematics, bind, turns(rig, 2), randn(2, 3))
    for joint in range(2, rig.joint_count):
        parent = rig.parents[joint]
        for index in range(2):
            length = (bind[index, joint] - bind[index, parent])[:3, 3].norm()
            torch.testing.assert_close((found[index, joint] - found[index, parent])[:3, 3].norm(), length)


def test_turning_the_hips_turns_everything(rig, kinematics):
    bind, relative, translation = bodies(rig, 1), turns(rig, 1), randn(1, 3)
    turn = torch.from_numpy(Rotation.random(random_state=9).as_matrix())
    first = run(kinematics, bind, relative, translation)
    turned = relative.clone()
    turned[:, 0] = turn @ relative[:, 0]
    second = run(kinematics, bind, turned, translation @ turn.T)
    torch.testing.assert_close(second[:, 1:, :3], turn @ first[:, 1:, :3], atol=1e-11, rtol=0)


def test_relative_rotations_are_in_world_axes_at_t_pose(rig, kinematics):
    """Turning one joint about world y turns its subtree about world y, through that joint."""
    zero = torch.eye(3, dtype=torch.float64).repeat(1, rig.joint_count - 1, 1, 1)
    bind = torch.from_numpy(np.array(rig.bind_world))[None]
    still = run(kinematics, bind, zero, torch.zeros(1, 3, dtype=torch.float64))[0]
    joint = max(range(2, rig.joint_count), key=lambda j: np.sum(rig.parents == j))
    turn = torch.as_tensor(Rotation.from_rotvec([0, 0.7, 0]).as_matrix())
    zero[0, joint - 1] = turn
    found = run(kinematics, bind, zero, torch.zeros(1, 3, dtype=torch.float64))[0]
    below = [k for k in range(rig.joint_count) if joint in ancestors(rig, k)]
    pivot = still[joint, :3, 3]
    torch.testing.assert_close(
        found[below, :3, 3], (still[below, :3, 3] - pivot) @ turn.T + pivot, atol=1e-12, rtol=0
    )
    others = [k for k in range(rig.joint_count) if k not in below and k != joint]
    torch.testing.assert_close(found[others], still[others], atol=1e-12, rtol=0)


def ancestors(rig, joint):
    chain = []
    while rig.parents[joint] >= 0:
        joint = int(rig.parents[joint])
        chain.append(joint)
    return chain


def test_absolute_and_relative_undo_each_other(rig, kinematics):
    relative = turns(rig, 4, seed=5)
    orient, above = kinematics.orient[1:], kinematics.parent_orient[1:]
    absolute = absolute_from_relative(relative, orient, above)
    assert orthonormality_error(absolute).max() < 1e-9
    torch.testing.assert_close(relative_from_absolute(absolute, orient, above), relative, atol=1e-9, rtol=0)


def test_absolute_local_rotations_compose_down_the_tree(rig, kinematics):
    relative = turns(rig, 1, seed=6)
    absolute = absolute_from_relative(relative, kinematics.orient[1:], kinematics.parent_orient[1:])[0]
    found = run(kinematics, bodies(rig, 1), relative, randn(1, 3))[0, :, :3, :3]
    for joint in range(1, rig.joint_count):
        expected = found[rig.parents[joint]] @ absolute[joint - 1]
        torch.testing.assert_close(found[joint], expected, atol=1e-11, rtol=0)


def test_shared_body_equals_repeated_body(rig, kinematics):
    bind, relative, translation = bodies(rig, 1), turns(rig, 5), randn(5, 3)
    shared = run(kinematics, bind, relative, translation)
    torch.testing.assert_close(shared, run(kinematics, bind.expand(5, -1, 4, 4), relative, translation))


def test_permuting_the_batch_permutes_the_result(rig, kinematics):
    bind, relative, translation = bodies(rig, 5), turns(rig, 5), randn(5, 3)
    order = torch.tensor([3, 1, 4, 0, 2])
    permuted = run(kinematics, bind[order], relative[order], translation[order])
    torch.testing.assert_close(
        permuted, run(kinematics, bind, relative, translation)[order], atol=1e-14, rtol=0
    )


def test_gradcheck():
    rig = tiny_canonical()[1]
    kinematics = Kinematics(rig, dtype=torch.float64, device=CPU)
    bind, relative, translation = bodies(rig, 2), turns(rig, 2), randn(2, 3)
    inputs = tuple(part.requires_grad_() for part in (bind, relative, translation))
    assert torch.autograd.gradcheck(lambda *x: run(kinematics, *x), inputs, fast_mode=True)


def test_levels_hold_every_joint_once_below_its_parent():
    rig = tiny_canonical()[1]
    levels = joint_levels(rig.parents)
    np.testing.assert_array_equal(np.sort(np.concatenate(levels)), np.arange(1, rig.joint_count))
    above = np.array([0])
    for level in levels:
        assert np.isin(rig.parents[level], above).all()
        above = level
