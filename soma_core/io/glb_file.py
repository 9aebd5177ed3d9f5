"""Read the container of binary glTF 2.0: the document, and accessors as arrays."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.json_file import parse_json

__all__ = ["GlbFile"]

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SHAPES: dict[str, tuple[int, ...]] = {"SCALAR": (), "VEC2": (2,), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}
_MOST_NODES = 100_000
_SMALL, _MOST_EXPANSION = 256 * 2**20, 64
"""Bytes that any file may unfold to, and times its size that a large one may."""

_HARMLESS = ("KHR_materials_", "KHR_texture_")
"""Extensions that change how a body looks, not where it is."""


class GlbFile:
    """A GLB file, its binary chunk mapped into memory.

    ValueError, KeyError, IndexError, TypeError or struct.error say that the file is not what it should be;
    the caller knows its name.
    """

    def __init__(self, path: Path) -> None:
        self._data = np.memmap(path, np.uint8, mode="r")
        magic, version, length = struct.unpack_from("<4sII", self._data.data)
        if magic != b"glTF" or version != 2:
            raise ValueError(f"it starts with {magic!r} and version {version}, not a GLB of version 2")
        if length > len(self._data):
            raise ValueError(f"{length - len(self._data)} bytes are missing at the end")
        size, kind = struct.unpack_from("<I4s", self._data.data, 12)
        if kind != b"JSON":
            raise ValueError(f"its first chunk is {kind!r}, not JSON")
        self.document: dict[str, Any] = parse_json(self._data[20 : 20 + size].tobytes())
        self._begin = 28 + size
        if len(self.document.get("nodes", ())) > _MOST_NODES:
            raise ValueError(f"it holds {len(self.document['nodes'])} nodes, more than {_MOST_NODES}")
        needed = [
            name for name in self.document.get("extensionsRequired", []) if not name.startswith(_HARMLESS)
        ]
        if needed:
            raise ValueError(f"it needs the extension {needed[0]}")

    def check_expansion(self, size: int, what: str) -> None:
        """Refuse to unfold to `size` bytes where the file is too small to mean it."""
        most = max(_SMALL, _MOST_EXPANSION * len(self._data))
        if size > most:
            raise ValueError(f"{what} take {size} bytes; at most {most} are read of a file of its size")

    def accessor(self, index: int) -> np.ndarray:
        """Values of an accessor, (count, ...); matrices as column-vector transforms (count, 4, 4)."""
        accessor = self.document["accessors"][index]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError(f"accessor {index} is sparse")
        dtype, shape = np.dtype(_COMPONENTS[accessor["componentType"]]), _SHAPES[accessor["type"]]
        count = int(accessor["count"])
        view = self.document["bufferViews"][accessor["bufferView"]]
        if view["buffer"] != 0 or "uri" in self.document["buffers"][0]:
            raise ValueError("its arrays are in other files")
        size = dtype.itemsize * int(np.prod(shape, dtype=int))
        offset = self._begin + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", size)
        if stride < size:
            raise ValueError(f"accessor {index} has overlapping values")
        rows = np.ndarray((count, size), np.uint8, self._data, offset=offset, strides=(stride, 1))
        values = np.ascontiguousarray(rows).view(dtype).reshape(count, *shape)
        return np.swapaxes(values, -1, -2) if len(shape) == 2 else values

    def fractions(self, index: int) -> np.ndarray:
        """Values of an accessor as float32; integers count as fractions of their largest value."""
        values = self.accessor(index)
        if values.dtype.kind == "f":
            return values
        return (values / np.iinfo(values.dtype).max).astype(np.float32)
