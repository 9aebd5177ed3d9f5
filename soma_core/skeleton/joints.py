"""Stage 1 of the skeleton fit: joint positions as one sparse linear map (paper, section 3.4.1)."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import scipy.sparse

from soma_core.cache import cached_arrays, content_key
from soma_core.geometry.rbf import affine_rbf_weights
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["joint_neighbourhoods", "joint_regressor"]

_CODE_VERSION = "2"


def joint_neighbourhoods(mesh: CanonicalMesh, rig: Rig) -> list[np.ndarray]:
    """Vertex ids that carry each joint; the root's list is empty.

    The crease around a joint: vertices weighted to the joint *and* its parent; if there are none, those
    of the joint; if still none, those of its ancestors, nearest first; at last all. Never the face interior.
    """
    weighted = (rig.weights.toarray() > 0) if rig.weights.nnz else np.zeros(rig.weights.shape, bool)
    interior = np.zeros(mesh.vertex_count, bool)
    interior[mesh.face_interior] = True
    weighted[interior] = False
    result = [np.empty(0, np.int64)]
    for joint in range(1, rig.joint_count):
        parent = int(rig.parents[joint])
        chosen = weighted[:, joint] & weighted[:, parent]
        if not chosen.any():
            chosen = weighted[:, joint].copy()
        while not chosen.any() and parent >= 0:
            chosen |= weighted[:, parent]
            parent = int(rig.parents[parent])
        result.append(np.flatnonzero(chosen if chosen.any() else ~interior))
    return result


def _build(mesh: CanonicalMesh, rig: Rig) -> dict[str, np.ndarray]:
    groups: dict[bytes, list[int]] = defaultdict(list)
    neighbourhoods = joint_neighbourhoods(mesh, rig)
    for joint in range(1, rig.joint_count):
        groups[neighbourhoods[joint].tobytes()].append(joint)
    rows, columns, values = [], [], []
    for joints in groups.values():  # joints on the same crease share one factorisation
        ids = neighbourhoods[joints[0]]
        weights = affine_rbf_weights(rig.bind_shape[ids], rig.bind_world[joints, :3, 3])
        for joint, row in zip(joints, weights, strict=True):
            rows.append(np.full(len(ids), joint))
            columns.append(ids)
            values.append(row)
    matrix = scipy.sparse.csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(rig.joint_count, mesh.vertex_count),
    )
    return {"data": matrix.data, "indices": matrix.indices, "indptr": matrix.indptr}


def joint_regressor(mesh: CanonicalMesh, rig: Rig) -> scipy.sparse.csr_array:
    """Matrix W (J, v) with ``joints = W @ vertices``; exact at the bind shape and all its affine images.

    Rows sum to one except the root's, which is empty: the root is pinned to the origin. Cached on disk
    by rig revision. Paper, equation 3 for each joint, and equation 4 for all of them.
    """
    weights = (rig.weights.data, rig.weights.indices, rig.weights.indptr)
    key = content_key(
        "joint_regressor", _CODE_VERSION, rig.revision, rig.bind_shape, rig.bind_world, rig.parents, *weights,
        mesh.face_interior,
    )  # fmt: skip
    arrays = cached_arrays("joint_regressor", key, lambda: _build(mesh, rig))
    return scipy.sparse.csr_array(
        (arrays["data"], arrays["indices"], arrays["indptr"]), shape=(rig.joint_count, mesh.vertex_count)
    )
