"""What exporters share: influences, continuous quaternions, normals, colours."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.geometry.mesh import vertex_normals
from soma_core.io.clip import linear_colour, skinned_clip
from soma_core.layer import SomaLayer
from tests.bodies import randn

VERTEX_M = 1e-9
"""float64; bones that only jitter are replaced by their length at rest."""


def test_influences_rebuild_the_weights(clip):
    joint_ids, weights = clip.influences()
    dense = np.zeros((clip.mesh.vertex_count, clip.rig.joint_count))
    np.add.at(dense, (np.arange(len(dense))[:, None], joint_ids), weights)
    np.testing.assert_allclose(dense, clip.rig.weights.toarray(), atol=1e-7)


def test_quaternions_do_not_flip_between_frames(clip):
    assert ((clip.quaternions[1:] * clip.quaternions[:-1]).sum(-1) > 0).all()


def test_a_single_pose_is_a_clip_as_well():
    layer = SomaLayer("soma", lod="low")
    identity = layer.identity()
    posed = layer.pose(identity, torch.zeros(1, 77, 3))
    clip = skinned_clip(layer.mesh, layer.rig, identity, posed.transforms, fps=30)
    assert clip.quaternions.shape == (1, layer.rig.joint_count, 4)
    assert "influences" in clip.limits


def test_only_the_hips_move_along(clip):
    bones = np.ptp(clip.translations, axis=0).max(axis=1)
    assert np.flatnonzero(bones).tolist() == [1]


def test_normals_of_a_cylinder_point_outwards(clip):
    normals = vertex_normals(clip.rest, clip.mesh.triangles)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    assert ((normals * clip.rest)[:, [0, 2]].sum(axis=1) > 0).all()


def test_a_vertex_without_area_has_a_normal():
    normals = vertex_normals(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(normals, np.tile([0.0, 1.0, 0.0], (3, 1)))


def test_linear_colour_of_known_greys():
    np.testing.assert_allclose(linear_colour((0.0, 0.5, 1.0)), (0.0, 0.2140, 1.0), atol=1e-3)


@pytest.mark.parametrize("name", ["rest", "bind_world", "transforms"])
def test_another_size_is_refused(clip, name):
    identity = {"rest": clip.rest[None], "bind_world": clip.bind_world[None]}
    arrays = identity | {"transforms": clip.bind_world[None]}
    arrays[name] = arrays[name][:, :-1]
    with pytest.raises(InputError, match=rf"{name}: got shape \(1, {arrays[name].shape[1]}"):
        skinned_clip(
            clip.mesh,
            clip.rig,
            SimpleNamespace(rest=arrays["rest"], bind_world=arrays["bind_world"]),
            arrays["transforms"],
            fps=30,
        )


@pytest.fixture(scope="module")
def twisted():
    """A layer with twist joints, an identity, three frames posed by it, and their clip."""
    layer = SomaLayer("soma", lod="low", dtype=torch.float64, correctives=None)
    identity = layer.identity({"shape": randn(1, 128)})
    posed = layer.pose(identity, 0.5 * randn(3, 77, 3, seed=1), randn(3, 3, seed=2))
    helpers = layer.helper_transforms(identity, posed.transforms)
    clip = skinned_clip(layer.mesh, layer.rig, identity, posed.transforms, helpers=helpers, fps=30)
    return layer, identity, posed, clip


def test_twist_joints_become_joints_with_the_skin_on_them(twisted):
    """Plain skinning of the exported joints, as any viewer does it, gives the posed body."""
    layer, _, posed, clip = twisted
    assert clip.rig.joint_names[78:] == layer.rig.procedural.joint_names
    world = np.tile(np.eye(4), (3, 110, 1, 1))
    for joint, parent in enumerate(clip.rig.parents.tolist()):
        local = np.tile(np.eye(4), (3, 1, 1))
        local[:, :3, 3] = clip.translations[:, joint]
        local[:, :3, :3] = Rotation.from_quat(clip.quaternions[:, joint]).as_matrix()
        world[:, joint] = local if parent < 0 else world[:, parent] @ local
    moved = world @ np.linalg.inv(clip.bind_world)
    rest = np.concatenate([clip.rest, np.ones((len(clip.rest), 1))], axis=1)
    found = np.einsum("vj,fjab,vb->fva", clip.rig.weights.toarray(), moved[:, :, :3], rest, optimize=True)
    np.testing.assert_allclose(found, posed.vertices.numpy(), atol=VERTEX_M)


def test_twist_joints_rest_between_the_joints_of_the_t_pose(twisted):
    layer, _, _, clip = twisted
    definition = layer.rig.procedural.definition
    place = dict(zip(clip.rig.joint_names, clip.t_pose_world[:, :3, 3], strict=True))
    for helper, shares in definition.translation.items():
        expected = sum(share * place[name] for name, share in shares.items())
        np.testing.assert_allclose(place[helper], expected, atol=1e-6)  # shares of seven digits


def test_without_them_the_skin_lies_on_the_public_joints(twisted):
    layer, identity, posed, _ = twisted
    clip = skinned_clip(layer.mesh, layer.rig, identity, posed.transforms, fps=30)
    assert clip.rig is layer.rig
    assert clip.rig.joint_count == 78


def test_twist_joints_of_another_count_are_refused(twisted):
    layer, identity, posed, _ = twisted
    helpers = np.zeros((3, 31, 4, 4))
    with pytest.raises(InputError, match=r"helpers: got shape \(3, 31, 4, 4\).*\(3, 32, 4, 4\)"):
        skinned_clip(layer.mesh, layer.rig, identity, posed.transforms, helpers=helpers, fps=30)
