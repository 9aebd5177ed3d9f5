"""Put a deformed mesh down on the surface without folds."""

from __future__ import annotations

import numpy as np

from soma_core.geometry.mesh import vertex_normals
from soma_core.registration.deform import Smoothness, deform, project
from soma_core.registration.surface import Surface

__all__ = ["face_normals", "flipped_triangles", "folded_triangles", "lay_down"]

_FOLD = -0.3
"""Cosine between neighbouring faces below which one of them is folded over."""

_ROUNDS = 8
_LESS = 0.2
"""Factor on the pull of the surface, each round that a vertex is near a fold."""

_REACH = 2.0
"""Edges over which the displacement is smooth while folds are taken out."""


def face_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals (t, 3); zero where a face has no area."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]


def flipped_triangles(
    vertices: np.ndarray,
    triangles: np.ndarray,
    surface: Surface,
    free: np.ndarray,
    labels: np.ndarray | None = None,
) -> np.ndarray:
    """(t,) whether a face looks the other way than the surface at its corners, none free or over a hole."""
    contact = surface.facing(vertices, vertex_normals(vertices, triangles), labels)
    against = (face_normals(vertices, triangles) * contact.normals[triangles].mean(1)).sum(1) <= 0
    return against & ~(free | contact.open)[triangles].any(1)


def folded_triangles(vertices: np.ndarray, start: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(t,) whether a face is folded against a neighbour that it was not folded against in `start`."""
    ends = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    order = np.lexsort(np.sort(ends, 1).T)
    pairs = np.tile(np.arange(len(triangles)), 3)[order].reshape(-1, 2)
    now, before = (
        (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1)
        for normals in (face_normals(vertices, triangles), face_normals(start, triangles))
    )
    folded = np.zeros(len(triangles), bool)
    folded[pairs[(now < _FOLD) & (before > _FOLD)].ravel()] = True
    return folded


def lay_down(
    vertices: np.ndarray,
    start: np.ndarray,
    surface: Surface,
    smooth: Smoothness,
    *,
    free: np.ndarray,
    scale: float,
) -> np.ndarray:
    """Project a deformed mesh; where faces turn over, let go of the surface until they do not.

    Around flipped and folded faces the pull of the surface is weakened round by round and the displacement
    solved again, so that smoothness decides. Vertices there stay where the solution puts them: skin without
    a counterpart, such as the inside of a lip.

    Args:
        vertices: (v, 3) deformed [m].
        start: (v, 3) the shape they come from, without folds.
        surface: the target.
        smooth: of the mesh.
        free: (v,) vertices that only follow.
        scale: as in :func:`~soma_core.registration.deform.deform`.
    """
    triangles = smooth.triangles
    neighbours = (smooth.laplacian != 0).astype(np.int8)
    trust = np.ones(len(vertices))
    for _ in range(_ROUNDS):
        laid = project(vertices, surface, smooth, free=free | (trust < 1))
        bad = flipped_triangles(laid, triangles, surface, free, smooth.labels)
        bad |= folded_triangles(laid, start, triangles) & ~free[triangles].any(1)
        if not bad.any():
            break
        region = np.zeros(len(vertices), bool)
        region[triangles[bad]] = True
        region = neighbours @ region.astype(np.int8) > 0
        trust[region] *= _LESS
        vertices = deform(
            start, surface, smooth, free=free, reaches=(_REACH,), scale=scale, begin=vertices, trust=trust
        )
    return project(vertices, surface, smooth, free=free | (trust < 1))
