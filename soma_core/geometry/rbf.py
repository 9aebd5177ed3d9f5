"""Radial basis functions: fixed weights that carry a point along with a cloud (paper, section 3.4.1)."""

from __future__ import annotations

from contextlib import suppress

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
    right, sums = cdist(local, targets), np.vstack([np.ones((1, len(targets))), targets.T])
    singular = np.linalg.svd(local, compute_uv=False)
    if count >= 4 and singular[-1] >= _RANK_TOLERANCE * singular[0]:
        with suppress(scipy.linalg.LinAlgError):  # points that coincide but for rounding
            return _definite(cdist(local, local), polynomial, right, sums).T
    system = np.block([[cdist(local, local), polynomial], [polynomial.T, np.zeros((4, 4))]])
    return scipy.linalg.lstsq(system, np.vstack([right, sums]), cond=1e-12)[0][:count].T


def _definite(kernel: np.ndarray, polynomial: np.ndarray, right: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Weights (n, q) with ``kernel @ weights - right`` in the span of `polynomial`, whose sums are `sums`.

    Distances are negative definite where the sums are zero, so that Cholesky's half of the work is enough.
    """
    (mirrors, scales), triangle = scipy.linalg.qr(polynomial, mode="raw")
    room = 64 * len(kernel)

    def turned(side: str, kind: str, array: np.ndarray) -> np.ndarray:
        return scipy.linalg.lapack.dormqr(side, kind, mirrors, scales, array, room, overwrite_c=1)[0]

    kernel = turned("R", "N", turned("L", "T", kernel.T))  # it is symmetric, and LAPACK wants columns
    fixed = scipy.linalg.solve_triangular(triangle[:4], sums, trans="T")
    given = kernel[4:, :4] @ fixed - turned("L", "T", np.asfortranarray(right))[4:]
    factor = scipy.linalg.cho_factor(-kernel[4:, 4:], lower=True, overwrite_a=True, check_finite=False)
    free = scipy.linalg.cho_solve(factor, given, check_finite=False)
    return turned("L", "N", np.asfortranarray(np.vstack([fixed, free])))
