"""Polygons of a mesh: split into triangles."""

from __future__ import annotations

import numpy as np

__all__ = ["split_polygons"]


def split_polygons(indices: np.ndarray, counts: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Split triangles and quads into triangles, quads along their shorter diagonal.

    Args:
        indices: flat vertex ids of the polygons.
        counts: corners of each polygon, 3 or 4.
        vertices: (v, 3) positions that decide the diagonal; a tie takes corners 0 and 2.

    Returns:
        (t, 3) int32 in polygon order, winding kept.
    """
    triangles, start = [], 0
    for count in counts.tolist():
        polygon = indices[start : start + count].tolist()
        start += count
        if count == 3:
            triangles.append(polygon)
            continue
        a, b, c, d = polygon
        along_ac = np.sum((vertices[a] - vertices[c]) ** 2)
        along_bd = np.sum((vertices[b] - vertices[d]) ** 2)
        triangles += [[a, b, c], [a, c, d]] if along_ac <= along_bd else [[a, b, d], [b, c, d]]
    return np.array(triangles, np.int32)
