"""Reading a wrap pair and refusing one whose order was lost (paper, section 3.3)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.files import refuse_unreadable
from soma_core.geometry.mesh import triangle_sides
from soma_core.rig.mesh import CanonicalMesh

__all__ = [
    "check_count",
    "check_faces",
    "check_order",
    "check_wrap",
    "read_obj",
]

_MOST_BYTES = 256 * 2**20
"""A hundred times the largest pair; an OBJ unfolds to some ten times its size in memory."""


def read_obj(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float64 and triangles (t, 3) int64 of an OBJ, in the file's order.

    Only ``v`` and ``f`` lines are read, so texture seams, normals, groups and materials neither split nor
    reorder vertices, as they do in mesh libraries. Polygons become fans.

    Raises:
        AssetError: missing, a git-LFS pointer, not an OBJ mesh, or not finite.
    """
    refuse_unreadable(path, fix="Reinstall the backend or name another file.", most_bytes=_MOST_BYTES)
    text = Path(path).read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    points: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(text.splitlines(), 1):
        kind, *fields = line.split() or [""]
        try:
            if kind == "v":
                points.append(_point(fields))
            elif kind == "f":
                faces += _fan(fields, len(points))
        except ValueError as error:
            raise AssetError(
                path, cause=f"line {number} is {line:.60}", fix="Export the mesh again."
            ) from error
    if not points or not faces:
        raise AssetError(path, cause="holds no mesh", fix="Export it again with vertices and faces.")
    vertices, triangles = np.array(points, np.float64), np.array(faces, np.int64)
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        strange = triangles.max() if triangles.max() >= len(vertices) else triangles.min()
        cause = f"a face refers to vertex {strange + 1} of {len(vertices)}"
        raise AssetError(path, cause=cause, fix="Export the mesh again.")
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(1))[0])
        raise AssetError(path, cause=f"vertex {bad} is not finite", fix="Export the mesh again.")
    return vertices, triangles


def _point(fields: list[str]) -> list[float]:
    """Coordinates of a ``v`` line; vertex colours that may follow are left out."""
    if len(fields) < 3:
        raise ValueError(fields)
    return [float(field) for field in fields[:3]]


def _fan(fields: list[str], count: int) -> list[tuple[int, int, int]]:
    """Triangles of an ``f`` line; indices count from 1, or backwards from the last of `count` vertices."""
    if len(fields) < 3:
        raise ValueError(fields)
    numbers = [int(field.partition("/")[0]) for field in fields]
    if max(map(abs, numbers)) >= 2**31:
        raise ValueError(fields)
    ids = [number - 1 if number > 0 else number + count for number in numbers]
    return [(ids[0], ids[i], ids[i + 1]) for i in range(1, len(ids) - 1)]


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
