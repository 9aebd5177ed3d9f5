"""Barycentric coordinates in the tetrahedron raised on a triangle (paper, section 3.3).

The fourth corner is ``p0 + l n`` with the unit normal n and the mean edge length l. The paper raises it
by the raw cross product, which grows with the *square* of size; with a length the coordinates do not
change under any similarity, so a child, an adult and a body in centimetres share one correspondence.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

__all__ = ["closest_point_on_triangle", "raised_normal", "raised_normal_jacobian", "tetrahedral_coordinates"]


def tetrahedral_coordinates(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Coordinates (n, 3) = (c1, c2, c3) of points in the tetrahedra on triangles.

    ``x = p0 + c1 (p1 - p0) + c2 (p2 - p0) + c3 l n``.

    Args:
        points: (n, 3) float64.
        corners: (n, 3, 3) float64, three corners a point; none degenerate.
    """
    origin = corners[:, 0]
    first, second = corners[:, 1] - origin, corners[:, 2] - origin
    normal = np.cross(first, second)
    area = np.linalg.norm(normal, axis=1)
    unit = normal / area[:, None]
    length = _mean_edge(first, second)
    offset = points - origin
    # The dual basis of the two edges inside the plane: exact, without forming a Gram determinant.
    c1 = (np.cross(second, unit) * offset).sum(1) / area
    c2 = -(np.cross(first, unit) * offset).sum(1) / area
    c3 = (unit * offset).sum(1) / length
    return np.stack([c1, c2, c3], 1)


def _mean_edge(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    third = second - first
    return (
        np.linalg.norm(first, axis=1) + np.linalg.norm(second, axis=1) + np.linalg.norm(third, axis=1)
    ) / 3


def raised_normal(corners: Tensor) -> Tensor:
    """Mean edge length times unit normal of triangles; (..., 3, 3) corners -> (..., 3).

    Guarded at run time: a collapsed triangle gives a short vector, never a NaN.
    """
    first = corners[..., 1, :] - corners[..., 0, :]
    second = corners[..., 2, :] - corners[..., 0, :]
    third = second - first
    tiny = torch.finfo(corners.dtype).tiny ** 0.5
    squares = [(edge * edge).sum(-1) for edge in (first, second, third)]
    length = sum((square + tiny).sqrt() for square in squares) / 3
    normal = torch.linalg.cross(first, second, dim=-1)
    floor = 1e-20 * length**4 + tiny
    return normal * (length * torch.rsqrt(torch.maximum((normal * normal).sum(-1), floor)))[..., None]


def raised_normal_jacobian(corners: np.ndarray) -> np.ndarray:
    """Derivative of :func:`raised_normal` in the corners; (n, 3, 3) -> (n, 3, 3, 3).

    Entry [:, i, k, j] is the derivative of component i in coordinate j of corner k:
    ``d(l n) = n dl + l (I - n n^T)(de1 x e2 + e1 x de2) / |e1 x e2|``. Faces must not be degenerate.
    """
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(first, second)
    area = np.linalg.norm(normal, axis=1)
    unit = normal / area[:, None]
    directions = [edge / np.linalg.norm(edge, axis=1)[:, None] for edge in (first, second, second - first)]
    tangent = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) * (_mean_edge(first, second) / area)[
        :, None, None
    ]

    def turn(vectors: np.ndarray) -> np.ndarray:
        """Cross-product matrices of row vectors."""
        return np.cross(vectors[:, None, :], np.eye(3)).transpose(0, 2, 1)

    by_first = unit[:, :, None] * (directions[0] - directions[2])[:, None, :] / 3 - tangent @ turn(second)
    by_second = unit[:, :, None] * (directions[1] + directions[2])[:, None, :] / 3 + tangent @ turn(first)
    return np.stack([-by_first - by_second, by_first, by_second], 2)


def closest_point_on_triangle(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Closest points (n, 3) on triangles, by the region of the Voronoi partition (Ericson 2005, 5.1.5).

    Args:
        points: (n, 3) float64.
        corners: (n, 3, 3) float64.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    candidates = [_on_segment(points, *edge) for edge in ((a, b), (b, c), (c, a))]
    inside, plane = _on_plane(points, a, b - a, c - a)
    offsets = [points - candidate for candidate in candidates]
    distances = np.stack([_dot(offset, offset) for offset in offsets])
    best = np.stack(candidates)[distances.argmin(0), np.arange(len(points))]
    return np.where(inside[:, None], plane, best)


def _on_segment(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    along = end - start
    squared = _dot(along, along)
    t = np.divide(_dot(points - start, along), squared, out=np.zeros(len(points)), where=squared > 0)
    return start + np.clip(t, 0, 1)[:, None] * along


def _on_plane(
    points: np.ndarray, origin: np.ndarray, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    normal = np.cross(first, second)
    squared = _dot(normal, normal)
    offset = points - origin
    safe = np.where(squared > 0, squared, 1.0)
    u = _dot(np.cross(offset, second), normal) / safe
    v = _dot(np.cross(first, offset), normal) / safe
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (squared > 0)
    return inside, origin + u[:, None] * first + v[:, None] * second


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of rows (n, 3), several times faster than a sum over so short an axis."""
    return np.einsum("nc,nc->n", a, b)
