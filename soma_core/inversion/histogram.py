"""Quantiles of endless positive numbers in fixed memory: a histogram whose bins are float32 bit patterns."""

from __future__ import annotations

import numpy as np

__all__ = ["BIN_COUNT", "bin_counts", "quantile"]

_DROPPED_BITS = 13
"""Of the 23 mantissa bits of a float32: what is left cuts each octave into 1,024 bins, 0.1 % wide."""

_LOWEST, _HIGHEST = 2.0**-34, 2.0**7
"""Range of the bins [m]: 6e-11 to 128; numbers outside count in the first or the last."""


def _pattern(value: float) -> int:
    return int(np.float32(value).view(np.int32)) >> _DROPPED_BITS


_FIRST = _pattern(_LOWEST)
BIN_COUNT = _pattern(_HIGHEST) - _FIRST


def bin_counts(values: np.ndarray) -> np.ndarray:
    """Count float32 `values` >= 0 in each bin, (BIN_COUNT,) int64.

    The bits of a positive float, read as an integer, grow with it: dropping the last ones is a logarithmic
    histogram without a logarithm.
    """
    patterns = np.ascontiguousarray(values, np.float32).reshape(-1).view(np.int32) >> _DROPPED_BITS
    return np.bincount(np.clip(patterns - _FIRST, 0, BIN_COUNT - 1), minlength=BIN_COUNT)


def quantile(counts: np.ndarray, share: float) -> float:
    """Value below which `share` of the counted numbers lie, to 0.1 %; NaN where nothing was counted."""
    total = np.cumsum(counts)
    if not len(total) or total[-1] == 0:
        return float("nan")
    wanted = share * total[-1]
    found = min(int(np.searchsorted(total, wanted)), BIN_COUNT - 1)
    inside = (wanted - (total[found] - counts[found])) / max(counts[found], 1)
    low, high = _edges(found)
    return float(low + inside * (high - low))


def _edges(index: int) -> tuple[float, float]:
    """Bounds of a bin; the first one begins at zero."""
    patterns = np.array([_FIRST + index, _FIRST + index + 1], np.int64) << _DROPPED_BITS
    low, high = patterns.astype(np.int32).view(np.float32).tolist()
    return (low if index else 0.0), high
