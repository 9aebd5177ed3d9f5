"""OBJ files of meshes, vertex order kept: read as vertices and triangles, and written."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from soma_core.cache import atomic_text
from soma_core.errors import AssetError
from soma_core.files import refuse_far, refuse_unreadable

__all__ = ["obj_lines", "read_obj", "write_obj"]

_MOST_BYTES = 256 * 2**20
"""A hundred times the largest pair."""

_LONGEST_LINE = 2**20


def read_obj(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float64 and triangles (t, 3) int64 of an OBJ, in the file's order.

    Only ``v`` and ``f`` lines are read, so texture seams, normals, groups and materials neither split nor
    reorder vertices, as they do in mesh libraries. Polygons become fans.

    Raises:
        AssetError: missing, a git-LFS pointer, not an OBJ mesh, or not finite.
    """
    refuse_unreadable(path, fix="Reinstall the backend or name another file.", most_bytes=_MOST_BYTES)
    points, faces = array("d"), array("q")  # a list of numbers takes ten times as much
    for number, line in obj_lines(path):
        kind, *fields = line.split() or [""]
        try:
            if kind == "v":
                points.extend(_point(fields))
            elif kind == "f":
                faces.extend(_fan(fields, len(points) // 3))
        except (ValueError, OverflowError) as error:
            raise AssetError(
                path, cause=f"line {number} is {line.rstrip():.60}", fix="Export the mesh again."
            ) from error
    if not points or not faces:
        raise AssetError(path, cause="holds no mesh", fix="Export it again with vertices and faces.")
    vertices = np.frombuffer(points, np.float64).reshape(-1, 3).copy()
    triangles = np.frombuffer(faces, np.int64).reshape(-1, 3).copy()
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        strange = triangles.max() if triangles.max() >= len(vertices) else triangles.min()
        cause = f"a face refers to vertex {strange + 1} of {len(vertices)}"
        raise AssetError(path, cause=cause, fix="Export the mesh again.")
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(1))[0])
        raise AssetError(path, cause=f"vertex {bad} is not finite", fix="Export the mesh again.")
    refuse_far(path, vertices)
    return vertices, triangles


def obj_lines(path: Path | str) -> Iterator[tuple[int, str]]:
    """Number and text of each line of a text file; one that ends in a backslash goes on in the next.

    Raises:
        AssetError: a line longer than a mebibyte.
    """
    number, begun = 0, ""
    with open(path, encoding="utf-8", errors="replace") as stream:
        while part := stream.readline(_LONGEST_LINE):
            number += 1
            begun += part
            if len(begun) >= _LONGEST_LINE:
                cause = f"line {number} is longer than {_LONGEST_LINE} letters"
                raise AssetError(path, cause=cause, fix="Export the mesh again.")
            if begun.endswith("\\\n"):
                begun = begun[:-2] + " "
                continue
            yield number, begun
            begun = ""
    if begun:
        yield number, begun


def _point(fields: list[str]) -> list[float]:
    """Coordinates of a ``v`` line; vertex colours that may follow are left out."""
    if len(fields) < 3:
        raise ValueError(fields)
    return [float(field) for field in fields[:3]]


def _fan(fields: list[str], count: int) -> Iterator[int]:
    """Corners of an ``f`` line's triangles; ids count from 1, or back from the last of `count` vertices."""
    if len(fields) < 3:
        raise ValueError(fields)
    numbers = [int(field.partition("/")[0]) for field in fields]
    if max(map(abs, numbers)) >= 2**31:
        raise ValueError(fields)
    ids = [number - 1 if number > 0 else number + count for number in numbers]
    return (corner for i in range(1, len(ids) - 1) for corner in (ids[0], ids[i], ids[i + 1]))


def write_obj(
    path: Path | str, vertices: np.ndarray, triangles: np.ndarray, *, digits: int | None = None
) -> Path:
    """Write a triangle mesh, atomically; without `digits` after the point it reads back bit for bit."""
    form = repr if digits is None else f"{{:.{digits}f}}".format
    lines = ["v " + " ".join(map(form, point)) for point in np.asarray(vertices).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(triangles) + 1).tolist()]
    atomic_text(Path(path), "\n".join(lines) + "\n")
    return Path(path)
