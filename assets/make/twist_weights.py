"""Skin weights of twist segments spread over their helpers along the bone (paper, section 3.5.1)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import scipy.sparse

from soma_core.rig.procedural import ProceduralDefinition

__all__ = ["spread_weights"]

_SMOOTHING = 0.1
"""Half width, as a share of the bone, over which the hat functions of the helpers are averaged. Removes the
ring that piecewise linear weights leave at each helper of a strongly twisted thigh; a wider one thins the
limb and costs influences."""

_LEAST = 0.002
"""Taken from every share, so that the smallest vanish: fewer influences, and skin moves by 0.1 mm at most."""

_SIGNIFICAND = 24  # bits of a float32, the implicit one included
_SMALLEST = 2.0**-149  # smallest float32; the rig holds weights that small


def _ramp_integral(position: np.ndarray, low: float, high: float) -> np.ndarray:
    """Integral from minus infinity of the ramp that rises from 0 at `low` to 1 at `high`."""
    inside = np.clip(position - low, 0, high - low)
    return 0.5 * inside**2 / (high - low) + np.maximum(position - high, 0)


def _along(offsets: np.ndarray, bone: np.ndarray) -> np.ndarray:
    """Position (n,) of `offsets` (n, 3) along `bone` (3,): 0 at its start, 1 at its end.

    Terms are added in a fixed order, not by BLAS: the same skin gets the same weights on every processor.
    """
    along, length = offsets * bone, (bone * bone).tolist()
    return (along[:, 0] + along[:, 1] + along[:, 2]) / (length[0] + length[1] + length[2])


def _shares(position: np.ndarray, nodes: Sequence[float]) -> np.ndarray:
    """Share (n, k) of each node in skin at `position` along the bone: smoothed hats that sum to 1."""
    passed = [np.ones_like(position)]
    for low, high in itertools.pairwise(nodes):
        ends = (position - _SMOOTHING, position + _SMOOTHING)
        before, after = (_ramp_integral(end, low, high) for end in ends)
        passed.append((after - before) / (2 * _SMOOTHING))
    passed.append(np.zeros_like(position))
    shares = np.maximum(-np.diff(np.stack(passed, 1), axis=1) - _LEAST, 0)
    return shares / shares.sum(axis=1, keepdims=True)


def _exact_parts(weights: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Parts (n, k) of float32 weights (n,) in the given shares, each a float32, with an exact sum.

    All are whole multiples of the last digit of the weight, so that no addition rounds.
    """
    digit = np.maximum(np.ldexp(1.0, np.frexp(weights)[1] - _SIGNIFICAND), _SMALLEST)[:, None]
    parts = np.rint(weights[:, None] * shares / digit) * digit
    rows = np.arange(len(parts))
    parts[rows, parts.argmax(axis=1)] += weights - parts.sum(axis=1)
    return parts


def spread_weights(
    weights: scipy.sparse.csr_array,
    points: np.ndarray,
    joints: np.ndarray,
    definition: ProceduralDefinition,
) -> scipy.sparse.csr_array:
    """Spread the weights of each segment's start joint over its helpers, by position along the bone.

    At a helper's own place most of the weight is the helper's, between two it passes smoothly from one
    to the other, and beyond the last it stays there. The start joint itself keeps a share only where
    the twist begins with it (a segment that is not reversed).

    Args:
        weights: (v, J) of the public joints, float32 values.
        points: (v, 3) bind vertices.
        joints: (J, 3) bind positions of the public joints, in the same unit.
        definition: its `main_joints` name the columns.

    Returns:
        (v, J + H) float64, every value a float32; ``fold_weights`` of the rig gives `weights` back exactly.
    """
    names, helpers = definition.main_joints, definition.helpers
    place = definition.place(names)
    dense = weights.toarray()
    full = np.concatenate([dense, np.zeros((len(points), len(helpers)))], axis=1)
    for segment in definition.segments:
        start, end = names.index(segment.start), names.index(segment.end)
        rows = [helpers.index(helper) for helper in segment.helpers]
        nodes, columns = place[rows, end].tolist(), [len(names) + row for row in rows]
        if not segment.reverse:
            nodes, columns = [0.0, *nodes], [start, *columns]
        used = np.flatnonzero(dense[:, start])
        position = _along(points[used] - joints[start], joints[end] - joints[start])
        parts = _exact_parts(dense[used, start], _shares(position, nodes))
        full[used, start] = 0
        full[used[:, None], columns] = parts
    return scipy.sparse.csr_array(full)
