"""Reading a wrap pair and refusing one whose order was lost (paper, section 3.3)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from soma_core.errors import InputError
from soma_core.geometry.mesh import triangle_sides
from soma_core.rig.mesh import CanonicalMesh

__all__ = [
    "check_count",
    "check_faces",
    "check_order",
    "check_wrap",
]


def _edge_keys(sides: np.ndarray) -> np.ndarray:
    ids = sides.astype(np.int64)
    return ids.min(1) << 32 | ids.max(1)


def check_wrap(vertices: np.ndarray, triangles: np.ndarray, mesh: CanonicalMesh, *, path: Path) -> None:
    """Refuse a wrap of another vertex count, or whose vertices are not in canonical order."""
    check_count(vertices, mesh, path=path)
    check_faces(triangles, mesh, path=path)
    check_order(vertices, mesh, path=path)


def check_count(vertices: np.ndarray, mesh: CanonicalMesh, *, path: Path) -> None:
    """Refuse a wrap of another vertex count."""
    if len(vertices) != mesh.vertex_count:
        raise InputError(
            f"wrap {path}",
            got=f"{len(vertices)} vertices",
            expected=f"{mesh.vertex_count}, one for each canonical vertex",
            fix="Export the wrap without merging, splitting or removing vertices.",
        )


def check_faces(triangles: np.ndarray, mesh: CanonicalMesh, *, path: Path) -> None:
    """Refuse faces that are no part of a canonical polygon; its diagonals are free."""
    on_edges = np.isin(_edge_keys(triangle_sides(triangles)), _edge_keys(mesh.edges())).reshape(3, -1).sum(0)
    strange = int((on_edges < 2).sum())
    if strange:
        raise InputError(
            f"wrap {path}",
            got=f"{strange} of {len(triangles)} faces that do not exist in the canonical mesh",
            expected="the canonical vertex order and faces",
            fix="Export again, vertex order kept (Blender: Keep Vertex Order; trimesh: process=False).",
        )


def check_order(vertices: np.ndarray, mesh: CanonicalMesh, *, path: Path) -> None:
    """Catch a permutation applied to vertices and not to faces: neighbours would lie far apart."""
    start, end = mesh.edges().T

    def relative(points: np.ndarray) -> float:
        diagonal = float(np.linalg.norm(np.ptp(points, axis=0))) or 1.0
        return float(np.linalg.norm(points[start] - points[end], axis=1).mean()) / diagonal

    got, expected = relative(vertices), relative(mesh.vertices)
    if got > 3 * expected:
        raise InputError(
            f"wrap {path}",
            got=f"neighbouring vertices {got:.1%} of the body's diagonal apart",
            expected=f"about {expected:.1%}, as on the canonical mesh",
            fix="The vertices were reordered; export again with the vertex order kept.",
        )
