"""Skin weights and corrective weights cut into patches of the mesh, as the fused kernel reads them.

A patch is up to 128 consecutive vertices, few enough to name the transforms and activations that they need
by short local ids. Its vertices are sorted by the length of their rows, and each 32 of them lay out their
rows side by side, padded to the longest: what 32 threads read together lies together.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import scipy.sparse
import torch

from soma_core.kernels._patch_text import PATCH_ACTIVATIONS, PATCH_JOINTS, PATCH_VERTICES

__all__ = ["Patches", "in_patches", "side_by_side", "triples"]

_SLICE = 32

_FITS_TRIED_ON_A_GPU = False
"""Whether a fit's kernels by patches have run on one; until then those of frames abreast, which have."""


def in_patches(tensor: torch.Tensor) -> bool:
    """Whether a fit goes patch by patch of the mesh, instead of frame by frame."""
    return tensor.is_cuda and _FITS_TRIED_ON_A_GPU


def side_by_side(
    starts: np.ndarray, ids: np.ndarray, values: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of a sparse matrix, 32 at a time, entry by entry with the rows next to each other.

    Args:
        starts, ids: (m + 1,) and (e,), of CSR.
        values: (e,) or (e, c).
        rows: those that are laid out, a multiple of 32; -1 is an empty one.

    Returns:
        Where each slice begins, (len(rows) / 32 + 1,); ids (n,) and values (n, ...), padded by zeros.
    """
    lengths = np.where(rows < 0, 0, np.diff(starts, append=starts[-1])[rows])
    widths = lengths.reshape(-1, _SLICE).max(1)
    slice_start = np.concatenate(([0], np.cumsum(widths * _SLICE))).astype(np.int64)
    out_ids = np.zeros(slice_start[-1], np.int64)
    out_values = np.zeros((slice_start[-1], *values.shape[1:]))
    place = np.arange(len(rows))
    row = np.repeat(place, lengths)
    step = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    source = np.repeat(starts[rows], lengths) + step
    target = slice_start[row // _SLICE] + step * _SLICE + row % _SLICE
    out_ids[target], out_values[target] = ids[source], values[source]
    return slice_start, out_ids, out_values


def triples(matrix: scipy.sparse.csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """CSR of (3 v, A) with x, y and z of each vertex together: starts (v + 1,), ids (e,), values (e, 3)."""
    entries = matrix.tocoo()
    vertex, axis = np.divmod(entries.row.astype(np.int64), 3)
    key, inverse = np.unique(vertex * matrix.shape[1] + entries.col, return_inverse=True)
    values = np.zeros((len(key), 3))
    values[inverse, axis] = entries.data
    counts = np.bincount(key // matrix.shape[1], minlength=matrix.shape[0] // 3)
    return np.concatenate(([0], np.cumsum(counts))), key % matrix.shape[1], values


class Patches(torch.nn.Module):
    """Tables of ``kernels.fused_pose_wp.skin_patches``, constant buffers.

    Args:
        weights: skin weights (v, T).
        second: weights (3 v, A) from activations to offsets, or None.

    Attributes:
        fits: whether every vertex's transforms and activations fit into a patch; if not, there are none.
        count: number of patches.
        bounds: first vertex of each patch, and the vertex count behind.
    """

    ints: torch.Tensor
    shorts: torch.Tensor
    reals: torch.Tensor

    def __init__(
        self, weights: scipy.sparse.csr_array, second: scipy.sparse.csr_array | None, *,
        dtype: torch.dtype, device: torch.device | str,
    ) -> None:  # fmt: skip
        super().__init__()
        weights = weights.tocsr().sorted_indices()
        empty = np.zeros(weights.shape[0] + 1, np.int64), np.empty(0, np.int64), np.empty((0, 3))
        moves = empty if second is None else triples(second)
        blends = weights.indptr.astype(np.int64), weights.indices.astype(np.int64), weights.data
        bounds = _bounds(blends, moves)
        self.fits, self.count = bounds is not None, 0
        if bounds is None:
            return
        self.count, self.bounds = len(bounds) - 1, bounds
        ints, shorts, reals = _tables(bounds, blends, moves)
        for name, array, kind in (
            ("ints", ints, torch.int32),
            ("shorts", shorts, torch.int16),
            ("reals", reals, dtype),
        ):
            self.register_buffer(name, torch.as_tensor(array).to(device, kind), persistent=False)


def _bounds(blends: Sequence[np.ndarray], moves: Sequence[np.ndarray]) -> np.ndarray | None:
    """First vertex of each patch, and the vertex count behind; None where one vertex is too much."""
    count, bounds = len(blends[0]) - 1, [0]
    while bounds[-1] < count:
        first, size = bounds[-1], min(PATCH_VERTICES, count - bounds[-1])
        while size:
            used = [
                len(np.unique(ids[starts[first] : starts[first + size]]))
                for starts, ids, _ in (blends, moves)
            ]
            if used[0] <= PATCH_JOINTS and used[1] <= PATCH_ACTIVATIONS:
                break
            size //= 2
        if not size:
            return None
        bounds.append(first + size)
    return np.array(bounds)


def _tables(
    bounds: np.ndarray, blends: Sequence[np.ndarray], moves: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integers, local ids and numbers, each table behind the other as the kernel's text reads them."""
    slots = np.full((len(bounds) - 1, PATCH_VERTICES), -1)
    lengths = np.diff(moves[0]) * PATCH_JOINTS + np.diff(blends[0])  # moves first: they are longer
    used: list[list[np.ndarray]] = [[], []]
    local = [np.empty_like(blends[1]), np.empty_like(moves[1])]
    for patch, (first, end) in enumerate(itertools.pairwise(bounds)):
        slots[patch, : end - first] = np.argsort(-lengths[first:end], kind="stable")
        for kind, (starts, ids, _) in enumerate((blends, moves)):
            part = slice(starts[first], starts[end])
            names, local[kind][part] = np.unique(ids[part], return_inverse=True)
            used[kind].append(names)
    rows = np.where(slots < 0, -1, slots + bounds[:-1, None]).ravel()
    blend_start, blend_id, blend_value = side_by_side(blends[0], local[0], blends[2], rows)
    move_start, move_id, move_value = side_by_side(moves[0], local[1], moves[2], rows)
    starts = [np.concatenate(([0], np.cumsum([len(names) for names in part]))) for part in used]
    ints = (bounds, starts[1], starts[0], move_start, blend_start)
    shorts = (slots.ravel(), *used[1], *used[0], move_id, blend_id)
    # Each slice holds a plane of x, y and z for every step.
    planes = move_value.reshape(-1, _SLICE, 3).transpose(0, 2, 1).ravel()
    return np.concatenate(ints), np.concatenate(shorts), np.concatenate((planes, blend_value))
