"""Correctives over a motion as a few shapes of the rest mesh, which skinned files hold (morph targets)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
import torch
from torch import Tensor

from soma_core.correctives.model import Correctives
from soma_core.progress import progress

__all__ = ["CorrectiveShapes", "corrective_shapes"]

_MOST = 192
"""Shapes of one file."""

_DROPPED = (0.05, 0.0)
"""Share of the tolerance that an entry of a shape must reach in some frame to be kept; the second where the
first does not lead there."""

_TRIED, _AIM, _CHUNK = 128, 0.9, 64
"""Frames that decide how many shapes there are, the share of the tolerance that they aim at since others may
be worse, and frames looked at together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectiveShapes:
    """Offsets of the rest mesh, before skinning: ``weights @ targets``.

    Attributes:
        targets: sparse (K, 3 v) float64 [m]; x, y, z of a vertex side by side. The first matters most.
        weights: (frames, K) float32, between -1 and 1.
        worst: largest distance that is left of an offset [m].
    """

    targets: scipy.sparse.csr_array
    weights: np.ndarray
    worst: float

    def __len__(self) -> int:
        return self.targets.shape[0]

    def target(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Ascending ids (n,) of the vertices that a shape moves, and their offsets (n, 3) float32 [m]."""
        row = self.targets[[index]].tocoo()
        ids, place = np.unique(row.col // 3, return_inverse=True)
        offsets = np.zeros((len(ids), 3), np.float32)
        offsets[place, row.col % 3] = row.data
        return ids, offsets


@torch.no_grad()
def corrective_shapes(
    model: Correctives, relative: Tensor, bind_world: Tensor, *, tolerance: float = 1e-4
) -> CorrectiveShapes:
    """Find the shapes that make up the correctives of a motion: principal components of its offsets.

    Args:
        model: the correctives.
        relative: T-pose-relative rotations (frames, J - 1, 3, 3) of the motion.
        bind_world: bind transforms (1, J, 4, 4) of the one identity [m].
        tolerance: length that no offset may be off by, as far as 192 shapes reach [m].
    """
    scale = float(model.scale(bind_world)[0])
    active = [model.activations(model.features(part)).T.cpu().numpy() for part in relative.split(_CHUNK)]
    activity = scale * np.concatenate(active).astype(np.float64)
    second = model.second.scipy()
    directions, weights = _components(activity, second)
    frames = _telling_frames(activity)
    truth = activity[frames] @ second.T
    for share in _DROPPED:
        low, high = 0, min(_MOST, weights.shape[1])
        while low < high:
            middle = (low + high) // 2
            few = _cut(directions[:, :middle], weights[:, :middle], share * tolerance)
            low, high = (low, middle) if _off(truth, *few, frames) <= _AIM * tolerance else (middle + 1, high)
        targets, found = _cut(directions[:, :high], weights[:, :high], share * tolerance)
        if _off(truth, targets, found, frames) <= _AIM * tolerance:
            break
    starts = range(0, len(activity), _CHUNK)
    worst = 0.0
    for start in progress(starts, label="shapes", total=len(starts), after=5.0):
        part = slice(start, start + _CHUNK)
        worst = max(worst, _off(activity[part] @ second.T, targets, found, part))
    return CorrectiveShapes(targets=targets, weights=found.astype(np.float32), worst=worst)


def _components(activity: np.ndarray, second: scipy.sparse.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Directions (3 v, k) and weights (frames, k) whose products are the offsets, the largest first.

    The offsets ``activity @ second.T`` are never made: their products with each other are those of activity
    and of the matrix alone.
    """
    shared, turn = scipy.linalg.eigh((second.T @ second).toarray())
    kept = shared > 1e-12 * shared.max(initial=0.0)
    length, turn = np.sqrt(shared[kept]), turn[:, kept]
    reduced = activity @ (turn * length)
    size, main = scipy.linalg.eigh(reduced.T @ reduced)
    kept = np.flatnonzero(size > 1e-14 * size.max(initial=1e-300))[::-1][: len(activity)]
    main = main[:, kept]
    directions = second @ (turn / length @ main)
    largest = np.abs(directions).argmax(axis=0)  # a sign that no library decides
    main = main * np.sign(directions[largest, np.arange(len(largest))])
    return second @ (turn / length @ main), reduced @ main


def _telling_frames(activity: np.ndarray) -> np.ndarray:
    """Frames with the most activity, and as many spread over the motion."""
    count = len(activity)
    most = np.argsort(-(activity**2).sum(axis=1), kind="stable")[: _TRIED // 2]
    spread = np.linspace(0, count - 1, min(count, _TRIED // 2)).round().astype(int)
    return np.unique(np.concatenate([most, spread]))


def _cut(
    directions: np.ndarray, weights: np.ndarray, least: float
) -> tuple[scipy.sparse.csr_array, np.ndarray]:
    """Targets whose weights reach from -1 to 1 at most, without vertices that they move by less."""
    most = np.abs(weights).max(axis=0, initial=0)
    targets = (directions * most).T
    vertices = directions.shape[0] // 3
    moved = np.linalg.norm(targets.reshape(-1, vertices, 3), axis=2) >= least
    kept = np.where(np.repeat(moved, 3, axis=1), targets, 0.0)
    return scipy.sparse.csr_array(kept), weights / np.where(most > 0, most, 1)


def _off(
    truth: np.ndarray, targets: scipy.sparse.csr_array, weights: np.ndarray, frames: slice | np.ndarray
) -> float:
    """Largest distance of offsets (f, 3 v) of some frames to what shapes make of them."""
    left = truth - weights[frames] @ targets
    return float(np.linalg.norm(left.reshape(len(left), -1, 3), axis=2).max(initial=0.0))
