"""Skin weights of a mesh as USD and glTF hold them: so many influences for every vertex."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse

from soma_core.errors import AssetError
from soma_core.rig.stored import refuse_bad_weights

if TYPE_CHECKING:
    from pxr import Usd

__all__ = ["padded_influences", "read_weights"]


def _joint_map(path: Path, skin: Usd.Prim, joint_paths: Sequence[str]) -> np.ndarray:
    """Skeleton joint of each entry of the mesh's own ``skel:joints`` (all joints when absent)."""
    from pxr import UsdSkel

    subset = UsdSkel.BindingAPI(skin).GetJointsAttr().Get()
    if not subset:
        return np.arange(len(joint_paths))
    index = {joint: position for position, joint in enumerate(joint_paths)}
    unknown = [joint for joint in subset if joint not in index]
    if unknown:
        cause = f"skel:joints of {skin.GetPath()} names {len(unknown)} unknown joints, first {unknown[0]}"
        raise AssetError(path, cause=cause, fix="Use the joint paths of the skeleton")
    return np.array([index[joint] for joint in subset])


def _per_vertex(path: Path, skin: Usd.Prim, name: str, vertex_count: int) -> np.ndarray:
    """One influence primvar as (v, k)."""
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(skin).GetPrimvar(name)
    values = np.array(primvar.Get() if primvar and primvar.HasValue() else [])
    width = primvar.GetElementSize() if primvar else 1
    if primvar and primvar.GetInterpolation() == "constant" and len(values) == width:
        return np.broadcast_to(values, (vertex_count, width))  # a rigidly bound mesh
    if len(values) != vertex_count * width:
        cause = (
            f"{name} of {skin.GetPath()} holds {len(values)} values, "
            f"expected {vertex_count} points times elementSize {width}"
        )
        raise AssetError(path, cause=cause, fix="Export the skin weights again")
    return values.reshape(vertex_count, width)


def read_weights(
    path: Path, skin: Usd.Prim, joint_paths: Sequence[str], vertex_count: int
) -> scipy.sparse.csr_array:
    """Read skin weights as stored: (v, J) CSR float64, zeros dropped, joints in skeleton order.

    Raises:
        AssetError: unknown joints, wrong counts, indices out of range, or weights that are
            negative, not finite or do not sum to 1.
    """
    joints = _joint_map(path, skin, joint_paths)
    indices = _per_vertex(path, skin, "skel:jointIndices", vertex_count)
    values = _per_vertex(path, skin, "skel:jointWeights", vertex_count).astype(np.float64)
    if indices.shape != values.shape:
        cause = f"jointIndices and jointWeights have elementSize {indices.shape[1]} and {values.shape[1]}"
        raise AssetError(path, cause=cause, fix="Export the skin weights again")
    used = values != 0
    outside = used & ((indices < 0) | (indices >= len(joints)))
    if outside.any():
        cause = f"jointIndices holds {int(indices[outside][0])}, but the mesh has {len(joints)} joints"
        raise AssetError(path, cause=cause, fix="Export the skin weights again")
    rows = np.nonzero(used)[0]
    entries = (values[used], (rows, joints[indices[used]]))
    weights = scipy.sparse.csr_array(scipy.sparse.coo_array(entries, shape=(vertex_count, len(joint_paths))))
    refuse_bad_weights(path, weights)
    return weights


def padded_influences(weights: scipy.sparse.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Joints (v, k) int64 and weights (v, k) float64 of every influence, heaviest first, zero padded."""
    counts = np.diff(weights.indptr)
    rows = np.repeat(np.arange(len(counts)), counts)
    order = np.lexsort((-weights.data, rows))
    slots = np.arange(len(rows)) - np.repeat(weights.indptr[:-1], counts)
    joints = np.zeros((len(counts), int(counts.max())), np.int64)
    values = np.zeros(joints.shape)
    joints[rows, slots], values[rows, slots] = weights.indices[order], weights.data[order]
    return joints, values
