"""What is asked of every file: that it is one and there, its size, and places that a body can have."""

from __future__ import annotations

import stat
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError

__all__ = ["FARTHEST", "refuse_far", "refuse_unreadable"]

FARTHEST = 1e9
"""Largest coordinate that is taken, in any unit: a thousand kilometres in millimetres. Squares of larger ones
leave what numbers hold."""

_LFS = b"version https://git-lfs"
_HEAD = 64
_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}  # fmt: skip


def refuse_unreadable(
    path: Path | str, *, fix: str = "Check the path.", most_bytes: int | None = None
) -> bytes:
    """Return the first bytes of a regular file that may be read, a link to one included.

    Pipes and devices, which can keep a reader waiting for ever, are refused without being opened.

    Args:
        path: the file.
        fix: what to do about a file that is not there.
        most_bytes: largest size accepted.

    Raises:
        AssetError: missing, closed to us, no regular file, a link that leads nowhere, empty, a git-LFS
            pointer, or larger than `most_bytes`.
    """
    try:
        found = Path(path).stat()
        if not stat.S_ISREG(found.st_mode):
            kind = _KINDS.get(stat.S_IFMT(found.st_mode), "no regular file")
            raise AssetError(path, cause=f"is {kind}, not a file", fix="Name the file itself.")
        with open(path, "rb") as stream:
            head = stream.read(_HEAD)
    except FileNotFoundError as error:
        link = Path(path).is_symlink()
        raise AssetError(
            path, cause="is a link to nothing" if link else "file is missing", fix=fix
        ) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        why = getattr(error, "strerror", None) or error
        raise AssetError(path, cause=f"cannot be read ({why})", fix=fix) from error
    if not head:
        raise AssetError(path, cause="file is empty", fix=fix)
    if head.startswith(_LFS):
        raise AssetError(
            path,
            cause="is a git-LFS pointer, not the file itself",
            fix="Run `git lfs install && git lfs pull` in the repository it came from.",
        )
    if most_bytes is not None and found.st_size > most_bytes:
        cause = f"holds {found.st_size} bytes, more than the {most_bytes} that such a file can have"
        raise AssetError(path, cause=cause, fix="Check that it is the right file.")
    return head


def refuse_far(path: Path | str, places: np.ndarray, what: str = "vertex") -> None:
    """Refuse coordinates (..., 3) where no body is; NaN, which marks a missing vertex, passes.

    Raises:
        AssetError: one is infinite or above :data:`FARTHEST`; `what` it is, and its number.
    """
    largest, least = places.max(initial=0), places.min(initial=0)
    if largest <= FARTHEST and least >= -FARTHEST:
        return
    far = np.argwhere(np.abs(places) > FARTHEST)
    if len(far):
        cause = f"{what} {far[0][-2] if places.ndim > 1 else 0} lies at {places[tuple(far[0])]:.3g}"
        raise AssetError(path, cause=f"damaged ({cause}, where no body is)", fix="Export it again.")
