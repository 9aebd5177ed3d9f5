"""Derived arrays on disk: keyed by content, written atomically, safe to delete at any time."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import re
import shutil
import tempfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError, InputError, SomaError
from soma_core.npz import open_npz_file
from soma_core.paths import cache_dir, fitting

__all__ = [
    "UnwritableError", "atomic_arrays", "atomic_folder", "atomic_text", "atomic_write", "cached_arrays",
    "content_key", "file_sha256",
]  # fmt: skip

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


_SUFFIX = 20
"""Characters of a suffix at most, beyond which a name merely has a dot in it."""


class UnwritableError(SomaError, OSError):
    """A file or folder cannot be written: no room, no right to, or something in its place."""

    def __init__(self, path: object, error: OSError) -> None:
        self.path, self.why = str(path), error.strerror or str(error)
        super().__init__(
            f"{path}: cannot be written ({self.why}). Make room or give the right to write, or choose "
            "another place (hydra.run.dir=FOLDER for results, SOMA_CACHE_DIR=FOLDER for the cache)."
        )


def atomic_write(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it: readers never see half a file.

    What processes that were killed left behind in the folder is removed.

    Raises:
        UnwritableError: the folder cannot be made, or the file not be written.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _sweep(path.parent)
        prefix = f".{fitting(path.stem, longest=100)}{_mark()}{os.getpid()}-"
        suffix = path.suffix if len(path.suffix) <= _SUFFIX else ""
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=prefix, suffix=suffix)
        os.close(handle)
        temporary = Path(name)
        write(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    except UnwritableError:
        raise
    except OSError as error:
        raise UnwritableError(path, error) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _mark() -> str:
    """What temporary files of this machine have in their names, before the number of the process."""
    return f"-soma{zlib.crc32(platform.node().encode()):08x}-"


def _sweep(folder: Path) -> None:
    """Remove temporary files of processes that are no more; those of other machines are left alone."""
    if os.name != "posix":  # elsewhere asking for a process ends it
        return
    pattern = re.compile(rf"\..*{_mark()}(\d{{1,9}})-[a-z0-9_]{{8}}(\..*)?")
    with os.scandir(folder) as entries:
        left = [(entry.path, found[1]) for entry in entries if (found := pattern.fullmatch(entry.name))]
    for name, process in left:
        if not _runs(int(process)):
            Path(name).unlink(missing_ok=True)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # that of another user
        return True
    return True


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
            arrays = {name: file.read(name) for name in file.names}
        if str(arrays.pop(_CONTENTS, "")) != _contents(arrays):
            raise ValueError("it holds other arrays than were stored")
        return arrays
    except (OSError, ValueError, AssetError) as error:
        _log.warning("cache file %s is unreadable (%s); building it again", path, error)
        return None


_CONTENTS = "soma_cache_contents"


def _contents(arrays: Mapping[str, np.ndarray]) -> str:
    """Names, shapes and types of arrays, which are stored with them."""
    return content_key(*sorted(f"{name} {array.shape} {array.dtype.str}" for name, array in arrays.items()))


def cached_arrays(
    kind: str, key: str, build: Callable[[], Mapping[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Return the arrays stored under `kind`/`key`, building and storing them when absent.

    A cache that cannot be written (read-only home, full disk) costs time, never the result.
    """
    try:
        path = cache_dir() / kind / f"{key}.npz"
    except InputError as error:
        _log.warning("%s; continuing without a cache", error)
        return {name: np.asarray(value) for name, value in build().items()}
    found = _read(path)
    if found is not None:
        return found
    arrays = {name: np.asarray(value) for name, value in build().items()}
    try:
        stored = arrays | {_CONTENTS: np.array(_contents(arrays))}
        atomic_arrays(path, stored, compressed=False)
    except OSError as error:
        _log.warning("cannot write the cache file %s (%s); continuing without it", path, error)
    return arrays
