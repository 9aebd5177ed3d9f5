"""A pinhole camera, read from a small JSON file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.json_file import read_json

__all__ = ["Camera", "read_camera", "read_cameras"]

_NEEDED, _SIZE = ("fx", "fy", "cx", "cy", "extrinsics"), ("width", "height")
_EXAMPLE = '{"fx": 1000, "fy": 1000, "cx": 640, "cy": 360, "extrinsics": [[1,0,0,0],[0,-1,0,1],[0,0,-1,3]]}'

_RIGID = 1e-4
"""Largest entry of |RᵀR - I| accepted: a file with four digits passes, a matrix that also scales does not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """A pinhole without distortion; its axes are those of OpenCV: x to the right, y down, z along the view.

    Attributes:
        intrinsics: (3, 3) [px].
        extrinsics: (1 or frames, 4, 4) world to camera [m].
        size: width and height of the picture [px], if known.
    """

    intrinsics: np.ndarray
    extrinsics: np.ndarray
    size: tuple[float, float] | None = None

    def project(self, points: np.ndarray, start: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels (f, J, 2), depths (f, J) [m] and what is in sight (f, J) of world points (f, J, 3) [m].

        Pixels of what is not before the camera are NaN.

        Args:
            points: of consecutive frames.
            start: the first one's number, for a camera that moves.
        """
        moves = len(self.extrinsics) > 1
        view = self.extrinsics[start : start + len(points)] if moves else self.extrinsics
        there = points.astype(np.float64) @ view[:, :3, :3].swapaxes(-1, -2) + view[:, None, :3, 3]
        depth = there[..., 2]
        before = depth > 0
        flat = np.where(before[..., None], there, np.nan)
        pixels = (flat / flat[..., 2:]) @ self.intrinsics[:2].T
        visible = before
        if self.size is not None:
            visible = before & (pixels >= 0).all(-1) & (pixels < np.array(self.size)).all(-1)
        return pixels.astype(np.float32), depth.astype(np.float32), visible


def read_camera(path: str | Path) -> Camera:
    """Read a camera: ``fx``, ``fy``, ``cx``, ``cy`` [px], ``extrinsics``, and ``width``, ``height`` if known.

    ``extrinsics`` is a matrix of 3 or 4 rows that takes the world [m] to the camera, or a list of as many
    as the motion has frames.

    Raises:
        AssetError: the file is missing or no JSON object.
        InputError: a key is missing or strange, or holds what a camera cannot have.
    """
    path = Path(path).expanduser()
    return _camera(path, read_json(path, fix=f"Write a camera such as {_EXAMPLE}"))


def read_cameras(path: str | Path) -> tuple[Camera, ...]:
    """Read one camera, or a list of several that see the same.

    Raises:
        AssetError, InputError: as :func:`read_camera`.
    """
    path = Path(path).expanduser()
    values = read_json(path, fix=f"Write a camera such as {_EXAMPLE}, or a list of them")
    listed = values if isinstance(values, list) and values else [values]
    return tuple(_camera(path, one) for one in listed)


def _camera(path: Path, values: Any) -> Camera:
    if not isinstance(values, dict):
        raise AssetError(path, cause="no JSON object", fix=f"Write {_EXAMPLE}")
    missing = [key for key in _NEEDED if key not in values]
    strange = [key for key in values if key not in (*_NEEDED, *_SIZE)]
    if missing or strange or len([key for key in _SIZE if key in values]) == 1:
        got = (
            f"no {missing[0]}"
            if missing
            else f"the key {strange[0]}"
            if strange
            else "a width or a height alone"
        )
        raise InputError(
            f"{path}: camera", got=got,
            expected=f"{', '.join(_NEEDED)}, and {' and '.join(_SIZE)} or neither",
            fix=f"Write {_EXAMPLE}; distortion is not modelled.",
        )  # fmt: skip
    fx, fy, cx, cy = (_number(path, key, values[key], positive=key[0] == "f") for key in _NEEDED[:4])
    size = [_number(path, key, values[key], positive=True) for key in _SIZE if key in values]
    return Camera(
        intrinsics=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        extrinsics=_extrinsics(path, values["extrinsics"]),
        size=(size[0], size[1]) if size else None,
    )


def _number(path: Path, key: str, value: Any, *, positive: bool) -> float:
    usable = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
    if not usable or (positive and value <= 0):
        expected = "a positive number" if positive else "a number"
        raise InputError(f"{path}: {key}", got=repr(value)[:40], expected=expected, fix="Give it in pixels.")
    return float(value)


def _extrinsics(path: Path, value: Any) -> np.ndarray:
    """Matrices (k, 4, 4) world to camera."""
    try:
        given = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        given = np.empty(0)
    given = given[None] if given.ndim == 2 else given
    if (
        given.ndim != 3
        or given.shape[1:] not in ((3, 4), (4, 4))
        or not np.isfinite(given).all()
        or not len(given)
    ):
        raise InputError(
            f"{path}: extrinsics", got=f"shape {given.shape}",
            expected="a 3 x 4 or 4 x 4 matrix, or one a frame",
            fix="Give rotation and translation, world to camera, in metres.",
        )  # fmt: skip
    turns = given[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        wrong = np.abs(turns.swapaxes(1, 2) @ turns - np.eye(3)).max()
    rigid = bool(wrong <= _RIGID)
    if not rigid or np.linalg.det(turns).min() < 0:
        got = "a reflection" if rigid else f"no rotation (|RᵀR - I| = {wrong:.3g})"
        raise InputError(
            f"{path}: extrinsics", got=got, expected="a rotation and a translation",
            fix="Take scale and mirrored axes out of the matrix.",
        )  # fmt: skip
    whole = np.tile(np.eye(4), (len(given), 1, 1))
    whole[:, :3] = given[:, :3]
    return whole
