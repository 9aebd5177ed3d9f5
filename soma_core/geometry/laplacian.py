"""Laplacians of meshes: by cotangents, and by edges alone."""

from __future__ import annotations

import numpy as np
import scipy.sparse

__all__ = ["adjacency", "cotangent_laplacian", "random_walk", "vertex_areas"]

_CLAMP = 1e-6
"""Smallest edge weight relative to the mean: keeps the interior block positive definite."""


def cotangent_laplacian(vertices: np.ndarray, triangles: np.ndarray) -> scipy.sparse.csr_array:
    """Positive semi-definite Laplacian L (v, v): ``L[i, i] = sum_j w_ij``, ``L[i, j] = -w_ij``.

    ``w_ij`` is half the sum of the cotangents opposite edge ij, clamped from below because obtuse
    pairs make some negative; rows sum to zero. Degenerate triangles contribute nothing.

    Args:
        vertices: (v, 3) float64, any unit.
        triangles: (t, 3) integers.
    """
    count = len(vertices)
    rows, columns, values = [], [], []
    for corner in range(3):
        i, j, k = (triangles[:, (corner + shift) % 3] for shift in (0, 1, 2))
        a, b = vertices[j] - vertices[i], vertices[k] - vertices[i]
        area = np.linalg.norm(np.cross(a, b), axis=1)
        cotangent = np.divide((a * b).sum(1), area, out=np.zeros(len(a)), where=area > 0)
        rows.append(j)
        columns.append(k)
        values.append(0.5 * cotangent)
    row, column, value = np.concatenate(rows), np.concatenate(columns), np.concatenate(values)
    half = scipy.sparse.coo_array((value, (row, column)), shape=(count, count))
    weights = (half + half.T).tocsr()
    weights.data = np.maximum(weights.data, _CLAMP * np.abs(weights.data).mean())
    degree = np.asarray(weights.sum(1)).ravel()
    return (scipy.sparse.diags_array(degree) - weights).tocsr()


def vertex_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the area of the triangles around each vertex, (v,)."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(triangles.ravel(), np.repeat(area, 3), len(vertices))


def adjacency(edges: np.ndarray, count: int) -> scipy.sparse.csr_array:
    """Symmetric matrix (v, v) with a 1 for each of the edges (e, 2), each of which is given once."""
    half = scipy.sparse.csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return half + half.T


def random_walk(edges: np.ndarray, count: int) -> scipy.sparse.csr_array:
    """Laplacian ``I - D^-1 A`` (v, v) of the edges (e, 2) of a mesh: its steps are as long as they are."""
    neighbours = adjacency(edges, count)
    degree = np.maximum(np.asarray(neighbours.sum(1)).ravel(), 1)
    return scipy.sparse.eye_array(count, format="csr") - scipy.sparse.diags_array(1 / degree) @ neighbours
