"""Parquet files of strangers: looked through in a process of their own, within bounds of time and memory."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from soma_core._lazy import needed
from soma_core.apart import read_apart
from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable
from soma_core.json_file import parse_json

__all__ = ["look_through"]

_SECONDS, _BYTES_A_SECOND = 3, 10 * 2**20
_MEMORY, _EXPANSION = 896 * 2**20, 8
_FIX = "Fetch or write it again."


def look_through(path: Path | str) -> tuple[list[str], int]:
    """Names of the columns of a Parquet file, and how many rows it has.

    Raises:
        AssetError: missing, damaged, or unfolding to more than its size can mean.
        InputError: pyarrow is not installed.
    """
    path = Path(path)
    refuse_unreadable(path, fix="Give a complete .parquet file.")
    needed("pyarrow", "parquet", setting=path, pip="[parquet]")
    found = path.stat()
    told = _looked(path.resolve(), (found.st_size, found.st_mtime_ns))
    if "refused" in told:
        raise AssetError(path, cause=told["refused"], fix=_FIX)
    return list(told["names"]), int(told["rows"])


@functools.lru_cache(maxsize=4096)
def _looked(path: Path, state: tuple[int, int]) -> dict[str, Any]:
    """What the other process says of a file; once for each size [bytes] and time of change that it has."""
    size = state[0]
    seconds, memory = _SECONDS + size // _BYTES_A_SECOND, _MEMORY + _EXPANSION * size
    told = read_apart("soma_core.parquet_probe", path, seconds=seconds, memory=memory)
    try:
        return dict(parse_json((told or b"").rstrip().rpartition(b"\n")[2]))
    except (ValueError, TypeError):
        return {"refused": "damaged, or it takes more time or memory than a file of its size can mean"}
