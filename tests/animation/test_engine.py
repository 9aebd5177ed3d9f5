"""Posing with twist joints: the definition of skinning over all 110 joints, and the ways that lead there."""

from dataclasses import replace

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.layer import SomaLayer
from tests.bodies import randn, tiny_canonical, tiny_registry

SAME_M = 1e-12
"""float64: the same sums in another order, on bodies of two metres."""
SINGLE_M = 5e-6
SPREAD_M = 1e-2
"""Twist joints move skin at least so far in the poses below."""

FLOAT32_M = 2e-7
"""The spacing of float32 at two metres: what weights too small to count in it may move together."""


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", dtype=torch.float64, kernels="torch", correctives=None)


@pytest.fixture(scope="module")
def bodies(layer):
    """Three identities, rotations, Hips positions and bone scales."""
    scale = 1 + 0.2 * torch.rand(3, 77, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    identity = layer.identity({"shape": randn(3, 128, seed=1)})
    return identity, 0.4 * randn(3, 77, 3, seed=2), randn(3, 3, seed=3), scale


def test_equals_the_dense_definition_over_all_joints(layer, bodies):
    identity, rotations, hips, scale = bodies
    posed = layer.pose(identity, rotations, hips, bone_scale=scale)
    twist, bind = layer.posing.twist, identity.bind_world
    helpers = layer.helper_transforms(identity, posed.transforms, scale)
    at_bind = torch.eye(4, dtype=torch.float64).repeat(3, 32, 1, 1)
    at_bind[..., :3, :3], at_bind[..., :3, 3] = twist.bind_rotations(bind), twist.bind_positions(bind)
    moved = torch.cat((posed.transforms, helpers), 1) @ torch.linalg.inv(torch.cat((bind, at_bind), 1))
    rest = torch.nn.functional.pad(identity.rest, (0, 1), value=1.0)
    skin = layer.rig.procedural
    for weights, bound in (
        (skin.skin, SAME_M),
        (skin.weights, FLOAT32_M),
    ):  # those that move it, all of the file
        dense = torch.as_tensor(weights.toarray())
        expected = torch.einsum("vj,bjik,bvk->bvi", dense, moved, rest)[..., :3]
        torch.testing.assert_close(posed.vertices, expected, atol=bound, rtol=0)
    assert skin.skin.nnz < 0.9 * skin.weights.nnz


def test_plain_poses_are_those_of_a_layer_without_twist_joints(layer, bodies):
    identity, rotations, hips, scale = bodies
    plain = SomaLayer("soma", lod="low", dtype=torch.float64, kernels="torch", procedural=False)
    assert not plain.procedural
    ours = layer.pose_plain(identity, rotations, hips, bone_scale=scale)
    theirs = plain.pose(identity, rotations, hips, bone_scale=scale)
    full = layer.pose(identity, rotations, hips, bone_scale=scale)
    torch.testing.assert_close(ours.vertices, theirs.vertices, atol=0, rtol=0)
    torch.testing.assert_close(ours.transforms, full.transforms, atol=0, rtol=0)
    assert (full.vertices - ours.vertices).norm(dim=-1).max() > SPREAD_M
    assert plain.helper_transforms(identity, theirs.transforms, scale).shape == (3, 0, 4, 4)


def test_a_rig_without_twist_joints_is_posed_plainly(tmp_path):
    layer = SomaLayer(
        "tiny", dtype=torch.float64, canonical=tiny_canonical(), registry=tiny_registry(tmp_path)
    )
    assert not layer.procedural
    assert layer.posing is layer.animation


@pytest.mark.parametrize("kernels", ["torch", "warp"])
def test_one_identity_for_all_and_large_batches(kernels):
    """The sparse matrix of a shared identity, the chunks of a large batch and a plain batch agree."""
    layer = SomaLayer("soma", lod="low", kernels=kernels, correctives=None)
    rotations, shape = 0.4 * randn(40, 77, 3, seed=4).float(), randn(1, 128, seed=5).float()
    with torch.no_grad():
        shared = layer.pose(layer.identity({"shape": shape}), rotations).vertices
        chunked = layer({"shape": shape.expand(40, -1)}, rotations).vertices
        each = layer.pose(layer.identity({"shape": shape.expand(40, -1)}), rotations).vertices
    torch.testing.assert_close(shared, each, atol=SINGLE_M, rtol=0)
    torch.testing.assert_close(chunked, each, atol=SINGLE_M, rtol=0)


@pytest.mark.parametrize("engine", ["posing", "animation"])
def test_offsets_move_the_rest_shape_of_each_pose(layer, bodies, engine):
    identity, _, hips, _ = bodies
    pose = getattr(layer, engine).pose
    relative = axis_angle_to_matrix(bodies[1])
    offsets = 0.01 * randn(*identity.rest.shape, seed=6)
    found = pose(identity, relative, hips, absolute=False, offsets=offsets)
    expected = pose(replace(identity, rest=identity.rest + offsets), relative, hips, absolute=False)
    torch.testing.assert_close(found.vertices, expected.vertices, atol=0, rtol=0)


@pytest.mark.parametrize("kernels", ["torch", "warp"])
def test_gradients_reach_rotations_and_shape(kernels):
    layer = SomaLayer("soma", lod="low", kernels=kernels, correctives=None)
    rotations = torch.zeros(2, 77, 3).requires_grad_()  # zero is where angles are hardest
    shape = torch.zeros(2, 3).requires_grad_()
    layer({"shape": shape}, rotations).vertices.square().sum().backward()
    assert rotations.grad.isfinite().all()
    assert shape.grad.isfinite().all()
    hand = layer.joint_names.index("LeftHand")
    assert rotations.grad[:, hand].abs().max() > 0
