"""The weights of a correctives model, and the file that holds them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.cache import atomic_write
from soma_core.correctives.features import local_bind_rotations
from soma_core.errors import AssetError
from soma_core.rig.skeleton import Rig
from soma_core.stored_matrix import StoredMatrix
from soma_core.tensor_archive import read_tensor_archive
from soma_core.topology.frames import METRES, METRES_PER_UNIT

__all__ = [
    "CorrectiveWeights",
    "check_bind_pose",
    "read_weights",
    "write_tensors",
    "write_weights",
]

_METRES = METRES_PER_UNIT | METRES
_KEYS = ("C_max", "use_tanh", "bindpose", "W1", "W2", "M1_mask", "M2_mask", "meta")
_MOST_ENTRIES = 2**24
"""Of a stage; the shipped second one has 1.2 million."""

_BIND_TOLERANCE = 1e-3
"""Correctives of a rig whose bind pose differs by more are those of another rig."""

_TRAIN = "Train them for this rig with `soma train-correctives`, or pass correctives=None."


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectiveWeights:
    """A two-stage model: ``offsets = tanh(relu(f W1)) W2``, masks multiplied in.

    Attributes:
        channels: activations a joint, C.
        use_tanh: whether activations saturate.
        bind_pose: local bind rotations (J, 3, 3) of the rig the model belongs to.
        first: W1 (6 J, J C), zero outside `joint_mask`.
        second: W2 (J C, 3 V) [m], V vertices of the mid LOD, zero outside `vertex_mask`; columns 3 v + axis.
        joint_mask: M1 (J, J), row i, column j: the activations of joint j may read joint i.
        vertex_mask: M2 (J, V), row j, column v: the activations of joint j may move vertex v.
        meta: how it was made.
    """

    channels: int
    use_tanh: bool
    bind_pose: np.ndarray
    first: scipy.sparse.csr_array
    second: scipy.sparse.csr_array
    joint_mask: scipy.sparse.csr_array
    vertex_mask: scipy.sparse.csr_array
    meta: Mapping[str, Any] = field(default_factory=dict)

    @property
    def vertex_count(self) -> int:
        """Vertices of the mid LOD."""
        return self.second.shape[1] // 3


def write_weights(path: Path, weights: CorrectiveWeights) -> None:
    """Write a checkpoint that ``torch.load(weights_only=True)`` opens: centimetres, W2 in half precision.

    W2 is stored in blocks of one vertex, which halves the ids; the file is written atomically.
    """
    pairs = scipy.sparse.bsr_array(weights.second, blocksize=(1, 3))
    content = {
        "C_max": weights.channels,
        "use_tanh": weights.use_tanh,
        "bindpose": torch.as_tensor(weights.bind_pose.astype(np.float32)),
        "W1": _stored(weights.first.astype(np.float32)),
        "W2": _quiet(
            torch.sparse_bsr_tensor, torch.as_tensor(pairs.indptr.astype(np.int32)),
            torch.as_tensor(pairs.indices.astype(np.int32)),
            torch.as_tensor((100 * pairs.data).astype(np.float16)), size=pairs.shape,
        ),
        "M1_mask": _stored(weights.joint_mask.astype(np.uint8)),
        "M2_mask": _stored(weights.vertex_mask.astype(np.uint8)),
        "unit": "centimeters",
        "meta": dict(weights.meta),
    }  # fmt: skip
    write_tensors(Path(path), content)


def write_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Write what ``torch.load(weights_only=True)`` reads, atomically and under any name."""

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as stream:  # torch itself refuses names without a suffix
            torch.save(dict(content), stream)

    atomic_write(path, write)


def _stored(matrix: scipy.sparse.csr_array) -> Tensor:
    matrix = matrix.tocsr().sorted_indices()
    starts, columns = (torch.as_tensor(ids.astype(np.int32)) for ids in (matrix.indptr, matrix.indices))
    return _quiet(torch.sparse_csr_tensor, starts, columns, torch.as_tensor(matrix.data), size=matrix.shape)


def _quiet(make: Any, *arguments: Any, **options: Any) -> Any:
    """Make sparse tensors with their indices checked, without torch's warning that they are in beta."""
    with warnings.catch_warnings(), torch.sparse.check_sparse_tensor_invariants():
        warnings.filterwarnings("ignore", message="Sparse .* tensor support is in beta", category=UserWarning)
        return make(*arguments, **options)


