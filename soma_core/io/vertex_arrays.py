"""Vertices in NumPy files: ``.npy``, and ``.npz`` whose members are never loaded whole."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, TypeVar

import numpy as np

from soma_core.errors import AssetError, InputError, SomaError
from soma_core.io.npz_fields import NpzFields, open_npz
from soma_core.io.vertex_sequence import UpAxis, VertexSequence
from soma_core.npz import ArrayHeader, read_array_header
from soma_core.topology.frames import ANY_UNIT

__all__ = ["ArraySequence", "open_npy", "open_npz_vertices"]

_KEY = "vertices"
_AXES: dict[str, UpAxis] = {"Y": "+y", "Z": "+z", "-Y": "-y", "-Z": "-z"}
_Named = TypeVar("_Named")
_DAMAGE = (ValueError, EOFError, OSError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)
_ARCHIVE_DAMAGE = (EOFError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error)
_MOST_VERTICES = 4_000_000
"""Bounds the memory of one frame."""


class ArraySequence(VertexSequence):
    """Frames of one array, read by seeking in its stream; nothing else of it is in memory."""

    def __init__(
        self,
        path: Path,
        stream: IO[bytes],
        header: ArrayHeader,
        *,
        fps: float | None = None,
        metres: float | None = None,
        up: UpAxis | None = None,
    ) -> None:
        super().__init__(path, header.shape[0], header.shape[1], fps=fps, metres=metres, up=up)
        self._stream, self._header = stream, header

    def _read(self, start: int, stop: int) -> np.ndarray:
        header = self._header
        size = self.vertex_count * 3 * header.dtype.itemsize
        try:
            self._stream.seek(header.begin + start * size)
            data = self._stream.read((stop - start) * size)
        except _DAMAGE as error:
            raise _damaged(self.path, error) from error
        if len(data) < (stop - start) * size:
            raise _damaged(self.path, f"frame {start + len(data) // size} is cut off")
        frames = np.frombuffer(data, header.dtype).reshape(stop - start, self.vertex_count, 3)
        kept = np.float64 if header.dtype.kind == "f" and header.dtype.itemsize > 4 else np.float32
        return frames.astype(kept)

    def close(self) -> None:
        """Close the stream, and with it the file."""
        self._stream.close()


def _damaged(path: Path, why: object) -> AssetError:
    return AssetError(path, cause=f"damaged ({why})", fix="Fetch or write it again.")


def open_npy(path: Path) -> ArraySequence:
    """Open an array (frames, vertices, 3) in an ``.npy`` file.

    Raises:
        AssetError: no NPY file, or cut off.
        InputError: an array of another layout.
    """
    stream = open(path, "rb")  # noqa: SIM115 - the sequence closes it
    try:
        header = read_array_header(stream)
        _check_layout(path, "the array", header)
        missing = header.begin + header.byte_count - path.stat().st_size
        if missing > 0:
            raise _damaged(path, f"{missing} bytes are missing")
        return ArraySequence(path, stream, header)
    except SomaError:
        stream.close()
        raise
    except _DAMAGE as error:
        stream.close()
        raise _damaged(path, error) from error


def open_npz_vertices(path: Path, said: Collection[str] = ()) -> ArraySequence:
    """Open the vertices in an ``.npz``: the key ``vertices``, or the only array (frames, n, 3).

    ``fps``, ``unit`` (``meters``, ``centimeters``, ``millimeters``) and ``up_axis`` (``Y``, ``Z``) are read
    where they are there, and not among those that are `said` already.

    Raises:
        AssetError: no NPZ file, or damaged.
        InputError: no array of that layout, or several; a unit or an axis that is not known.
    """
    with open_npz(path) as fields:
        fps = fields.number("fps") if "fps" in fields else None
        metres = _named(fields, "unit", ANY_UNIT, "unit" in said)
        up = _named(fields, "up_axis", _AXES, "up" in said)
    archive = zipfile.ZipFile(path)
    try:
        name, header = _vertex_member(path, archive)
        _check_layout(path, name, header)
        # A member keeps the file of its archive open until it is closed itself.
        return ArraySequence(path, archive.open(f"{name}.npy"), header, fps=fps, metres=metres, up=up)
    except _ARCHIVE_DAMAGE as error:
        raise _damaged(path, error) from error
    finally:
        archive.close()


def _named(fields: NpzFields, key: str, known: Mapping[str, _Named], said: bool) -> _Named | None:
    """What a key says; None where it is not there, or another was said in place of one that is not known."""
    if key not in fields:
        return None
    value = fields.text(key)
    found = known.get(value) or known.get(value.upper())
    if found is None and not said:
        raise fields.refuse(
            key,
            got=repr(value),
            expected=" or ".join(map(repr, known)),
            fix="Pass unit=m, cm or mm." if key == "unit" else "Pass up=y, z, -y or -z.",
        )
    return found


def _vertex_member(path: Path, archive: zipfile.ZipFile) -> tuple[str, ArrayHeader]:
    """Name and layout of the array that holds the vertices."""
    found = {}
    for name in archive.namelist():
        if not name.endswith(".npy"):
            continue
        try:
            with archive.open(name) as stream:
                header = read_array_header(stream)
        except ValueError as error:
            if name == f"{_KEY}.npy":
                raise _damaged(path, error) from error
            continue
        found[name.removesuffix(".npy")] = header
    if _KEY in found:
        return _KEY, found[_KEY]
    fitting = [name for name, header in found.items() if _holds_vertices(header)]
    if len(fitting) != 1:
        shapes = ", ".join(f"{name} {header.shape}" for name, header in found.items())
        raise InputError(
            f"{path}: {_KEY}",
            got=f"{shapes or 'no arrays'}: {len(fitting)} of them (frames, vertices, 3)",
            expected=f"a key '{_KEY}', or one array of that layout",
            fix="Motions are what soma convert input=FILE takes."
            if "poses" in found or "local_rot_mats" in found
            else f"Store the vertices under the key '{_KEY}'.",
        )
    return fitting[0], found[fitting[0]]


def _holds_vertices(header: ArrayHeader) -> bool:
    """Whether the array is numbers of shape (frames, vertices, 3)."""
    return len(header.shape) == 3 and header.shape[2] == 3 and header.dtype.kind in "fiu"


def _check_layout(path: Path, name: str, header: ArrayHeader) -> None:
    if _holds_vertices(header) and header.shape[1] > _MOST_VERTICES:
        raise AssetError(
            path,
            cause=f"{name} has {header.shape[1]} vertices a frame, more than any body",
            fix="Save the body alone.",
        )
    if not _holds_vertices(header) or header.fortran or 0 in header.shape:
        order = " in Fortran order" if header.fortran else ""
        raise InputError(
            f"{path}: {name}",
            got=f"shape {header.shape}, dtype {header.dtype}{order}",
            expected="numbers (frames, vertices, 3) in C order, at least one frame",
            fix=f"Save np.ascontiguousarray(vertices{_turn(header.shape)}); one frame is vertices[None].",
        )


def _turn(shape: tuple[int, ...]) -> str:
    """What brings coordinates to the end, before them the vertices, which are many."""
    if len(shape) != 3 or 3 not in shape[:2]:
        return ""
    place = shape.index(3)
    axes = [*sorted({0, 1, 2} - {place}, key=lambda axis: shape[axis]), place]
    return f".transpose({', '.join(map(str, axes))})"
