"""Open USD files of strangers: nothing outside of their folder, within bounds of time and memory."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soma_core.apart import read_apart
from soma_core.errors import AssetError, SomaError
from soma_core.files import refuse_unreadable
from soma_core.json_file import parse_json

if TYPE_CHECKING:
    from pxr import Usd

__all__ = ["metres_of", "open_stage", "usd_errors"]

_MOST_PLAIN = 32 * 2**20
"""Bytes of text that are looked through here; longer ones are opened in a process of their own first."""

_DEEPEST = 64
_STRINGS = re.compile(rb"\"[^\"\n]*\"|'[^'\n]*'")
_ESCAPES = re.compile(rb"\\|\"\"\"|'''")
_UNCLEAR = re.compile(rb"[@#\"']|//|/\*")
"""With escapes, triple quotes, paths of files or comments it is doubtful where a string ends."""

_ARCS = re.compile(rb"\b(references|payload|subLayers|inherits|specializes|variants?|variantSets?|clips)\b")
"""What makes USD open other files or unfold prims."""

_SECONDS, _BYTES_A_SECOND = 2, 10 * 2**20
_MEMORY, _EXPANSION = 896 * 2**20, 8


def open_stage(path: Path | str, *, fix: str, allow_references: bool = False) -> Usd.Stage:
    """Open a USD file. One that refers to others, is binary or nests deep is tried in another process first.

    Args:
        path: a .usd, .usda, .usdc or .usdz file.
        fix: what to do about a file that cannot be read.
        allow_references: follow references, payloads and sublayers out of the folder of the file.

    Raises:
        AssetError: missing, no USD, a reference to what lies outside of its folder or is no file, or more
            time or memory than a file of its size can mean.
    """
    path = Path(path)
    head = refuse_unreadable(path, fix=fix)
    if not _is_plain(path, head):
        _try_apart(path, fix, allow_references=allow_references)
    from pxr import Usd

    with usd_errors(path, fix=fix):
        return Usd.Stage.Open(str(path))


@contextmanager
def usd_errors(path: Path, *, fix: str) -> Iterator[None]:
    """Name the file where USD fails, or gives values of other types than its schema says.

    Raises:
        AssetError: in place of what USD and its values raise; errors of this project pass.
    """
    try:
        yield
    except SomaError:
        raise
    except (RuntimeError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        # Tf.ErrorException is a RuntimeError with lines of C++.
        raise AssetError(path, cause=f"USD cannot read it ({_last_line(error)})", fix=fix) from error


def metres_of(path: Path, stage: Usd.Stage) -> float:
    """Metres of a unit of a stage.

    Raises:
        AssetError: none that a length can have.
    """
    from pxr import UsdGeom

    unit = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not 0 < unit < np.inf:
        cause = f"metersPerUnit is {unit:g}, expected a positive number"
        raise AssetError(path, cause=cause, fix="Export it again")
    return unit


def _last_line(error: Exception) -> str:
    """What USD says at last; its text cannot always be decoded."""
    try:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    except UnicodeDecodeError:
        lines = []
    return lines[-1] if lines else "no reason given"


def _is_plain(path: Path, head: bytes) -> bool:
    """Whether it is a text that is short, refers to nothing and nests like that of any body."""
    if not head.startswith(b"#usda") or path.stat().st_size > _MOST_PLAIN or path.suffix == ".usdz":
        return False
    data = path.read_bytes().partition(b"\n")[2]
    left = _STRINGS.sub(b" ", data)
    if _ESCAPES.search(data) or _UNCLEAR.search(left) or _ARCS.search(left):
        return False
    letters = np.frombuffer(left, np.uint8)
    step = np.isin(letters, [*b"([{"]).astype(np.int8) - np.isin(letters, [*b")]}"])
    return not len(step) or int(np.cumsum(step, dtype=np.int32).max()) <= _DEEPEST


def _try_apart(path: Path, fix: str, *, allow_references: bool) -> None:
    """Open the file in a process with limits; refuse what it refuses, and what ends it."""
    size = path.stat().st_size
    seconds, memory = _SECONDS + size // _BYTES_A_SECOND, _MEMORY + _EXPANSION * size
    told = read_apart("soma_core.usd_probe", path, allow_references, seconds=seconds, memory=memory)
    try:
        cause = parse_json((told or b"").rstrip().rpartition(b"\n")[2])["refused"]
    except (ValueError, TypeError, KeyError):
        cause = "USD ends, or takes more time or memory than a file of its size can mean"
    if cause is None:
        return
    outside = "outside of" in cause or "clips" in cause
    way = "Pass allow_references=true if you trust it, or make it one file: usdcat --flatten -o ONE.usdc FILE"
    raise AssetError(path, cause=cause, fix=way if outside else fix)
