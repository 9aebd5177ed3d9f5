"""Checked values of the parts of one body in a file: every refusal names the key in the file."""

from __future__ import annotations

from typing import Any

import numpy as np

from soma_core.errors import InputError
from soma_core.files import FARTHEST
from soma_core.io.data_files import DataFile
from soma_core.io.smpl_bodies import FoundBody
from soma_core.io.smpl_names import PARTS

__all__ = ["BodyParts"]


class BodyParts:
    """Values of one body, by the names of parts.

    Args:
        file: where they are.
        body: which of its values they are.
    """

    def __init__(self, file: DataFile, body: FoundBody) -> None:
        self.file, self.body = file, body

    def __contains__(self, part: str) -> bool:
        return part in self.body.parts

    def key(self, part: str) -> str:
        """Where a part is in the file, or what it would be called."""
        return self.body.parts[part][0] if part in self else PARTS[part][0]

    def where(self, part: str) -> str:
        """File and key of a part, for errors."""
        return f"{self.file.path}: {self.key(part)}"

    def refuse(self, part: str, *, got: object, expected: object, fix: str) -> InputError:
        """Make the error that names the file and the key of a part."""
        return InputError(self.where(part), got=got, expected=expected, fix=fix)

    def raw(self, part: str) -> np.ndarray:
        """Array of a part, of this person where there are several."""
        value = self.body.parts[part][1]
        index, count = self.body.index, self.body.count
        if index is not None and isinstance(value, (list, tuple)) and len(value) == count:
            value = value[index]
        try:
            array = self.file.array(value)
        except ValueError as error:
            raise self.refuse(
                part, got=f"an unreadable array ({error})", expected="a plain numeric or text array",
                fix="If you trust the file, load it where it was written and save plain arrays: np.savez.",
            ) from error  # fmt: skip
        if index is not None and array.ndim and len(array) == count and value is self.body.parts[part][1]:
            array = array[index]
        return array

    def numbers(self, part: str) -> np.ndarray:
        """Numbers of a part as float64; those that are missing stay NaN, and those that cannot be are."""
        array = self.raw(part)
        if array.dtype.kind not in "fiub":
            raise self.refuse(
                part, got=f"shape {array.shape}, dtype {array.dtype}", expected="numbers",
                fix="Save it as numbers.",
            )  # fmt: skip
        return np.where(np.abs(values := array.astype(np.float64)) <= FARTHEST, values, np.nan)

    def rows(self, part: str, frames: int, width: int) -> np.ndarray:
        """Numbers (frames, width) of a part, whatever axes of one stand between; one row counts for all."""
        values = self.numbers(part)
        if self.body.time_last and values.ndim == 2 and values.shape == (width, frames):
            values = values.T
        if values.size == width:
            return np.broadcast_to(values.reshape(1, width), (frames, width)).copy()
        kept = tuple(size for size in values.shape if size != 1)
        if values.size != frames * width or kept not in (
            (frames, width),
            (width,),
            (frames * width,),
            (frames,),
        ):
            raise self.refuse(
                part, got=f"shape {values.shape}", expected=f"{width} numbers a frame, ({frames}, {width})",
                fix="Check that all keys of the file have the same number of frames.",
            )  # fmt: skip
        return values.reshape(frames, width)

    def betas(self, frames: int) -> np.ndarray:
        """Rows (1 or frames, k) of shape coefficients."""
        values = self.numbers("betas")
        width = values.shape[-1] if values.ndim else 1
        rows = values.reshape(-1, width) if width else np.zeros((1, 0))
        fits = values.ndim <= 2 or sum(size != 1 for size in values.shape[:-1]) <= 1
        if len(rows) in (1, frames) and fits:
            return rows
        got = f"shape {values.shape}" if not fits or values.ndim > 2 else f"{len(rows)} rows"
        raise self.refuse(
            "betas", got=got, expected=f"one row of shape coefficients, or one a frame ({frames})",
            fix="Pass betas=[0,0,0] (or the true ones).",
        )  # fmt: skip

    def expression(self, frames: int) -> np.ndarray:
        """Rows (frames, k) of coefficients of the face, missing ones zero; k = 0 where none can be read."""
        try:
            values = np.nan_to_num(self.numbers("expression")) if "expression" in self else np.zeros(0)
        except InputError:
            values = np.zeros(0)
        rows = values.reshape(-1, values.shape[-1]) if values.size and values.ndim else np.zeros((1, 0))
        if len(rows) not in (1, frames):
            return np.zeros((frames, 0))
        return np.broadcast_to(rows, (frames, rows.shape[1]))

    def number(self, part: str) -> float:
        """One number of a part."""
        values = self.numbers(part)
        if values.size != 1:
            raise self.refuse(
                part, got=f"shape {values.shape}", expected="one number", fix="Pass it as a setting instead."
            )
        return float(values.reshape(-1)[0])

    def text(self, part: str) -> str:
        """One text of a part."""
        array = self.raw(part).reshape(-1)
        if array.dtype.kind not in "SU" or array.size < 1 or len(set(array.tolist())) > 1:
            raise self.refuse(
                part, got=f"{array.size} values of dtype {array.dtype}", expected="one text",
                fix=f"Pass {part}= as a setting.",
            )  # fmt: skip
        value: Any = array[0]
        return value.decode(errors="replace") if isinstance(value, bytes) else str(value)

    def flag(self, part: str, *, default: bool) -> bool:
        """Whether a part says yes."""
        return bool(self.number(part)) if part in self else default

    def frame_numbers(self, frames: int) -> np.ndarray | None:
        """Number of the frame of each row, where the file tells."""
        if "frames" not in self:
            return None
        try:
            values = self.raw("frames")
        except InputError:
            return None  # names of pictures, and whatever else is called so
        if values.dtype.kind not in "iu" or values.size != frames or np.ptp(values) == 0:
            return None
        return values.reshape(-1)
