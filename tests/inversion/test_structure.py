"""Which joints share vertices: nothing of the skin weights is lost or invented."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from soma_core.rig import load_canonical
from tests.bodies import tiny_canonical
from tests.inversion.small_problem import canonical_structure


@pytest.fixture(scope="module", params=["synthetic", "low"])
def body(request):
    mesh, rig = tiny_canonical() if request.param == "synthetic" else load_canonical("low")
    return mesh, rig, canonical_structure(mesh, rig)


def fitted_weights(mesh, rig):
    """Skin weights (v, J) by definition: none in the face interior, none too small to move a vertex."""
    weights = rig.skin.toarray()
    weights[mesh.face_interior] = 0
    return weights


def test_influences_are_the_skin_weights_outside_the_face_interior(body):
    mesh, rig, structure = body
    weights = np.zeros((mesh.vertex_count, rig.joint_count))
    joint = structure.joints[structure.influence_joint]
    np.add.at(weights, (structure.influence_vertex, joint), structure.influence_weight)
    np.testing.assert_array_equal(weights, fitted_weights(mesh, rig))
    assert len(structure.influence_joint) == np.count_nonzero(weights)
    assert (np.diff(structure.influence_joint) >= 0).all()
    np.testing.assert_array_equal(np.flatnonzero(~structure.fitted), mesh.face_interior)


def test_joints_are_those_with_weight_and_variables_those_with_weight_below(body):
    mesh, rig, structure = body
    weights = fitted_weights(mesh, rig)
    np.testing.assert_array_equal(structure.joints, np.flatnonzero(weights.any(0)))
    below = structure.ancestors.astype(float) @ weights.sum(0)
    np.testing.assert_array_equal(structure.variables, np.flatnonzero(below > 0)[1:])
    assert structure.variables[0] == 1


def test_ancestors_are_the_chains_to_the_root(body):
    _, rig, structure = body
    for joint in range(rig.joint_count):
        chain, step = set(), joint
        while step >= 0:
            chain.add(step)
            step = rig.parents[step]
        assert set(np.flatnonzero(structure.ancestors[:, joint])) == chain


def test_pairs_are_the_joints_that_share_vertices(body):
    mesh, rig, structure = body
    weights = fitted_weights(mesh, rig)[:, structure.joints] > 0
    shared = weights.T.astype(int) @ weights
    first, second = np.nonzero(np.triu(shared))
    np.testing.assert_array_equal(structure.pairs, np.stack((first, second), 1))
    counts = np.bincount(structure.pair_entry, minlength=len(first))
    np.testing.assert_array_equal(counts, shared[first, second])


def test_pair_influences_meet_at_one_vertex(body):
    _, _, structure = body
    assert (np.diff(structure.pair_entry) >= 0).all()
    pair = structure.pairs[structure.pair_entry]
    for side in (0, 1):
        influence = structure.pair_influences[:, side]
        np.testing.assert_array_equal(structure.influence_joint[influence], pair[:, side])
    vertex = structure.influence_vertex[structure.pair_influences]
    np.testing.assert_array_equal(vertex[:, 0], vertex[:, 1])
    assert len(np.unique(np.column_stack((structure.pair_entry, vertex[:, 0])), axis=0)) == len(vertex)


def test_the_shipped_rig_has_few_pairs():
    """The counts behind a step of constant cost; eyes and finger ends carry no weight."""
    mesh, rig = load_canonical("low")
    structure = canonical_structure(mesh, rig)
    assert (len(structure.variables), len(structure.pairs)) == (62, 312)
    without = set(range(rig.joint_count)) - set(structure.variables) - {0}
    assert all(rig.joint_names[joint].endswith(("End", "Eye")) for joint in without)


def test_stored_zeros_and_weights_of_the_face_interior_are_no_influences():
    mesh, rig = tiny_canonical()
    weights = rig.weights.tocoo()
    jaw = rig.joint_names.index("LeftEye")
    bag = mesh.face_interior[0]
    stored = scipy.sparse.coo_array(
        (
            np.concatenate([weights.data, [0.0, 0.5]]),
            (np.concatenate([weights.row, [0, bag]]), np.concatenate([weights.col, [jaw, jaw]])),
        ),
        shape=weights.shape,
    ).tocsr()
    changed = canonical_structure(mesh, replace(rig, weights=stored))
    reference = canonical_structure(mesh, rig)
    assert jaw not in changed.joints
    np.testing.assert_array_equal(changed.influence_vertex, reference.influence_vertex)
    np.testing.assert_array_equal(changed.pairs, reference.pairs)
