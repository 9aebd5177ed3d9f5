"""Who adds to whom in a patch of the mesh: the transposed tables of ``kernels.patches``.

A patch sums what its vertices pull at each of its transforms and activations. A transform has lists of at
most 32 vertices, so that no thread walks a long one; an activation has one, and 32 activations lay theirs out
side by side. Each list ends in cells of the patch's sums; behind them come the lists of cells that add up to
a transform or an activation of the whole mesh.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse
import torch

from soma_core.kernels.patches import Patches, side_by_side, triples

__all__ = ["ResidualPatches", "joint_lists"]

_LONGEST = 32
"""Vertices of one list of a transform."""
_SLICE = 32


class ResidualPatches(torch.nn.Module):
    """Tables of ``kernels.patch_residual_wp``, constant buffers.

    Args:
        skin: (v, T) weights.
        moves: (3 v, C) offsets, the three rows of a vertex together.

    Attributes:
        fits: whether the mesh fits into patches; if not, there are no tables.
        patches: of the way from activations and transforms to vertices.
        joint_count: T.
        cell_count: numbers that a frame sums in all patches: first an energy of each, then twelve for each
            list of a transform, then one for each activation of a patch.
    """

    starts: torch.Tensor
    vertices: torch.Tensor
    values: torch.Tensor
    items: torch.Tensor
    cells: torch.Tensor

    def __init__(
        self, skin: scipy.sparse.csr_array, moves: scipy.sparse.csr_array, *, dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:  # fmt: skip
        super().__init__()
        skin, activations = skin.tocsr().sorted_indices(), moves.shape[1]
        self.patches = Patches(skin, moves if activations else None, dtype=dtype, device=device)
        self.fits, self.joint_count = self.patches.fits, skin.shape[1]
        if not self.fits:
            return
        bounds = self.patches.bounds
        vertex = np.repeat(np.arange(skin.shape[0]), np.diff(skin.indptr))
        runs = joint_lists(bounds, vertex, skin.indices)
        pulls = _activation_lists(bounds, moves)
        count, rows = len(bounds) - 1, len(runs["joint"])
        self.cell_count = count + 12 * rows + len(pulls["activation"])
        starts = np.concatenate((runs["patch_start"], runs["start"], pulls["patch_start"], pulls["start"]))
        items, cells = _cells(count, runs["joint"], self.joint_count, pulls["activation"], activations)
        tables = {
            "starts": (starts, torch.int32),
            "vertices": (np.concatenate((runs["vertex"], pulls["vertex"])), torch.int16),
            "values": (np.concatenate((skin.data[runs["entry"]], pulls["planes"])), dtype),
            "items": (items, torch.int32),
            "cells": (cells, torch.int32),
        }
        for name, (array, kind) in tables.items():
            self.register_buffer(name, torch.as_tensor(array).to(device, kind), persistent=False)


def _runs(patch: np.ndarray, owner: np.ndarray, size: int) -> tuple[np.ndarray, ...]:
    """Entries by patch and owner: order of the entries, first entry, length, patch and owner of each run."""
    key = patch * size + owner
    order = np.argsort(key, kind="stable")
    names, first, length = np.unique(key[order], return_index=True, return_counts=True)
    return order, first, length, names // size, names % size


def _flat(first: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Numbers first .. first + length of each run, one run behind the other."""
    return np.repeat(first - np.cumsum(length) + length, length) + np.arange(length.sum())


def joint_lists(bounds: np.ndarray, vertex: np.ndarray, joint: np.ndarray) -> dict[str, np.ndarray]:
    """Lists of transforms, the longest of a patch first, so that threads side by side walk alike ones.

    Args:
        bounds: first vertex of each patch, and the vertex count behind.
        vertex, joint: of each influence.

    Returns:
        ``patch_start``, first list of each patch; ``start`` of each list in what follows; ``entry``, the
        influence, and ``vertex``, within its patch; ``joint`` of each list.
    """
    home = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))[vertex]
    order, first, length, patch, joint = _runs(home, joint.astype(np.int64), int(joint.max(initial=0)) + 1)
    # A run is cut into pieces that differ by one vertex at most.
    pieces = -(-length // _LONGEST)
    run = np.repeat(np.arange(len(length)), pieces)
    step = np.arange(len(run)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    begin, end = (length[run] * at // pieces[run] for at in (step, step + 1))
    begin, size, patch, joint = first[run] + begin, end - begin, patch[run], joint[run]
    by_size = np.lexsort((-size, patch))
    begin, size, patch, joint = (one[by_size] for one in (begin, size, patch, joint))
    entry = order[_flat(begin, size)]
    return {
        "patch_start": np.searchsorted(patch, np.arange(len(bounds))),
        "start": np.concatenate(([0], np.cumsum(size))),
        "entry": entry,
        "vertex": vertex[entry] - bounds[home[entry]],
        "joint": joint,
    }


def _activation_lists(bounds: np.ndarray, moves: scipy.sparse.csr_array) -> dict[str, np.ndarray]:
    """Lists of activations side by side, the longest of a patch first; a patch has slices of its own."""
    starts, activation, values = triples(moves)
    vertex = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    home = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))[vertex]
    order, first, length, patch, owner = _runs(home, activation, max(moves.shape[1], 1))
    by_size = np.lexsort((-length, patch))
    first, length, patch, owner = (one[by_size] for one in (first, length, patch, owner))
    entry = order[_flat(first, length)]
    patch_start = np.searchsorted(patch, np.arange(len(bounds)))
    rows = [
        np.append(np.arange(a, b), np.full((a - b) % _SLICE, -1))
        for a, b in itertools.pairwise(patch_start)
    ]  # fmt: skip
    start, vertices, moved = side_by_side(
        np.concatenate(([0], np.cumsum(length))), (vertex - bounds[home])[entry], values[entry],
        np.concatenate(rows).astype(np.int64),
    )  # fmt: skip
    return {
        "patch_start": np.concatenate(([0], np.cumsum([len(part) // _SLICE for part in rows]))),
        "start": start,
        "vertex": vertices,
        # Each slice holds a plane of x, y and z for every step.
        "planes": moved.reshape(-1, _SLICE, 3).transpose(0, 2, 1).ravel(),
        "activation": owner,
    }


def _cells(
    patches: int, joint: np.ndarray, joints: int, activation: np.ndarray, activations: int
) -> tuple[np.ndarray, np.ndarray]:
    """First cells of what adds up to each item: the energy, the transforms, the activations."""
    item = np.concatenate((np.zeros(patches, np.int64), 1 + joint, 1 + joints + activation))
    cell = np.concatenate(
        (
            np.arange(patches),
            patches + 12 * np.arange(len(joint)),
            patches + 12 * len(joint) + np.arange(len(activation)),
        )
    )
    order = np.argsort(item, kind="stable")
    return np.searchsorted(item[order], np.arange(joints + activations + 2)), cell[order]
