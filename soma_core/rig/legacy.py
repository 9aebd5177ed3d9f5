"""Old ``SOMA_neutral.npz`` files, which carried the rig beside the shape space."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse

from soma_core.errors import AssetError
from soma_core.rig.neutral import read_arrays
from soma_core.rig.skeleton import Rig
from soma_core.rig.stored import StoredRig, refuse_bad_weights

__all__ = ["read_legacy_rig"]

_RIG_KEYS = (
    "joint_names",
    "joint_parent_ids",
    "bind_pose_world",
    "t_pose_world",
    "bind_shape",
    "skinning_weights_data",
    "skinning_weights_indices",
    "skinning_weights_indptr",
    "skinning_weights_shape",
    "triangles",
)


def _parents(path: Path, stored: np.ndarray) -> np.ndarray:
    """Parents with -1 for the root, which old files also wrote as itself or as 2**32 - 1."""
    parents = stored.astype(np.int64)
    parents[(parents == np.arange(len(parents))) | (parents == 2**32 - 1)] = -1
    if not len(parents) or parents.min() < -1 or (parents >= np.arange(len(parents))).any():
        cause = f"joint_parent_ids are {stored.tolist()[:5]}..., expected parents before children"
        raise AssetError(path, cause=cause, fix="Take the rig from SOMA_template_rig.usda")
    return parents.astype(np.int32)


def read_legacy_rig(path: Path) -> Rig:
    """Read the rig of an old, fat ``SOMA_neutral.npz`` [cm] as a rig in metres.

    Raises:
        AssetError: unreadable file, missing rig keys (a slim file has none), shapes that do not
            fit, or bad skin weights.
    """
    arrays = read_arrays(path, _RIG_KEYS)
    names = tuple(str(name) for name in arrays["joint_names"])
    shape = tuple(int(size) for size in arrays["skinning_weights_shape"])
    matrices = (len(names), 4, 4)
    expected = (len(arrays["bind_shape"]), len(names))
    got = (arrays["bind_pose_world"].shape, arrays["t_pose_world"].shape, shape)
    if got != (matrices, matrices, expected) or len(arrays["joint_parent_ids"]) != len(names):
        cause = f"bind, T-pose and weights have shapes {got}, expected {(matrices, matrices, expected)}"
        raise AssetError(path, cause=cause, fix="Take the rig from SOMA_template_rig.usda")
    parts = (arrays[f"skinning_weights_{part}"] for part in ("data", "indices", "indptr"))
    weights = scipy.sparse.csr_array(scipy.sparse.csc_array(tuple(parts), shape=shape), dtype=np.float64)
    weights.eliminate_zeros()
    refuse_bad_weights(path, weights)
    stored = StoredRig(
        joint_names=names,
        parents=_parents(path, arrays["joint_parent_ids"]),
        bind_world=arrays["bind_pose_world"].astype(np.float64),
        t_pose_world=arrays["t_pose_world"].astype(np.float64),
        bind_shape=arrays["bind_shape"].astype(np.float64),
        weights=weights,
    )
    return stored.metric(stored.digest(arrays["triangles"]))
