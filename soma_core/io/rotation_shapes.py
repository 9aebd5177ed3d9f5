"""Rotations of joints as any of their usual numbers, told by the shape, to axis-angle vectors."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["WIDTHS", "RotationLayout", "axis_angles", "split_shape"]

RotationLayout = Literal["wxyz", "xyzw", "rows", "columns"]
"""Order of quaternions, and whether six or nine numbers are rows or columns of a matrix."""

WIDTHS = (3, 4, 6, 9)
"""Numbers of one rotation: a vector, a quaternion, two rows or columns, a matrix."""

_LARGEST = 1e6
"""Angle [rad] that no file means, degrees neither."""

_ROTATION_TOLERANCE = 0.02
"""Largest entry of |RᵀR - I| accepted of matrices, and departure of a norm from 1: estimators store half
precision and means of rotations; a scaled matrix does not pass."""

_REST = 0.75
"""Median real part of the joints of a person: half a turn of most joints is none's pose."""


def split_shape(shape: tuple[int, ...], joints: Sequence[int]) -> tuple[tuple[int, ...], int, int] | None:
    """Leading axes, joints and numbers a joint of an array of rotations; None where the shape is none's.

    Args:
        shape: of the array; joints and numbers may share an axis.
        joints: numbers of joints that are possible.
    """
    for count, width in itertools.product(joints, WIDTHS):
        for tail in ((count * width,), (count, width), *([(count, 3, 3)] if width == 9 else [])):
            lead = shape[: -len(tail)]
            if shape[-len(tail) :] == tail and len(lead) <= 2 and 0 not in shape:
                return lead, count, width
    return None


def axis_angles(values: np.ndarray, width: int, layout: RotationLayout | None) -> tuple[np.ndarray, str]:
    """Axis-angle vectors (n, joints, 3) [rad] of rotations (n, joints, width), and what they were taken for.

    Args:
        values: finite, or NaN where a frame is missing, which stays so.
        width: 3 vectors, 4 quaternions, 6 numbers of a matrix, 9 matrices.
        layout: of quaternions and of six numbers, None to tell it; ``columns`` of matrices that are stored
            column by column, and of vectors that were made of such.

    Raises:
        ValueError: no rotations, or a layout that cannot be told; the text says which.
    """
    if width == 3:
        if np.nanmax(np.abs(values), initial=0) > _LARGEST:
            raise ValueError(f"angles of up to {np.nanmax(np.abs(values)):.3g} rad")
        return (-values if layout == "columns" else values), "axis-angle"
    flat = values.reshape(-1, width)
    whole = np.isfinite(flat).all(axis=1)
    if not whole.any():
        return np.full((*values.shape[:-1], 3), np.nan), "unknown"
    if width == 4:
        rotations, told = _from_quaternions(flat[whole], layout)
    elif width == 6:
        rotations, told = _from_six(flat[whole], layout)
    else:
        matrices = flat[whole].reshape(-1, 3, 3)
        matrices = matrices.swapaxes(1, 2) if layout == "columns" else matrices
        _refuse_no_rotations(matrices)
        rotations, told = Rotation.from_matrix(matrices), "matrices"
    found = np.full((len(flat), 3), np.nan)
    found[whole] = rotations.as_rotvec()
    return found.reshape(*values.shape[:-1], 3), told


def _from_quaternions(values: np.ndarray, layout: RotationLayout | None) -> tuple[Rotation, str]:
    norms = np.linalg.norm(values, axis=1)
    if np.abs(norms - 1).max() > _ROTATION_TOLERANCE:
        raise ValueError(
            f"four numbers of norm {norms[np.abs(norms - 1).argmax()]:.3g} a joint, no quaternions"
        )
    real = {name: float(np.median(np.abs(values[:, place]))) for name, place in (("wxyz", 0), ("xyzw", 3))}
    told = layout if layout in real else max(real, key=lambda name: real[name])
    if layout not in real and (real[told] < _REST or min(real.values()) > _REST / 2):
        raise ValueError("quaternions whose order cannot be told; pass rotation_layout=wxyz or xyzw")
    return Rotation.from_quat(
        values if told == "xyzw" else np.roll(values, -1, axis=1)
    ), f"quaternions {told}"


def _from_six(values: np.ndarray, layout: RotationLayout | None) -> tuple[Rotation, str]:
    """Two rows or columns one after the other, or three rows of two, as their right angles tell."""
    pairs = {"together": values.reshape(-1, 2, 3), "interleaved": values.reshape(-1, 3, 2).swapaxes(1, 2)}
    square = {
        name: np.median(np.abs((pair[:, 0] * pair[:, 1]).sum(1)) + np.abs((pair**2).sum(2) - 1).sum(1))
        for name, pair in pairs.items()
    }
    columns = layout == "columns" or (layout != "rows" and square["interleaved"] < square["together"])
    interleaved = layout is None and columns
    if layout == "columns":
        interleaved = square["interleaved"] < square["together"]
    pair = pairs["interleaved" if interleaved else "together"]
    first = pair[:, 0] / np.maximum(np.linalg.norm(pair[:, 0], axis=1, keepdims=True), 1e-12)
    second = pair[:, 1] - (first * pair[:, 1]).sum(1, keepdims=True) * first
    size = np.linalg.norm(second, axis=1, keepdims=True)
    if (size < 1e-6).any():
        raise ValueError("six numbers a joint that are no two directions")
    second = second / size
    matrices = np.stack([first, second, np.cross(first, second)], axis=2 if columns else 1)
    return Rotation.from_matrix(matrices), f"6D, the first two {'columns' if columns else 'rows'} of a matrix"


def _refuse_no_rotations(matrices: np.ndarray) -> None:
    error = np.abs(matrices.swapaxes(1, 2) @ matrices - np.eye(3)).max(axis=(1, 2))
    worst = int(error.argmax())
    if error[worst] > _ROTATION_TOLERANCE or (np.linalg.det(matrices) < 0).any():
        raise ValueError(f"nine numbers a joint that are no rotation (|RᵀR - I| up to {error[worst]:.3g})")
