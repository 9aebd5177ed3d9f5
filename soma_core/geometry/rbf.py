"""Radial basis functions: fixed weights that carry a point along with a cloud (paper, section 3.4.1)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from scipy.spatial.distance import cdist

__all__ = ["affine_rbf_weights"]

_RANK_TOLERANCE = 1e-6
"""Relative singular value of the centred cloud below which it counts as flat."""


def affine_rbf_weights(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Weights w (q, n) with ``w @ points == queries``, exact under every affine map of the points.

    Paper, equation 2: a linear kernel ``|a - b|``, here with a first-degree polynomial; the weights of each
    query sum to one. One factorisation serves all queries. Clouds of fewer than four points or of lower rank
    get the least-squares solution of minimum norm; coincident points share a weight equally.

    Args:
        points: (n, 3) float64, n >= 1.
        queries: (q, 3) float64.
    """
    distinct, place, copies = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    if len(distinct) < len(points):
        place = place.ravel()
        return affine_rbf_weights(distinct, queries)[:, place] / copies[place]
    centre = points.mean(0)
    scale = np.abs(points - centre).max() or 1.0
    local, targets = (points - centre) / scale, (queries - centre) / scale
    count = len(local)
    polynomial = np.hstack([np.ones((count, 1)), local])
    system = np.zeros((count + 4, count + 4))
    system[:count, :count] = cdist(local, local)
    system[:count, count:] = polynomial
    system[count:, :count] = polynomial.T
    right = np.vstack([cdist(local, targets), np.ones((1, len(targets))), targets.T])
    singular = np.linalg.svd(local, compute_uv=False)
    flat = count < 4 or singular[-1] < _RANK_TOLERANCE * singular[0]
    if flat:
        solution = scipy.linalg.lstsq(system, right, cond=1e-12)[0]
    else:
        solution = scipy.linalg.solve(system, right, assume_a="gen", overwrite_a=True, check_finite=False)
    return solution[:count].T
