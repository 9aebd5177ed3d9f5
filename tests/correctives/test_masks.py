"""Masks: what a corrective listens to, and how far along the skin it reaches."""

import dataclasses

import numpy as np
import pytest

from soma_core.correctives.masks import geodesic_falloff, vertex_mask


def test_limbs_have_creases_and_the_face_has_none(body):
    found = {body.rig.joint_names[joint] for joint in body.creases.joints}
    assert {"LeftForeArm", "RightForeArm", "LeftShin", "Chest", "Head"} <= found
    assert not found & {"Root", "Hips", "HeadEnd", "Jaw", "LeftEye"}


def test_a_crease_is_shared_by_both_sides_of_its_joint(body):
    joint = body.rig.joint_names.index("LeftShin")
    names = [name for name in body.rig.joint_names if name.startswith(("LeftShin", "LeftFoot", "LeftToe"))]
    below = [body.rig.joint_names.index(name) for name in names]
    share = body.rig.weights[body.creases.vertices[joint]].toarray()[:, below].sum(1)
    assert (share > 0.05).all()
    assert (share < 0.95).all()


def test_activations_read_joints_at_most_two_bones_away(body):
    mask, names = body.masks.joints, body.rig.joint_names
    reads = {names[i] for i in np.flatnonzero(mask[:, names.index("LeftForeArm")])}
    assert {"LeftArm", "LeftForeArm", "LeftHand", "LeftShoulder"} <= reads
    assert not reads & {"Root", "Chest", "RightForeArm", "LeftLeg"}
    assert not mask[0].any()  # the root does not turn
    assert not mask[:, names.index("HeadEnd")].any()  # and what has no crease has no activations


def test_the_mask_falls_from_one_at_the_crease_to_zero(body):
    mask = body.masks.vertices
    assert mask.data.min() > 0
    assert mask.data.max() == 1
    joint = body.creases.joints[0]
    row = mask[[joint]].toarray()[0]
    kept = np.setdiff1d(body.creases.vertices[joint], body.mesh.face_interior)
    np.testing.assert_array_equal(row[kept], 1)
    assert not mask[:, body.mesh.face_interior].nnz


def test_distance_runs_along_the_skin(body):
    """The left leg's crease does not reach the right knee, however near the legs are."""
    names = body.rig.joint_names
    row = vertex_mask(body.mesh, body.rig, body.creases, reach=1.0)[[names.index("LeftShin")]].toarray()[0]
    assert (body.mesh.vertices[row > 0, 0] > 0).all()


def test_a_longer_reach_only_adds(body):
    near, far = (geodesic_falloff(body.mesh, body.creases, reach=reach) for reach in (1.0, 2.0))
    assert near.nnz < far.nnz
    assert (far - near).min() >= 0


def test_edges_of_polygons_close_their_loops(body):
    edges = body.mesh.edges()
    assert (edges[:, 0] < edges[:, 1]).all()
    faces, vertices = len(body.mesh.face_vert_counts), body.mesh.vertex_count
    assert vertices - len(edges) + faces == 2  # Euler's formula of a closed surface


@pytest.mark.parametrize("counts", [[3, 3], [4, 4]])
def test_edges_of_single_polygons(body, counts):
    mesh = dataclasses.replace(
        body.mesh, face_vert_indices=np.arange(sum(counts)), face_vert_counts=np.array(counts)
    )
    assert len(mesh.edges()) == sum(counts)
