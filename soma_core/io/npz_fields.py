"""Checked access to an NPZ file: every refusal names the key, what it holds and what was expected."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from soma_core.errors import InputError
from soma_core.files import FARTHEST
from soma_core.npz import NpzFile, open_npz_file

__all__ = ["NpzFields", "check_rotations", "open_npz", "say_overridden"]

ORTHONORMAL_TOLERANCE = 1e-3
"""Largest entry of |RᵀR - I| accepted; half-precision files reach 5e-4, a scaled matrix does not pass."""


_SAME_RATE = 2e-3
"""Relative difference of frame rates that are the same, as 29.97 and 30 are."""

_log = logging.getLogger(__name__)


class NpzFields:
    """The named arrays of one NPZ file, read on demand and never unpickled."""

    def __init__(self, file: NpzFile) -> None:
        self.path = file.path
        self._file = file

    @property
    def names(self) -> tuple[str, ...]:
        """Keys of the file in the order they were stored."""
        return self._file.names

    def __contains__(self, key: str) -> bool:
        return key in self._file.names

    def refuse(self, key: str, *, got: object, expected: object, fix: str) -> InputError:
        """Make the error that names this file and `key`."""
        return InputError(f"{self.path}: {key}", got=got, expected=expected, fix=fix)

    def raw(self, key: str) -> np.ndarray:
        """Array under `key` as stored; refuses a missing key and pickled objects."""
        if key not in self:
            raise self.refuse(
                key,
                got=f"only the keys {', '.join(self.names)}",
                expected=f"a key '{key}'",
                fix="Write the file again with that key.",
            )
        try:
            return self._file.read(key)
        except ValueError as error:
            raise self.refuse(
                key,
                got=f"an unreadable array ({error})",
                expected="a plain numeric or text array",
                fix="Fetch it again, or write it without Python objects.",
            ) from error

    def numbers(self, key: str, shape: tuple[int | str, ...]) -> np.ndarray:
        """Numbers of a body under `key` as float64; `shape` gives fixed sizes as ints, free ones as names."""
        array = self.raw(key)
        fits = array.ndim == len(shape) and all(
            isinstance(want, str) or have == want for have, want in zip(array.shape, shape, strict=False)
        )
        wanted = "(" + ", ".join(map(str, shape)) + ")"
        if not fits or array.dtype.kind not in "fiub":
            raise self.refuse(
                key,
                got=f"shape {array.shape}, dtype {array.dtype}",
                expected=f"numbers of shape {wanted}",
                fix="Write the array in that layout.",
            )
        values = array.astype(np.float64)
        bad = np.argwhere(~(np.abs(values) <= FARTHEST))
        if len(bad):
            raise self.refuse(
                key,
                got=f"{values[tuple(bad[0])]} at index {tuple(map(int, bad[0]))}",
                expected=f"finite numbers up to {FARTHEST:g}",
                fix="Remove or interpolate the damaged frames.",
            )
        return values

    def number(self, key: str) -> float:
        """One finite number under `key`; an array of one entry counts."""
        array = self.raw(key)
        if array.size != 1:
            raise self.refuse(
                key, got=f"shape {array.shape}", expected="one number", fix="Store a single value."
            )
        return float(self.numbers(key, array.shape).reshape(-1)[0])

    def texts(self, key: str) -> tuple[str, ...]:
        """Texts under `key`, bytes decoded as UTF-8; a single text gives a tuple of one."""
        array = self.raw(key)
        if array.dtype.kind not in "SU":
            raise self.refuse(
                key, got=f"dtype {array.dtype}", expected="text", fix="Store the text as a string array."
            )
        values = array.reshape(-1).tolist()
        return tuple(
            value.decode(errors="replace") if isinstance(value, bytes) else value for value in values
        )

    def text(self, key: str, default: str | None = None) -> str:
        """One text under `key`, or `default` where the key is absent and a default is given."""
        if key not in self and default is not None:
            return default
        values = self.texts(key)
        if len(values) != 1:
            raise self.refuse(
                key, got=f"{len(values)} texts", expected="one text", fix="Store a single string."
            )
        return values[0]


def say_overridden(path: Path, setting: str, *, given: float | str, own: float | str) -> None:
    """Warn where a setting of a person takes the place of what a file says itself."""
    if isinstance(given, str) or isinstance(own, str):
        same = given == own
    else:
        same = abs(given - own) <= _SAME_RATE * own
    if not same:
        told = [each if isinstance(each, str) else f"{each:g}" for each in (given, own)]
        _log.warning("%s: %s=%s is taken in place of the file's own, %s", path.name, setting, *told)


@contextmanager
def open_npz(path: str | Path) -> Iterator[NpzFields]:
    """Open an NPZ file for checked reading.

    Raises:
        AssetError: the file is missing, truncated, a git-LFS pointer or not an NPZ.
    """
    with open_npz_file(path, fix="Give a complete .npz file.") as file:
        yield NpzFields(file)


def check_rotations(argument: str, matrices: np.ndarray) -> None:
    """Refuse matrices (frames, joints, 3, 3) that are no rotations, naming the worst frame and joint."""
    gram = np.swapaxes(matrices, -1, -2) @ matrices
    error = np.abs(gram - np.eye(3)).max(axis=(-1, -2))
    error = np.where(np.linalg.det(matrices) > 0, error, np.inf)
    worst = np.unravel_index(int(error.argmax()), error.shape) if error.size else ()
    if error.size and error[worst] > ORTHONORMAL_TOLERANCE:
        where = "frame {}, joint {}".format(*map(int, worst))
        kind = "a reflection" if np.isinf(error[worst]) else f"|RᵀR - I| = {error[worst]:.3g}"
        raise InputError(
            argument,
            got=f"{kind} at {where}",
            expected=f"rotation matrices (|RᵀR - I| <= {ORTHONORMAL_TOLERANCE:g}, determinant +1)",
            fix="Store rotations without scale or shear.",
        )
