"""The binary container of glTF 2.0: accessors packed into one buffer, and the GLB file around it."""

from __future__ import annotations

import json
import struct
from typing import Any, Literal

import numpy as np

__all__ = ["GlbBuffer", "glb_bytes"]

_COMPONENTS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
_KINDS = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_TARGETS = {"attribute": 34962, "index": 34963}


class GlbBuffer:
    """Collects arrays; each becomes one buffer view and one accessor."""

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self._data = bytearray()

    def add(
        self, array: np.ndarray, *, role: Literal["attribute", "index", "data"] = "data", bounds: bool = False
    ) -> int:
        """Append `array` and return its accessor id.

        Args:
            array: (count, ...) uint8, uint16, uint32 or float32; matrices (count, 4, 4) as column-vector
                transforms (glTF stores columns, so they are transposed here).
            role: buffer views of vertex attributes and indices carry a target, others must not.
            bounds: write the smallest and largest value, which glTF demands of positions and times.
        """
        kind = _KINDS[array.shape[1:]]
        stored = np.swapaxes(array, -1, -2) if kind == "MAT4" else array
        data = np.ascontiguousarray(stored).astype(stored.dtype.newbyteorder("<"), copy=False).tobytes()
        self._data.extend(bytes(-len(self._data) % 4))
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        if role in _TARGETS:
            view["target"] = _TARGETS[role]
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": _COMPONENTS[array.dtype.name],
            "count": len(array),
            "type": kind,
        }
        if bounds:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        self._data.extend(data)
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_sparse(self, ids: np.ndarray, values: np.ndarray, *, count: int) -> int:
        """Append an accessor of `count` entries, zero but for `values` (n, 3) float32 at `ids` (n,)."""
        small = np.uint16 if count < 65535 else np.uint32
        views = [self.accessors.pop(self.add(array))["bufferView"] for array in (ids.astype(small), values)]
        bounds = np.concatenate([values, np.zeros((1 if len(ids) < count else 0, 3), np.float32)])
        self.accessors.append(
            {
                "componentType": _COMPONENTS["float32"], "count": count, "type": "VEC3",
                "min": bounds.min(axis=0).tolist(), "max": bounds.max(axis=0).tolist(),
                "sparse": {  # VTK (9.7) wants the offsets that glTF lets one leave out
                    "count": len(ids), "values": {"bufferView": views[1], "byteOffset": 0},
                    "indices": {
                        "bufferView": views[0], "byteOffset": 0,
                        "componentType": _COMPONENTS[np.dtype(small).name],
                    },
                },
            }
        )  # fmt: skip
        return len(self.accessors) - 1

    @property
    def data(self) -> bytes:
        """The packed buffer, a multiple of four bytes."""
        return bytes(self._data) + bytes(-len(self._data) % 4)


def glb_bytes(document: dict[str, Any], buffer: GlbBuffer) -> bytes:
    """Make a GLB file of a glTF document and its buffer."""
    data = buffer.data
    document = document | {
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
