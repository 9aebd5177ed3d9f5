"""Rotation vectors of files: radians, whatever unit they were written in."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from soma_core.errors import InputError

__all__ = ["degrees_doubt", "in_radians"]

_MOST = 2 * np.pi
"""No joint of a body turns further [rad]; vectors from optimisers leave [0, pi] by a turn at most."""

_MOST_ROOT = 3 * _MOST
"""The root may turn on the spot, in vectors that were unwrapped; in degrees it reaches 90 soon."""


def in_radians(path: Path, vectors: np.ndarray, angles: Literal["rad", "deg"] | None) -> np.ndarray:
    """Rotation vectors (frames, J, 3) of a file in radians.

    Args:
        path: the file, for messages.
        vectors: as they are stored.
        angles: their unit; None for radians.

    Raises:
        InputError: degrees are said, but no angle is larger than radians are.
    """
    if angles != "deg":
        return vectors
    largest = float(np.linalg.norm(vectors, axis=-1).max(initial=0))
    if 0 < largest <= np.pi:
        raise InputError(
            "angles", got=f"deg for {path.name}, whose largest angle is {largest:.3g}",
            expected="angles above 3.14, as degrees have them", fix="Leave angles out: these are radians.",
        )  # fmt: skip
    return np.deg2rad(vectors)


def degrees_doubt(vectors: np.ndarray) -> str | None:
    """Say so where vectors (frames, J, 3), the root first, can hardly be radians."""
    lengths = np.linalg.norm(vectors, axis=-1)
    root, others = (float(part.max(initial=0)) for part in (lengths[:, :1], lengths[:, 1:]))
    if others <= _MOST and root <= _MOST_ROOT:
        return None
    largest = others if others > _MOST else root
    return f"joints turn by up to {largest:.3g} rad; if the angles are in degrees, pass angles=deg"
