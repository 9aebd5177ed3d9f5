"""Non-rigid registration: a smooth displacement of the fitted body onto the surface, stiff to supple.

The displacement d of all vertices minimises ``sum w (d - t)^2 + stiffness |K d|^2`` with the graph Laplacian
K. Targets t lie along the surface's normals, so that vertices slide where the smoothness wants them to;
points of the surface pull at the faces they are nearest to. Each step solves one sparse system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import splu

from soma_core.geometry.laplacian import random_walk
from soma_core.geometry.mesh import triangle_sides, unique_edges, vertex_normals
from soma_core.registration.surface import Surface

__all__ = ["Smoothness", "deform", "project"]

_FACING = 0.5
"""Cosine between normals below which two surfaces do not belong together."""

_BACKWARD = 0.5
"""Weight of the surface's points against the mesh's vertices."""

_LANDMARK = 100.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Smoothness:
    """Graph Laplacian of a mesh and its square; rows sum to zero.

    Attributes:
        triangles: (t, 3).
        labels: (v, 5) fingers and toes, where they are known on the surface too.
        laplacian: (v, v), identity less the mean of the neighbours.
        energy: (v, v), its normal matrix.
    """

    triangles: np.ndarray
    labels: np.ndarray
    laplacian: scipy.sparse.csr_array
    energy: scipy.sparse.csr_array

    @classmethod
    def of(cls, triangles: np.ndarray, labels: np.ndarray) -> Smoothness:
        """Build it from the triangles of a mesh with a label for each vertex."""
        count = len(labels)
        edges = unique_edges(triangle_sides(triangles)).astype(np.int32)  # and so the matrices' indices
        laplacian = random_walk(edges, count)
        return cls(
            triangles=triangles, labels=labels, laplacian=laplacian, energy=(laplacian.T @ laplacian).tocsr()
        )


def deform(
    start: np.ndarray,
    surface: Surface,
    smooth: Smoothness,
    *,
    free: np.ndarray,
    reaches: Sequence[float],
    scale: float,
    landmarks: tuple[np.ndarray, np.ndarray] | None = None,
    begin: np.ndarray | None = None,
    trust: np.ndarray | None = None,
) -> np.ndarray:
    """Move `start` onto the surface, one linear solve for each entry of `reaches`.

    Args:
        start: (v, 3) [m].
        surface: the target.
        smooth: of the mesh of `start`.
        free: (v,) whether a vertex has no counterpart and only follows.
        reaches: lengths in edges over which the displacement is smooth; the stiffness is their fourth power.
        scale: distance [m] beyond which a closest point counts little.
        landmarks: vertex ids and positions.
        begin: (v, 3) where closest points are looked for first; default `start`.
        trust: (v,) factors of the pull of the surface; default 1.
    """
    vertices, count = start if begin is None else begin, len(start)
    trust = np.ones(count) if trust is None else trust
    for reach in reaches:
        weights, targets = _forward(vertices, surface, smooth, free, scale)
        weights = weights * trust
        matrix = scipy.sparse.diags_array(weights) + reach**4 * smooth.energy
        right = weights[:, None] * (targets - start)
        pull, wanted, held = _backward(vertices, surface, smooth, free, scale)
        held = _BACKWARD * held * (pull @ trust) * min(1.0, count / max(len(held), 1))
        matrix = matrix + pull.T @ scipy.sparse.diags_array(held) @ pull
        right += pull.T @ (held[:, None] * (wanted - pull @ start))
        if landmarks is not None:
            ids, places = landmarks
            mark = np.zeros(count)
            mark[ids] = _LANDMARK
            matrix = matrix + scipy.sparse.diags_array(mark)
            right[ids] += _LANDMARK * (places - start[ids])
        vertices = start + splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
        ).solve(right)
    return vertices


def _forward(
    vertices: np.ndarray, surface: Surface, smooth: Smoothness, free: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (v,) and targets (v, 3) of the vertices themselves."""
    normals = vertex_normals(vertices, smooth.triangles)
    contact = surface.facing(vertices, normals, smooth.labels)
    offset = contact.points - vertices
    along = (offset * contact.normals).sum(1)
    weights = _agreement(offset, normals, contact.normals, scale)
    weights[free | contact.open] = 0
    return weights, vertices + along[:, None] * contact.normals


def _backward(
    vertices: np.ndarray, surface: Surface, smooth: Smoothness, free: np.ndarray, scale: float
) -> tuple[scipy.sparse.csr_array, np.ndarray, np.ndarray]:
    """Matrix (m, v) of the mesh's points nearest to the surface's vertices, their targets and weights."""
    labels = None if surface.labels is None else smooth.labels
    own = Surface(vertices, smooth.triangles, labels=labels)
    contact = own.facing(surface.vertices, surface.normals, surface.labels)
    offset = surface.vertices - contact.points
    along = (offset * contact.normals).sum(1)
    weights = _agreement(offset, contact.normals, surface.normals, scale)
    corners = smooth.triangles[contact.faces]
    weights[free[corners].any(1)] = 0
    rows = np.repeat(np.arange(len(offset)), 3)
    matrix = scipy.sparse.csr_array(
        (contact.shares.ravel(), (rows, corners.ravel())), shape=(len(offset), len(vertices))
    )
    return matrix, contact.points + along[:, None] * contact.normals, weights


def _agreement(offset: np.ndarray, normals: np.ndarray, others: np.ndarray, scale: float) -> np.ndarray:
    squared = (offset**2).sum(1)
    agree = np.clip(((normals * others).sum(1) - _FACING) / (1 - _FACING), 0, 1)
    return agree * (scale**2 / (squared + scale**2)) ** 2


def project(vertices: np.ndarray, surface: Surface, smooth: Smoothness, *, free: np.ndarray) -> np.ndarray:
    """Put vertices on faces that look the same way; those that are free or over a hole stay."""
    normals = vertex_normals(vertices, smooth.triangles)
    contact = surface.facing(vertices, normals, smooth.labels)
    return np.where((free | contact.open)[:, None], vertices, contact.points)
