"""Vertices of one OBJ or PLY file, all of them and in the file's order."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable

__all__ = ["read_mesh_vertices"]

_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_MOST_BYTES = 256 * 2**20
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_mesh_vertices(path: Path) -> np.ndarray:
    """Vertices (n, 3) float64 of an ``.obj`` or ``.ply``; nothing is merged, split or reordered.

    Mesh libraries do all three, for texture seams and duplicates; here only positions are read.

    Raises:
        AssetError: the file is missing, damaged or holds no vertices.
    """
    refuse_unreadable(path, most_bytes=_MOST_BYTES)
    try:
        vertices = _read_ply(path) if path.suffix.lower() == ".ply" else _read_obj(path)
    except (ValueError, IndexError, TypeError, KeyError, OverflowError, MemoryError) as error:
        raise AssetError(path, cause=f"no readable mesh ({error})", fix="Export the mesh again.") from error
    if not len(vertices):
        raise AssetError(path, cause="holds no vertices", fix="Export the mesh again.")
    return vertices


def _read_obj(path: Path) -> np.ndarray:
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    rows = [line.split()[1:4] for line in lines if line.startswith(("v ", "v\t"))]
    return np.array(rows, np.float64).reshape(-1, 3)


@dataclass
class _Element:
    """One element of a PLY header: its count and the names and types of its properties."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def _read_ply(path: Path) -> np.ndarray:
    data = path.read_bytes()
    head, found, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not found:
        raise ValueError("no PLY header")
    body = body[body.index(b"\n") + 1 :]
    order, elements = _parse_header(head.decode("ascii", errors="replace"))
    for element in elements:
        if element.name == "vertex":
            return _ascii_rows(body, element) if order == "" else _binary_rows(body, element, order)
        if element.has_list:
            raise ValueError(f"element {element.name!r} with lists comes before the vertices")
        body = _skip(body, element, order)
    raise ValueError("no element 'vertex'")


def _parse_header(text: str) -> tuple[str, list[_Element]]:
    """Byte order (empty for ASCII) and the elements in their order."""
    order, elements = None, []
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = _PLY_ORDERS.get(words[1])
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2])))
            if not 0 <= elements[-1].count <= _MOST_BYTES:
                raise ValueError(f"{words[2]:.20} of element {words[1]:.20}")
        elif words[:2] == ["property", "list"]:
            elements[-1].has_list = True
        elif words[:1] == ["property"]:
            elements[-1].properties.append((words[2], _PLY_TYPES[words[1]]))
    if order is None:
        raise ValueError("no known PLY format")
    return order, elements


def _layout(element: _Element, order: str) -> np.dtype:
    return np.dtype([(name, order + kind) for name, kind in element.properties])


def _skip(body: bytes, element: _Element, order: str) -> bytes:
    if order:
        return body[element.count * _layout(element, order).itemsize :]
    return body.split(b"\n", element.count)[element.count]


def _binary_rows(body: bytes, element: _Element, order: str) -> np.ndarray:
    if element.has_list:
        raise ValueError("vertices with lists")
    rows = np.frombuffer(body, _layout(element, order), element.count)
    return np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _ascii_rows(body: bytes, element: _Element) -> np.ndarray:
    names = [name for name, _ in element.properties]
    columns = [names.index(axis) for axis in "xyz"]
    rows = body.split(b"\n", element.count)[: element.count]
    if len(rows) < element.count:
        raise ValueError(f"{len(rows)} of {element.count} vertices")
    values = np.array([row.split()[: len(names)] for row in rows], np.float64)
    return values.reshape(element.count, -1)[:, columns]
