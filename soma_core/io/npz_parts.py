"""NPZ files of arrays that are too long to hold: written piece by piece."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from soma_core.cache import atomic_write
from soma_core.errors import InputError

__all__ = ["write_npz_parts"]


def write_npz_parts(
    path: str | Path,
    arrays: Mapping[str, np.ndarray],
    pieces: Mapping[str, Callable[[], Iterable[np.ndarray]]],
    *,
    count: int,
) -> None:
    """Write an NPZ file, atomically; no more than one piece of an array is in memory.

    Args:
        path: the file.
        arrays: name -> array, in the order of the file. Of a long array any part tells its type and the
            shape of an entry.
        pieces: name -> what gives the consecutive pieces of a long array.
        count: entries of every long array.

    Raises:
        InputError: the pieces of an array do not add up.
    """

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, array in arrays.items():
                if name in pieces:
                    _write_long(archive, name, pieces[name](), like=array, count=count)
                else:
                    _write_short(archive, name, array)

    atomic_write(Path(path), write)


def _write_short(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    with archive.open(f"{name}.npy", "w") as stream:
        np.save(stream, array, allow_pickle=False)


def _write_long(
    archive: zipfile.ZipFile, name: str, pieces: Iterable[np.ndarray], *, like: np.ndarray, count: int
) -> None:
    header = {"descr": like.dtype.str, "fortran_order": False, "shape": (count, *like.shape[1:])}
    written = 0
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array_header_2_0(stream, header)
        for piece in pieces:
            stream.write(np.ascontiguousarray(piece, like.dtype).tobytes())
            written += len(piece)
    if written != count:
        raise InputError(name, got=f"{written} frames", expected=count, fix="Give every piece, once.")
