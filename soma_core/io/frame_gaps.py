"""Frames that a tool did not see: filled from their neighbours, or left out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from soma_core.errors import InputError

__all__ = ["fill_gaps", "kept_frames"]

_LONGEST_CLIP = 10_000_000
"""Frames that numbers of frames may span."""


def kept_frames(whole: np.ndarray, numbers: np.ndarray | None, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows that hold a frame, in the order of time, and their frame numbers from the first on.

    Args:
        whole: (rows,) which rows are finite.
        numbers: (rows,) frame of each row, in any order; None: one after the other.
        name: of the file, for the error.

    Raises:
        InputError: no row is whole, or frames are numbered twice or far apart.
    """
    times = np.arange(len(whole)) if numbers is None else np.asarray(numbers, np.int64)
    rows = np.flatnonzero(whole)
    if not len(rows):
        raise InputError(
            name, got="NaN or infinity in every frame", expected="finite numbers",
            fix="Choose another person or another file: the tool saw nothing here.",
        )  # fmt: skip
    rows = rows[np.argsort(times[rows], kind="stable")]
    times = times[rows] - times[rows[0]]
    if (np.diff(times) == 0).any() or times[-1] > _LONGEST_CLIP:
        twice = int(times[:-1][np.diff(times) == 0][0]) if (np.diff(times) == 0).any() else None
        got = f"frame {twice} twice" if twice is not None else f"frames up to {int(times[-1])}"
        raise InputError(
            name, got=got, expected="one row a frame",
            fix="Choose one person of the file, if it holds several.",
        )  # fmt: skip
    return rows, times


def fill_gaps(
    rotations: np.ndarray, others: Sequence[np.ndarray], times: np.ndarray
) -> tuple[np.ndarray, list]:
    """Rotations (n, joints, 3) and other values (n, ...) at every frame from the first of `times` on.

    Rotations go along the shortest arc, others along straight lines.
    """
    wanted = np.arange(times[-1] + 1)
    joints = [
        Slerp(times, Rotation.from_rotvec(column))(wanted).as_rotvec() for column in rotations.swapaxes(0, 1)
    ]
    kept = np.stack(joints, axis=1)
    kept[times] = rotations  # to the bit, and not by another turn around
    filled = []
    for values in others:
        flat = values.reshape(len(values), -1)
        columns = [np.interp(wanted, times, column) for column in flat.T]
        filled.append(np.stack(columns, axis=1).reshape(len(wanted), *values.shape[1:]))
    return kept, filled
