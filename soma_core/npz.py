"""Arrays of an NPZ file: nothing is unpickled, and nothing is read that the file is too small to hold."""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from soma_core.zip_archive import ARCHIVE_DAMAGE, open_archive

__all__ = ["ArrayHeader", "NpzFile", "open_npz_file", "read_array_header"]

_DAMAGE = (*ARCHIVE_DAMAGE, SyntaxError)

_LONGEST_HEADER = 10_000  # as numpy itself
_BLOCK = 2**20
_SMALL = 128 * 2**20
_MOST_EXPANSION = 64
"""Times its size that a large array may unfold to; zeros reach 1,000, motion and meshes 2 to 10."""


@dataclass(frozen=True, kw_only=True)
class ArrayHeader:
    """Layout of one stored array: where its numbers begin and what they are."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool
    begin: int

    @property
    def count(self) -> int:
        """How many numbers."""
        return math.prod(self.shape)

    @property
    def byte_count(self) -> int:
        """Bytes of its numbers."""
        return self.count * self.dtype.itemsize


def read_array_header(stream: IO[bytes], *, objects: bool = False) -> ArrayHeader:
    """Read the header of an NPY stream, of one that a pickle of `objects` follows only if that is asked for.

    Raises:
        ValueError: it is none, or describes objects or a shape that cannot be.
    """
    try:
        version = np.lib.format.read_magic(stream)
        readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in readers:
            raise ValueError(f"NPY version {version}")
        width = 2 if version == (1, 0) else 4
        size = stream.read(width)
        length = int.from_bytes(size, "little")
        if length > _LONGEST_HEADER:
            raise ValueError(f"a header of {length} bytes")
        shape, fortran, dtype = readers[version](io.BytesIO(size + stream.read(length)))
    except (*_DAMAGE, tokenize.TokenError) as error:
        raise ValueError(f"{error or type(error).__name__}"[:200]) from error
    if dtype.hasobject and not objects:
        raise ValueError("Python objects, which can run code")
    if any(size < 0 for size in shape):
        raise ValueError(f"the shape {shape}")
    return ArrayHeader(shape=shape, dtype=dtype, fortran=fortran, begin=stream.tell())


def _most(info: zipfile.ZipInfo) -> int:
    """Bytes that a member may unfold to."""
    return max(_SMALL, _MOST_EXPANSION * info.compress_size)


class NpzFile:
    """The named arrays of one NPZ file, read on demand."""

    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self.path = path
        self._archive = archive
        self._members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

    @property
    def names(self) -> tuple[str, ...]:
        """Keys in the order they were stored."""
        return tuple(self._members)

    def header(self, name: str, *, objects: bool = False) -> ArrayHeader:
        """Layout of the array under `name`; its numbers stay unread.

        Raises:
            ValueError: damaged, or Python objects where they are not asked for; the text says which.
        """
        with self._open(name) as stream:
            return read_array_header(stream, objects=objects)

    def read(self, name: str) -> np.ndarray:
        """Array under `name`.

        Raises:
            ValueError: damaged, Python objects, or larger than the file can mean.
        """
        info = self._members[name]
        with self._open(name) as stream:
            header = read_array_header(stream)
            if header.begin + header.byte_count != info.file_size:
                stored = info.file_size - header.begin
                raise ValueError(f"{stored} bytes for the shape {header.shape} of {header.dtype}")
            if header.byte_count > (most := _most(info)):
                raise ValueError(
                    f"{header.byte_count} bytes in {info.compress_size} of its file; at most {most} are read"
                )
            data = bytearray()
            while block := stream.read(_BLOCK):  # to the very end, where the checksum is compared
                data += block
        if len(data) != header.byte_count:
            raise ValueError(f"{len(data)} bytes for the shape {header.shape} of {header.dtype}")
        return np.ndarray(header.shape, header.dtype, data, order="F" if header.fortran else "C")

    def pieces(self, name: str, count: int) -> Iterator[np.ndarray]:
        """Array under `name` in consecutive pieces of at most `count` entries; one is in memory at a time.

        Raises:
            ValueError: damaged, Python objects, or stored with the first axis last.
        """
        with self._open(name) as stream:
            header = read_array_header(stream)
            if header.fortran or not header.shape:
                raise ValueError(f"the shape {header.shape}, which has no pieces")
            size = header.dtype.itemsize * math.prod(header.shape[1:])
            for start in range(0, header.shape[0], count):
                shape = (min(count, header.shape[0] - start), *header.shape[1:])
                data = stream.read(shape[0] * size)
                if len(data) != shape[0] * size:
                    raise ValueError(f"fewer bytes than the shape {header.shape} of {header.dtype}")
                yield np.frombuffer(data, header.dtype).reshape(shape)

    def pickled(self, name: str) -> bytes:
        """The pickle that an array of Python objects under `name` is, which nothing here runs.

        Raises:
            ValueError: damaged, no such array, or larger than the file can mean.
        """
        with self._open(name) as stream:
            if not read_array_header(stream, objects=True).dtype.hasobject:
                raise ValueError("an array of no objects")
            most = _most(self._members[name])
            data = stream.read(most + 1)
        if len(data) > most:
            raise ValueError(f"more than {most} bytes of Python objects")
        return data

    @contextmanager
    def _open(self, name: str) -> Iterator[IO[bytes]]:
        try:
            with self._archive.open(self._members[name]) as stream:
                yield stream
        except _DAMAGE as error:
            raise ValueError(str(error) or type(error).__name__) from error


@contextmanager
def open_npz_file(path: Path | str, *, fix: str = "Fetch or write it again.") -> Iterator[NpzFile]:
    """Open an NPZ file.

    Raises:
        AssetError: missing, a git-LFS pointer, or no NPZ.
    """
    with open_archive(path, kind="an NPZ file", fix=fix) as archive:
        yield NpzFile(Path(path), archive)
