"""Rounding of the directions, so that a shape space compresses well and the loss is known."""

from __future__ import annotations

import numpy as np

__all__ = ["round_directions"]


def round_directions(directions: np.ndarray, eigenvalues: np.ndarray, step: float) -> np.ndarray:
    """Round each direction so that one standard deviation of it moves by multiples of about `step`.

    The steps are powers of two, which leaves float32 mantissas ending in zeros. A vertex coordinate then
    errs by at most half of `step` for a coefficient of one. `step` and the square roots of the
    `eigenvalues` have one unit; the result is float32 (k, n).
    """
    deviation = np.sqrt(np.maximum(eigenvalues, np.finfo(np.float64).tiny))
    steps = np.exp2(np.floor(np.log2(step / deviation)))[:, None]
    return (np.round(directions / steps) * steps).astype(np.float32)
