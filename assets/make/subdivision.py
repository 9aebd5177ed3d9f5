"""The low level of detail, recovered from the mid mesh, which is one split of it.

The mid mesh is a single Catmull-Clark style split: its ids are first the low vertices, then one
point for each low edge, then one for each low face. Every mid quad reads (edge point, low vertex,
edge point, face point), so the low polygons can be read back exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_core.errors import InputError

__all__ = ["LowMesh", "recover_low"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LowMesh:
    """Polygons of the low mesh.

    Attributes:
        vertex_count: low vertices are the mid ids below this.
        face_vert_indices, face_vert_counts: polygon stream (int32), winding of the mid mesh.
        corner_quads: for each entry of `face_vert_indices`, the mid quad at that corner, whose
            corner 1 is the low vertex.
    """

    vertex_count: int
    face_vert_indices: np.ndarray
    face_vert_counts: np.ndarray
    corner_quads: np.ndarray


def _chain(quads_at: dict[int, tuple[int, int, int]], face_point: int) -> list[tuple[int, int]]:
    """Order one face's quads head to tail; return (low vertex, quad id) for each corner."""
    start = min(quads_at)
    corners, edge = [], start
    for _ in range(len(quads_at)):
        if edge not in quads_at:
            break
        vertex, edge, quad = quads_at[edge]
        corners.append((vertex, quad))
    if edge != start or len(corners) != len(quads_at):
        raise InputError(
            "quads",
            got=f"quads around face point {face_point} that form no closed ring",
            expected="quads listed as (edge point, low vertex, edge point, face point)",
            fix="Keep the corner order of the source file.",
        )
    return corners


def recover_low(quads: np.ndarray) -> LowMesh:
    """Recover the low polygons from the quads of the mid mesh.

    Args:
        quads: (q, 4) int, corners (edge point, low vertex, edge point, face point).

    Raises:
        InputError: the quads around a face point do not form a ring.
    """
    rings: dict[int, dict[int, tuple[int, int, int]]] = {}
    for quad, (first, vertex, last, face_point) in enumerate(quads.tolist()):
        rings.setdefault(face_point, {})[first] = (vertex, last, quad)
    polygons = [_chain(rings[face_point], face_point) for face_point in sorted(rings)]
    corners = np.array([corner for polygon in polygons for corner in polygon], np.int32)
    return LowMesh(
        vertex_count=int(quads[:, 1].max()) + 1,
        face_vert_indices=np.ascontiguousarray(corners[:, 0]),
        face_vert_counts=np.array([len(polygon) for polygon in polygons], np.int32),
        corner_quads=np.ascontiguousarray(corners[:, 1]),
    )
