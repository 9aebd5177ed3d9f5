"""Surfaces: polygons and their edges, normals, volume."""

from __future__ import annotations

import numpy as np

__all__ = [
    "enclosed_volume",
    "following_corners",
    "polygon_sides",
    "split_polygons",
    "triangle_sides",
    "unique_edges",
    "vertex_areas",
    "vertex_normals",
]


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


def following_corners(counts: np.ndarray) -> np.ndarray:
    """Place in the polygon stream of the corner that follows each in its polygon; `counts` corners each."""
    ends = np.cumsum(counts)
    following = np.arange(1, int(ends[-1]) + 1)
    following[ends - 1] = ends - counts
    return following


def polygon_sides(indices: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Both vertices of every side of every polygon, along its winding: (len(indices), 2) int64."""
    return np.stack([indices, indices[following_corners(counts)]], 1).astype(np.int64)


def triangle_sides(triangles: np.ndarray) -> np.ndarray:
    """Both vertices of every side of triangles, along its winding, (3 t, 2): all first sides come first."""
    return np.concatenate([triangles[:, [corner, (corner + 1) % 3]] for corner in range(3)])


def unique_edges(sides: np.ndarray) -> np.ndarray:
    """Each edge of the sides (s, 2) once, the smaller vertex first, in order: (e, 2) int64."""
    low, high = sides.astype(np.int64).min(1), sides.astype(np.int64).max(1)
    keys = np.unique(low << 32 | high)
    return np.stack([keys >> 32, keys & 0xFFFFFFFF], 1)


def vertex_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Sums of the area vectors of the faces around each vertex (cross products, twice an area), (v, 3)."""
    corners = vertices[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ids = triangles.reshape(-1)
    weights = np.repeat(faces, 3, axis=0)
    return np.stack([np.bincount(ids, weights[:, axis], len(vertices)) for axis in range(3)], axis=1)


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Area-weighted unit vertex normals, (v, 3); +Y where a vertex has no area."""
    normals = vertex_areas(vertices, triangles)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1), (0.0, 1.0, 0.0))


def enclosed_volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Volume inside a closed mesh; negative where its faces point inwards."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6)
