"""Vertices in NumPy files: ``.npy``, and ``.npz`` whose members are never loaded whole."""

from __future__ import annotations

import math
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from soma_core.errors import AssetError, InputError, SomaError
from soma_core.io.npz_fields import NpzFields, open_npz
from soma_core.io.soma_npz import METRES_PER_UNIT
from soma_core.io.vertex_sequence import UpAxis, VertexSequence

__all__ = ["ArraySequence", "open_npy", "open_npz_vertices"]

_KEY = "vertices"
_UNITS = METRES_PER_UNIT | {"m": 1.0, "cm": 0.01, "mm": 0.001}
_AXES: dict[str, UpAxis] = {"Y": "+y", "Z": "+z"}
_DAMAGE = (ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True, kw_only=True)
class _Header:
    """Layout of one stored array: where its numbers begin and what they are."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool
    begin: int

    @property
    def holds_vertices(self) -> bool:
        """Whether the array is numbers of shape (frames, vertices, 3)."""
        return len(self.shape) == 3 and self.shape[2] == 3 and self.dtype.kind in "fiu"


def _read_header(stream: IO[bytes]) -> _Header:
    """Read the header of an NPY stream; ValueError where it is none."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"NPY version {version}")
    return _Header(shape=shape, dtype=dtype, fortran=fortran, begin=stream.tell())


class ArraySequence(VertexSequence):
    """Frames of one array, read by seeking in its stream; nothing else of it is in memory."""

    def __init__(
        self,
        path: Path,
        stream: IO[bytes],
        header: _Header,
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
        header = _read_header(stream)
        _check_layout(path, "the array", header)
        missing = header.begin + math.prod(header.shape) * header.dtype.itemsize - path.stat().st_size
        if missing > 0:
            raise _damaged(path, f"{missing} bytes are missing")
        return ArraySequence(path, stream, header)
    except SomaError:
        stream.close()
        raise
    except _DAMAGE as error:
        stream.close()
        raise _damaged(path, error) from error


def open_npz_vertices(path: Path) -> ArraySequence:
    """Open the vertices in an ``.npz``: the key ``vertices``, or the only array (frames, n, 3).

    ``fps``, ``unit`` (``meters``, ``centimeters``, ``millimeters``) and ``up_axis`` (``Y``, ``Z``) are read
    where they are there.

    Raises:
        AssetError: no NPZ file, or damaged.
        InputError: no array of that layout, or several; a unit or an axis that is not known.
    """
    with open_npz(path) as fields:
        fps = fields.number("fps") if "fps" in fields else None
        metres = _named(fields, "unit", _UNITS) if "unit" in fields else None
        up = _named(fields, "up_axis", _AXES) if "up_axis" in fields else None
    archive = zipfile.ZipFile(path)
    try:
        name, header = _vertex_member(path, archive)
        _check_layout(path, name, header)
        # A member keeps the file of its archive open until it is closed itself.
        return ArraySequence(path, archive.open(f"{name}.npy"), header, fps=fps, metres=metres, up=up)
    except (zipfile.BadZipFile, EOFError, zlib.error, OSError) as error:
        raise _damaged(path, error) from error
    finally:
        archive.close()


def _named(fields: NpzFields, key: str, known: dict) -> float | UpAxis:
    value = fields.text(key)
    found = known.get(value) or known.get(value.upper())
    if found is None:
        raise fields.refuse(
            key,
            got=repr(value),
            expected=" or ".join(map(repr, known)),
            fix=f"Correct the key '{key}' of the file.",
        )
    return found


def _vertex_member(path: Path, archive: zipfile.ZipFile) -> tuple[str, _Header]:
    """Name and layout of the array that holds the vertices."""
    found = {}
    for name in archive.namelist():
        if not name.endswith(".npy"):
            continue
        try:
            with archive.open(name) as stream:
                header = _read_header(stream)
        except ValueError as error:
            if name == f"{_KEY}.npy":
                raise _damaged(path, error) from error
            continue
        found[name.removesuffix(".npy")] = header
    if _KEY in found:
        return _KEY, found[_KEY]
    fitting = [name for name, header in found.items() if header.holds_vertices]
    if len(fitting) != 1:
        shapes = ", ".join(f"{name} {header.shape}" for name, header in found.items())
        raise InputError(
            f"{path}: {_KEY}",
            got=f"{shapes or 'no arrays'}: {len(fitting)} of them (frames, vertices, 3)",
            expected=f"a key '{_KEY}', or one array of that layout",
            fix=f"Store the vertices under the key '{_KEY}'.",
        )
    return fitting[0], found[fitting[0]]


def _check_layout(path: Path, name: str, header: _Header) -> None:
    if not header.holds_vertices or header.fortran or 0 in header.shape:
        order = " in Fortran order" if header.fortran else ""
        raise InputError(
            f"{path}: {name}",
            got=f"shape {header.shape}, dtype {header.dtype}{order}",
            expected="numbers (frames, vertices, 3) in C order, at least one frame",
            fix="Save np.ascontiguousarray(vertices); one frame is vertices[None].",
        )
