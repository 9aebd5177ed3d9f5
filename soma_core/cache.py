"""Derived arrays on disk: keyed by content, written atomically, safe to delete at any time."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError
from soma_core.npz import open_npz_file
from soma_core.paths import cache_dir

__all__ = [
    "atomic_arrays",
    "atomic_folder",
    "atomic_text",
    "atomic_write",
    "cached_arrays",
    "content_key",
    "file_sha256",
]

_log = logging.getLogger(__name__)


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, as 64 hex digits."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        for block in iter(lambda: stream.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def content_key(*parts: object) -> str:
    """One key for arrays, texts and numbers: equal content gives an equal key (32 hex digits)."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            array = np.ascontiguousarray(part)
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.data)
        elif isinstance(part, bytes):
            digest.update(b"b" + part)
        else:
            digest.update(f"{type(part).__name__}:{part}".encode())
        digest.update(b"\0")
    return digest.hexdigest()[:32]


def atomic_write(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it: readers never see half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def atomic_folder(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary folder beside `path`, then put it in the place of what is there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}-"))
    try:
        write(temporary)
        temporary.chmod(0o755)
        shutil.rmtree(path, ignore_errors=True)
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def atomic_text(path: Path, text: str) -> None:
    """Write a UTF-8 text as :func:`atomic_write` does."""
    atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def atomic_arrays(path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = True) -> None:
    """Write an NPZ as :func:`atomic_write` does."""
    save = np.savez_compressed if compressed else np.savez

    def write(temporary: Path) -> None:
        # Given a name, numpy appends .npz to any other, and the rename would then miss the file.
        with open(temporary, "wb") as stream:
            save(stream, **arrays)  # type: ignore[arg-type]

    atomic_write(path, write)


def _read(path: Path) -> dict[str, np.ndarray] | None:
    try:
        if not path.exists():
            return None
        with open_npz_file(path) as file:
            return {name: file.read(name) for name in file.names}
    except (OSError, ValueError, AssetError) as error:
        _log.warning("cache file %s is unreadable (%s); building it again", path, error)
        return None


def cached_arrays(
    kind: str, key: str, build: Callable[[], Mapping[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Return the arrays stored under `kind`/`key`, building and storing them when absent.

    A cache that cannot be written (read-only home, full disk) costs time, never the result.
    """
    path = cache_dir() / kind / f"{key}.npz"
    found = _read(path)
    if found is not None:
        return found
    arrays = {name: np.asarray(value) for name, value in build().items()}
    try:
        atomic_arrays(path, arrays, compressed=False)
    except OSError as error:
        _log.warning("cannot write the cache file %s (%s); continuing without it", path, error)
    return arrays