def read_weights(path: Path | str) -> CorrectiveWeights:
    """Read a checkpoint; nothing in it is executed. Matrices may be sparse, in any layout, or dense.

    Weights are multiplied by their masks, so that nothing outside a mask can move.

    Raises:
        AssetError: missing, damaged, without a key, or with shapes that do not belong together.
    """
    content = read_tensor_archive(path, fix=_TRAIN, sparse=StoredMatrix.csr)
    missing = [key for key in _KEYS if not isinstance(content, dict) or key not in content]
    if missing:
        raise _refusal(path, f"without the keys {', '.join(missing)}")
    unit = content.get("unit", "centimeters")
    if type(unit) is not str or unit not in _METRES:
        raise _refusal(path, f"in the unit {unit!r}, which is none of {', '.join(_METRES)}")
    try:
        return _assembled(content, _METRES[unit])
    except (ValueError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise _refusal(path, str(error)[:200]) from error


def _refusal(path: Path | str, cause: str) -> AssetError:
    return AssetError(path, cause=cause, fix=_TRAIN)


def _assembled(content: Mapping[str, Any], metres: float) -> CorrectiveWeights:
    """Check the shapes and multiply the masks in; ValueError says what does not fit."""
    channels, bind = int(content["C_max"]), np.asarray(content["bindpose"], np.float64)
    joints = len(bind)
    if not np.isfinite(bind).all():
        raise ValueError("bindpose holds numbers that are not finite")
    joint_mask, vertex_mask = (_matrix(content[key], key) for key in ("M1_mask", "M2_mask"))
    first, second = _matrix(content["W1"], "W1"), _matrix(content["W2"], "W2")
    expected: dict[str, tuple[tuple[int, ...], list[tuple[int, ...]]]] = {
        "bindpose": (bind.shape, [(joints, 3, 3), (joints, 4, 4)]),
        "M1_mask": (joint_mask.shape, [(joints, joints)]),
        "M2_mask": (vertex_mask.shape, [(joints, second.shape[1] // 3)]),
        "W1": (first.shape, [(6 * joints, joints * channels)]),
        "W2": (second.shape, [(joints * channels, 3 * (second.shape[1] // 3))]),
    }
    for key, (got, allowed) in expected.items():
        if got not in allowed:
            raise ValueError(f"{key} of shape {got}, expected {' or '.join(map(str, allowed))}")
    return CorrectiveWeights(
        channels=channels,
        use_tanh=bool(content["use_tanh"]),
        bind_pose=bind[:, :3, :3],
        first=_masked(first, joint_mask, (6, channels)),
        second=metres * _masked(second, vertex_mask, (channels, 3)),
        joint_mask=joint_mask,
        vertex_mask=vertex_mask,
        meta=content["meta"] if isinstance(content["meta"], dict) else {},
    )


def _masked(
    matrix: scipy.sparse.csr_array, mask: scipy.sparse.csr_array, block: tuple[int, int]
) -> scipy.sparse.csr_array:
    """Multiply `matrix` by `mask`, each entry of which stands for a block of so many rows and columns."""
    entries, known = matrix.tocoo(), mask.sorted_indices().tocoo()
    keys = known.row.astype(np.int64) * mask.shape[1] + known.col
    wanted = (entries.row // block[0]).astype(np.int64) * mask.shape[1] + entries.col // block[1]
    place = np.searchsorted(keys, wanted).clip(max=max(len(keys) - 1, 0))
    inside = keys[place] == wanted if len(keys) else np.zeros(len(wanted), bool)
    values = np.where(inside, entries.data * known.data[place], 0.0) if len(keys) else entries.data * 0
    found = scipy.sparse.csr_array((values, (entries.row, entries.col)), shape=matrix.shape)
    found.eliminate_zeros()
    return found


def _matrix(stored: Any, key: str) -> scipy.sparse.csr_array:
    """A stored matrix as float64 CSR."""
    if not isinstance(stored, scipy.sparse.csr_array):
        stored = _sparse(stored, key)
    found = scipy.sparse.csr_array(stored, dtype=np.float64)
    if not np.isfinite(found.data).all():
        raise ValueError(f"{key} holds numbers that are not finite")
    found.eliminate_zeros()
    return found


def _sparse(dense: Any, key: str) -> scipy.sparse.csr_array:
    if not isinstance(dense, np.ndarray) or dense.ndim != 2 or dense.dtype.kind not in "fiub":
        raise ValueError(f"{key} is no matrix of numbers")
    if np.count_nonzero(dense) > _MOST_ENTRIES:
        raise ValueError(f"{key} holds more than {_MOST_ENTRIES} numbers other than zero")
    place = np.nonzero(dense)
    return scipy.sparse.csr_array((dense[place].astype(np.float64), place), shape=dense.shape)


def check_bind_pose(path: Path | str, weights: CorrectiveWeights, rig: Rig) -> None:
    """Refuse correctives of another rig: they would be wrong without a sign of it.

    Raises:
        AssetError: another number of joints, or a local bind rotation that differs by more than 1e-3.
    """
    own = local_bind_rotations(rig)
    if len(weights.bind_pose) != len(own):
        raise _refusal(path, f"for {len(weights.bind_pose)} joints, this rig has {len(own)}")
    apart = np.abs(weights.bind_pose - own).max((1, 2))
    worst = int(apart.argmax())
    if apart[worst] > _BIND_TOLERANCE:
        name = rig.joint_names[worst]
        raise _refusal(path, f"made for another bind pose: that of {name} differs by {apart[worst]:.3g}")
