"""The second stage in closed form: given the activations, offsets are linear least squares."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

__all__ = ["Entries", "Normal", "accumulate", "all_entries", "pruned", "solve", "to_matrix"]

_MOST = 2_000_000
"""Numbers in the matrices that are factored at a time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entries:
    """Candidate entries of W2, sorted by vertex: activation k moves vertex v.

    Attributes:
        vertex, activation: (e,).
        penalty: (e,) one over the squared mask: what is far from a crease is held near zero.
        cross: (e, 3) sum over poses of activation times target [cm].
    """

    vertex: np.ndarray
    activation: np.ndarray
    penalty: np.ndarray
    cross: np.ndarray

    def part(self, chosen: np.ndarray) -> Entries:
        """Some of them."""
        return Entries(
            vertex=self.vertex[chosen],
            activation=self.activation[chosen],
            penalty=self.penalty[chosen],
            cross=self.cross[chosen],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Normal:
    """Sums over all poses: Gram matrix of the activations (k, k), and products with targets where M2 allows.

    ``cross`` holds one (n_j, C, 3) array a joint.
    """

    gram: Tensor
    cross: list[Tensor]


def accumulate(
    samples: Iterable[tuple[Tensor, Tensor]], sizes: list[int], vertices: Tensor, channels: int
) -> Normal:
    """Add up the normal equations of all poses; no product over all vertices is formed.

    Args:
        samples: activations (a, B, C) and targets (B, v, 3) [cm] of batches.
        sizes: number of vertices that each of the a joints moves.
        vertices: (p,) those vertices, joint by joint.
        channels: C.
    """
    count = len(sizes) * channels
    gram = torch.zeros(count, count, dtype=torch.float64)
    cross = [torch.zeros(channels, 3 * size, dtype=torch.float64) for size in sizes]
    parts = vertices.split(sizes)
    for active, targets in samples:
        flat = active.transpose(0, 1).flatten(1)
        gram += (flat.T @ flat).double()
        for joint, ids in enumerate(parts):
            cross[joint] += (active[joint].T @ targets[:, ids].flatten(1)).double()
    shaped = [block.view(channels, -1, 3).transpose(0, 1) for block in cross]
    return Normal(gram=gram, cross=shaped)


def all_entries(
    normal: Normal, vertices: np.ndarray, sizes: list[int], strength: np.ndarray, channels: int
) -> Entries:
    """Every entry that the mask allows."""
    joint = np.repeat(np.arange(len(sizes)), sizes)
    order = np.lexsort((joint, vertices))
    cross = torch.cat(normal.cross).numpy()[order].reshape(-1, 3)
    activation = channels * joint[order][:, None] + np.arange(channels)
    return Entries(
        vertex=np.repeat(vertices[order], channels),
        activation=activation.ravel(),
        penalty=np.repeat(strength[order] ** -2.0, channels),
        cross=cross,
    )


def solve(gram: Tensor, entries: Entries, *, ridge: float) -> np.ndarray:
    """Values (e, 3) [cm] that minimise the squared error of every vertex, each on its own entries.

    Args:
        gram: (k, k) of the activations.
        entries: sorted by vertex.
        ridge: weight of the penalty, in units of the mean of the Gram matrix's diagonal.
    """
    starts = np.flatnonzero(np.diff(entries.vertex, prepend=-1))
    counts = np.diff(np.append(starts, len(entries.vertex)))
    values = np.zeros_like(entries.cross)
    base = ridge * float(gram.diagonal().mean())
    order, first = np.argsort(counts, kind="stable"), 0
    while first < len(order):
        most = max(1, _MOST // int(counts[order[first]] + 16) ** 2)
        rows = order[first : first + most]
        rows = rows[counts[rows] <= counts[rows[0]] + 16]  # padding stays short
        first += len(rows)
        place = starts[rows][:, None] + np.arange(counts[rows].max())
        real = np.arange(place.shape[1]) < counts[rows][:, None]
        place = np.where(real, place, starts[rows][:, None])
        ids, there = torch.as_tensor(entries.activation[place]), torch.as_tensor(real)
        system = gram[ids[:, :, None], ids[:, None, :]] * (there[:, :, None] & there[:, None, :])
        penalty = torch.where(there, base * torch.as_tensor(entries.penalty[place]), 1.0)
        system.diagonal(dim1=1, dim2=2).add_(penalty)
        right = torch.as_tensor(entries.cross[place]) * there[..., None]
        found = torch.cholesky_solve(right, torch.linalg.cholesky(system))
        values[place[real]] = found[there].numpy()
    return values


def pruned(gram: Tensor, entries: Entries, *, ridge: float, budget: int) -> tuple[Entries, np.ndarray]:
    """Keep the `budget` entries that matter most, and solve again on those.

    What an entry contributes is its value times the root of its activation's second moment. Twice as many
    are kept at first, so that the second choice is made among values that fit.
    """
    for allowed in (2 * budget, budget):
        values = solve(gram, entries, ridge=ridge)
        moment = gram.diagonal().sqrt().numpy()[entries.activation]
        weight = moment * np.linalg.norm(values, axis=1)
        if len(weight) > allowed:
            kept = np.sort(np.argpartition(-weight, allowed)[:allowed])
            entries = entries.part(kept)
    return entries, solve(gram, entries, ridge=ridge)


def to_matrix(
    entries: Entries, values: np.ndarray, joints: np.ndarray, channels: int, shape: tuple[int, int]
) -> scipy.sparse.csr_array:
    """W2 as a matrix (J C, 3 v) from values (e, 3) in any unit; `joints` are the ids of the active joints."""
    joint, channel = np.divmod(entries.activation, channels)
    row = np.repeat(channels * joints[joint] + channel, 3)
    column = (3 * entries.vertex[:, None] + np.arange(3)).ravel()
    return scipy.sparse.csr_array((values.ravel(), (row, column)), shape=shape)
