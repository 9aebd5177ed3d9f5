"""Left/right mirror images of shapes on the canonical mesh."""

from __future__ import annotations

import numpy as np

__all__ = ["mirror_shapes"]


def mirror_shapes(shapes: np.ndarray, bind: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Mirror shapes (batch, v, 3) in the plane x = 0, vertex ids included.

    The canonical mesh is not exactly symmetric, so the deviation from `bind` (v, 3) is mirrored rather
    than the positions: the bind shape is its own mirror image. `partner` (v,) holds each vertex's
    counterpart on the other side. All lengths in one unit.
    """
    deviation = (shapes - bind)[:, partner]
    deviation[..., 0] *= -1
    return bind + deviation
