"""Open the zip archives that NPZ, USDZ and torch files are; a directory too long to hold is not read."""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable

__all__ = ["ARCHIVE_DAMAGE", "open_archive"]

ARCHIVE_DAMAGE = (
    ValueError, TypeError, KeyError, IndexError, EOFError, OSError, RuntimeError, MemoryError, OverflowError,
    struct.error, zlib.error, lzma.LZMAError, zipfile.BadZipFile,
)  # fmt: skip
"""What zipfile raises for files that are not what they say. RuntimeError: encrypted members."""

_END, _END64 = b"PK\x05\x06", b"PK\x06\x06"
_LONGEST_END = 2**16 + 200
_LONGEST_DIRECTORY = 16 * 2**20
"""Bytes; Python holds ten times as many, and a hundred thousand entries fit."""


@contextmanager
def open_archive(
    path: Path | str, *, kind: str, fix: str, most_bytes: int | None = None
) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive, which the messages call a `kind`.

    Raises:
        AssetError: missing, a git-LFS pointer, too large, no archive, or a damaged or endless directory.
    """
    head = refuse_unreadable(path, fix=fix, most_bytes=most_bytes)
    try:
        if not zipfile.is_zipfile(path):
            raise AssetError(path, cause=f"not {kind} (it starts with {head[:8]!r})", fix=fix)
        _refuse_long_directory(Path(path))
        archive = zipfile.ZipFile(path)
        _refuse_doubles(archive)
    except ARCHIVE_DAMAGE as error:
        raise AssetError(path, cause=f"damaged {kind.partition(' ')[2]} ({error})", fix=fix) from error
    with archive:
        yield archive


def _refuse_doubles(archive: zipfile.ZipFile) -> None:
    """Refuse two members of one name: which of them counts differs by who reads."""
    names = [name.removesuffix(".npy") for name in archive.namelist()]
    if len({*names}) < len(names):
        twice = next(name for place, name in enumerate(names) if name in names[:place])
        raise ValueError(f"it holds {twice!r:.60} twice")


def _refuse_long_directory(path: Path) -> None:
    """Refuse by what the end of the file says; zipfile reads that many bytes, whatever the entries say."""
    with open(path, "rb") as stream:
        stream.seek(max(path.stat().st_size - _LONGEST_END, 0))
        tail = stream.read()
    sizes = [
        struct.unpack_from(layout, tail, at + offset)[0]
        for mark, layout, offset in ((_END, "<I", 12), (_END64, "<Q", 40))
        if (at := tail.rfind(mark)) >= 0
    ]
    known = [size for size in sizes if size != 0xFFFFFFFF]  # stands for the 64-bit number
    if any(size > _LONGEST_DIRECTORY for size in known):
        raise ValueError(f"its directory takes {max(known)} bytes, more than {_LONGEST_DIRECTORY}")
