"""The rig hash: one name for everything that decides what a pose means."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import scipy.sparse

__all__ = ["REVISION_DIGITS", "lod_revision", "rig_hash"]

REVISION_DIGITS = 16


def rig_hash(
    *,
    joint_names: Sequence[str],
    parents: np.ndarray,
    bind_world: np.ndarray,
    t_pose_world: np.ndarray,
    bind_shape: np.ndarray,
    weights: scipy.sparse.sparray,
    triangles: np.ndarray,
) -> str:
    """Hash a rig as its file states it, before rotations are projected or weights normalised.

    SHA-256 over joint names (UTF-8, joined by newlines), parents (int32), bind world and T-pose
    world matrices (float32, column vectors, cm), bind vertices (float32, cm), the non-zero skin
    weights as (int32 vertex, int32 joint, float32) sorted by vertex and joint, and triangles
    (int32); all little-endian.

    Returns:
        64 hex digits; the first `REVISION_DIGITS` are the revision.
    """
    entries = scipy.sparse.coo_array(weights)
    entries.sum_duplicates()
    vertex, joint = entries.coords
    order = np.lexsort((joint, vertex))
    order = order[entries.data[order] != 0]
    triples = np.empty(len(order), [("vertex", "<i4"), ("joint", "<i4"), ("weight", "<f4")])
    triples["vertex"], triples["joint"], triples["weight"] = vertex[order], joint[order], entries.data[order]
    digest = hashlib.sha256("\n".join(joint_names).encode("utf-8"))
    for array, kind in (
        (parents, "<i4"),
        (bind_world, "<f4"),
        (t_pose_world, "<f4"),
        (bind_shape, "<f4"),
        (triples, triples.dtype),
        (triangles, "<i4"),
    ):
        digest.update(np.ascontiguousarray(array, kind).tobytes())
    return digest.hexdigest()


def lod_revision(full_hash: str, lod: str) -> str:
    """Shorten a rig hash; a level derived from mid keeps its parent's digits and adds its name."""
    short = full_hash[:REVISION_DIGITS]
    return short if lod == "mid" else f"{short}-{lod}"
