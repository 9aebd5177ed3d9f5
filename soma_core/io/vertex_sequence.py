"""Vertices over time, read a few frames at once: what every reader of meshes gives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Literal

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.files import refuse_far

__all__ = ["UpAxis", "VertexSequence", "even_rate"]

UpAxis = Literal["+y", "+z", "-y", "-z"]
"""Upward axis of a world; -y is that of a camera's axes."""

_SPACING_TOLERANCE = 1e-2
"""Largest departure of a time step from the others, relative: times are stored in float32."""


class VertexSequence(ABC):
    """Vertices of one mesh over time, in the order of the file, in its unit and axes.

    A sequence may hold its file open: use it in a ``with`` statement or call ``close``.

    Attributes:
        path: where it comes from.
        frame_count, vertex_count: its size.
        fps: frames per second; None where the file does not say.
        metres: length of one unit [m]; None where the file does not say.
        up: upward axis; None where the file does not say.
    """

    def __init__(
        self,
        path: Path,
        frame_count: int,
        vertex_count: int,
        *,
        fps: float | None = None,
        metres: float | None = None,
        up: UpAxis | None = None,
    ) -> None:
        if frame_count < 1 or vertex_count < 1:
            raise AssetError(
                path,
                cause=f"holds {frame_count} frames of {vertex_count} vertices",
                fix="Export at least one frame of the body.",
            )
        self.path, self.frame_count, self.vertex_count = path, int(frame_count), int(vertex_count)
        self.fps, self.metres, self.up = fps, metres, up

    def read(self, start: int, stop: int) -> np.ndarray:
        """Vertices (stop - start, n, 3) of a range of frames, float32 or float64, in C order.

        Raises:
            InputError: the range is empty or leaves the sequence.
            AssetError: the file is damaged there, or has a vertex where no body is.
        """
        if not 0 <= start < stop <= self.frame_count:
            raise InputError(
                "frames",
                got=f"{start} to {stop}",
                expected=f"a range inside the {self.frame_count} frames",
                fix="Give start and stop inside the sequence.",
            )
        vertices = self._read(start, stop)
        refuse_far(self.path, vertices)
        return vertices

    @abstractmethod
    def _read(self, start: int, stop: int) -> np.ndarray:
        """Read frames that exist."""

    def close(self) -> None:  # noqa: B027 - most readers hold nothing open
        """Let go of the file."""

    def __enter__(self) -> VertexSequence:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def even_rate(path: Path, seconds: np.ndarray) -> float | None:
    """Frame rate of sample times [s] that must be evenly spaced; None for a single one."""
    if len(seconds) < 2:
        return None
    steps = np.diff(np.asarray(seconds, np.float64))
    typical = float(np.median(steps))
    if typical <= 0 or np.abs(steps / typical - 1).max() > _SPACING_TOLERANCE:
        worst = int(np.abs(steps - typical).argmax())
        raise InputError(
            f"{path}: times",
            got=f"a step of {steps[worst]:.6g} s after sample {worst} where others are {typical:.6g} s",
            expected="evenly spaced samples",
            fix="Bake the animation to one sample a frame.",
        )
    return round(1 / typical, 3)
