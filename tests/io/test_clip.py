"""What exporters share: influences, continuous quaternions, normals, colours."""

from types import SimpleNamespace

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.io.clip import linear_colour, skinned_clip, vertex_normals


def test_influences_rebuild_the_weights(clip):
    joint_ids, weights = clip.influences()
    dense = np.zeros((clip.mesh.vertex_count, clip.rig.joint_count))
    np.add.at(dense, (np.arange(len(dense))[:, None], joint_ids), weights)
    np.testing.assert_allclose(dense, clip.rig.weights.toarray(), atol=1e-7)


def test_quaternions_do_not_flip_between_frames(clip):
    assert ((clip.quaternions[1:] * clip.quaternions[:-1]).sum(-1) > 0).all()


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
