"""Vertices of one OBJ or PLY file, all of them and in the file's order."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError
from soma_core.files import refuse_far, refuse_unreadable
from soma_core.obj import obj_lines

__all__ = ["read_mesh_vertices", "read_ply_triangles"]

_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_MOST_BYTES = 256 * 2**20
_CORNERS = ("vertex_indices", "vertex_index")
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
    refuse_far(path, vertices)
    return vertices


def read_ply_triangles(path: Path, vertex_count: int) -> np.ndarray:
    """Triangles (t, 3) int64 of a ``.ply``, polygons as fans; the file is all that is opened.

    Raises:
        AssetError: the file is missing, damaged, holds no faces, or faces of other vertices.
    """
    refuse_unreadable(path, most_bytes=_MOST_BYTES)
    fix = "Export the mesh with its faces, as OBJ."
    try:
        data = path.read_bytes()
        head = data.partition(b"end_header")[0].decode("ascii", errors="replace")
        triangles = _ply_faces(data, *_parse_header(head))
    except (ValueError, IndexError, TypeError, KeyError, OverflowError, MemoryError) as error:
        raise AssetError(path, cause=f"no readable faces ({error})", fix=fix) from error
    if not len(triangles):
        raise AssetError(path, cause="holds no faces", fix=fix)
    if not 0 <= triangles.min() <= triangles.max() < vertex_count:
        raise AssetError(path, cause=f"has faces of others than its {vertex_count} vertices", fix=fix)
    return triangles


def _read_obj(path: Path) -> np.ndarray:
    numbers = array("d")
    for _, line in obj_lines(path):
        if line.startswith(("v ", "v\t")):
            x, y, z = line.split()[1:4]
            numbers.extend((float(x), float(y), float(z)))
    return np.frombuffer(numbers, np.float64).reshape(-1, 3).copy()


@dataclass
class _Element:
    """One element of a PLY header: its count and the names and types of its properties."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    lists: dict[int, str] = field(default_factory=dict)

    @property
    def has_list(self) -> bool:
        """Whether its rows differ in length: a list has its own count, of the type in `lists`."""
        return bool(self.lists)


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
            elements[-1].lists[len(elements[-1].properties)] = _PLY_TYPES[words[2]]
            elements[-1].properties.append((words[4], _PLY_TYPES[words[3]]))
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
    numbers = array("d")
    for row in rows:
        fields = row.split(maxsplit=len(names))
        numbers.extend(float(fields[column]) for column in columns)
    return np.frombuffer(numbers, np.float64).reshape(-1, 3).copy()


def _ply_faces(data: bytes, order: str, elements: list[_Element]) -> np.ndarray:
    """Corners of the faces, as fans of triangles (t, 3) int64."""
    body = data[data.index(b"\n", data.index(b"end_header")) + 1 :]
    for element in elements:
        if element.name == "face":
            break
        if element.has_list:
            raise ValueError(f"element {element.name!r} with lists comes before the faces")
        body = _skip(body, element, order)
    else:
        return np.empty((0, 3), np.int64)
    lists = [index for index, (name, _) in enumerate(element.properties) if name in _CORNERS]
    if len(lists) != 1 or element.lists != {lists[0]: element.lists.get(lists[0], "")}:
        raise ValueError("faces without one list of corners, or with other lists")
    corners = array("q")
    rows = _text_corners(body, element) if order == "" else _binary_corners(body, element, order)
    for ids in rows:
        for step in range(1, len(ids) - 1):
            corners.extend((ids[0], ids[step], ids[step + 1]))
    return np.frombuffer(corners, np.int64).reshape(-1, 3).copy()


def _text_corners(body: bytes, element: _Element) -> Iterator[list[int]]:
    before = next(iter(element.lists))
    rows = body.split(b"\n", element.count)[: element.count]
    if len(rows) < element.count:
        raise ValueError(f"{len(rows)} of {element.count} faces")
    for row in rows:
        fields = row.split()
        count = int(fields[before])
        ids = [int(field) for field in fields[before + 1 : before + 1 + count]]
        if len(ids) < count or count < 0:
            raise ValueError("a face is cut off")
        yield ids


def _binary_corners(body: bytes, element: _Element, order: str) -> Iterator[tuple[int, ...]]:
    place, kind = next(iter(element.lists.items()))
    sizes = [np.dtype(entry).itemsize for _, entry in element.properties]
    before, after = sum(sizes[:place]), sum(sizes[place + 1 :])
    number, item = np.dtype(order + kind), np.dtype(order + element.properties[place][1])
    if number.kind not in "iu" or item.kind not in "iu":
        raise ValueError("corners of faces that are no whole numbers")
    at = 0
    for _ in range(element.count):
        count = int(np.frombuffer(body, number, 1, at + before)[0])
        if count < 0:
            raise ValueError("a face of less than no corners")
        at += before + number.itemsize
        yield tuple(np.frombuffer(body, item, count, at).tolist())
        at += count * item.itemsize + after
