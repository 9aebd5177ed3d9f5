"""Fitted poses on disk, chunk by chunk, so that a run that was stopped goes on where it was."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.cache import atomic_text, atomic_write
from soma_core.errors import InputError
from soma_core.json_file import read_json

__all__ = ["FittedChunks", "refuse_other_settings"]


class FittedChunks:
    """One file a chunk in a folder that also says what they were made from.

    Args:
        folder: created if need be.
        settings: everything that the poses depend on, as plain values.
        frame_count, size: length of the sequence and of a chunk, in frames.

    Raises:
        InputError: the folder holds chunks that were made with other settings.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], *, frame_count: int, size: int) -> None:
        self.folder, self.frame_count, self.size = folder, frame_count, size
        self.ranges = [(start, min(start + size, frame_count)) for start in range(0, frame_count, size)]
        plan = json.loads(json.dumps({**settings, "chunk": size, "frames": frame_count}, default=str))
        file = folder / "settings.json"
        if file.is_file():
            refuse_other_settings(folder, read_json(file, fix=f"Delete {folder}."), plan)
            return
        for stale in folder.glob("*.npz"):  # nothing says what they were made from
            stale.unlink()
        atomic_text(file, json.dumps(plan, indent=2) + "\n")

    @property
    def open(self) -> bool:
        """Whether the folder still says what its chunks are made from: not once they were joined."""
        return (self.folder / "settings.json").is_file()

    def missing(self) -> list[int]:
        """Numbers of the chunks that are still to be made."""
        return [number for number in range(len(self.ranges)) if not self._readable(number)]

    def save(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Store a chunk; it is there whole or not at all."""

        def write(path: Path) -> None:
            with open(path, "wb") as stream:
                np.savez_compressed(stream, **arrays)

        atomic_write(self._file(number), write)

    def load(self, number: int, *names: str) -> tuple[np.ndarray, ...]:
        """The named arrays of a chunk that was stored."""
        with open(self._file(number), "rb") as stream, np.load(stream, allow_pickle=False) as file:
            return tuple(file[name] for name in names)

    def load_all(self, *names: str) -> Iterator[tuple[np.ndarray, ...]]:
        """The named arrays of each chunk, in the order of the frames."""
        for number in range(len(self.ranges)):
            yield self.load(number, *names)

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder)

    def _file(self, number: int) -> Path:
        return self.folder / f"{number:06d}.npz"

    def _readable(self, number: int) -> bool:
        return self._file(number).is_file() and zipfile.is_zipfile(self._file(number))


def refuse_other_settings(folder: Path, stored: Mapping[str, Any], plan: Mapping[str, Any]) -> None:
    """Refuse to go on with results of another configuration, which lie at `folder`.

    Raises:
        InputError: a setting differs; the first one is named with both values.
    """
    different = [key for key in {**stored, **plan} if stored.get(key) != plan.get(key)]
    if different:
        key = different[0]
        more = f" (and {', '.join(different[1:])})" if different[1:] else ""
        raise InputError(
            f"{key}{more}",
            got=f"{plan.get(key)!r}",
            expected=f"{stored.get(key)!r}, as in the run that {folder} belongs to",
            fix=f"Run in another folder, or delete {folder} to start over.",
        )
