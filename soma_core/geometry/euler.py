"""Euler angles of rotation matrices and back, in any order of three axes; numpy, not differentiable."""

from __future__ import annotations

import numpy as np

__all__ = ["axis_rotation", "euler_from_matrices", "matrices_from_euler"]

_LOCKED = 1e-7
"""Cosine of the middle angle under which the outer two turn about one axis."""


def axis_rotation(axis: int, angle: np.ndarray) -> np.ndarray:
    """Rotations about a coordinate axis by `angle` [rad]; (...) -> (..., 3, 3)."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    cosine, sine = np.cos(angle), np.sin(angle)
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., axis, axis] = 1
    matrix[..., first, first] = matrix[..., second, second] = cosine
    matrix[..., first, second], matrix[..., second, first] = -sine, sine
    return matrix


def matrices_from_euler(angles: np.ndarray, order: str, out: np.ndarray | None = None) -> np.ndarray:
    """Product of rotations about the axes of `order`, the first leftmost; [rad] (..., n) -> (..., 3, 3)."""
    matrix = np.empty((*angles.shape[:-1], 3, 3)) if out is None else out
    if len({*order}) == 3:
        _three_axes(angles, order, matrix)
        return matrix
    product = np.broadcast_to(np.eye(3), matrix.shape)
    for place, letter in enumerate(order):
        turn = axis_rotation("XYZ".index(letter), angles[..., place])
        product = turn if place == 0 else product @ turn
    matrix[...] = product
    return matrix


def _three_axes(angles: np.ndarray, order: str, matrix: np.ndarray) -> None:
    """The product written out; in an odd order of axes angles count the other way."""
    i, j, k = ("XYZ".index(letter) for letter in order)
    angles = np.moveaxis(angles, -1, 0)
    sine, cosine = np.sin(angles), np.cos(angles)
    (sa, sb, sc), (ca, cb, cc) = sine if (j - i) % 3 == 1 else -sine, cosine
    both, mixed = sa * sb, ca * sb
    matrix[..., i, i], matrix[..., i, j], matrix[..., i, k] = cb * cc, -cb * sc, sb
    matrix[..., j, i], matrix[..., j, j], matrix[..., j, k] = (
        ca * sc + both * cc, ca * cc - both * sc, -sa * cb,
    )  # fmt: skip
    matrix[..., k, i], matrix[..., k, j], matrix[..., k, k] = (
        sa * sc - mixed * cc, sa * cc + mixed * sc, ca * cb,
    )  # fmt: skip


def euler_from_matrices(matrices: np.ndarray, order: str) -> np.ndarray:
    """Angles [rad] about three different axes, continuous along the first dimension.

    ``R = R_a(angles[0]) R_b(angles[1]) R_c(angles[2])`` for the `order` ``abc``. Of the two triples that give
    a rotation the one nearer to the frame before is taken, and whole turns are added so that no angle jumps.
    Where the middle angle is a quarter turn only the sum of the outer two is defined: the last one keeps the
    value that it had.

    Args:
        matrices: (frames, ..., 3, 3) rotations.
        order: three different letters of XYZ.
    """
    i, j, k = ("XYZ".index(letter) for letter in order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    last = np.arctan2(-sign * matrices[..., i, j], matrices[..., i, i])
    last = _held(last, np.hypot(matrices[..., i, i], matrices[..., i, j]) < _LOCKED)
    # The other two from what is left without the last turn: rounding near a quarter turn then cancels.
    rest = matrices @ np.swapaxes(axis_rotation(k, last), -1, -2)
    first = np.arctan2(sign * rest[..., k, j], rest[..., j, j])
    middle = np.arctan2(sign * rest[..., i, k], rest[..., i, i])
    found = np.stack([first, middle, last], -1)
    other = np.stack([first + np.pi, np.pi - middle, last + np.pi], -1)
    return np.asarray(np.unwrap(np.where(_switched(found, other)[..., None], other, found), axis=0))


def _held(values: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """Values over frames; an unknown one keeps the last that was known, 0 before any."""
    frames = np.arange(len(values)).reshape(-1, *[1] * (values.ndim - 1))
    known = np.maximum.accumulate(np.where(unknown, -1, frames), axis=0)
    return np.where(known < 0, 0.0, np.take_along_axis(values, np.maximum(known, 0), axis=0))


def _switched(found: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Where `other` continues the frame before: both forms are equally far apart, so switches add up."""

    def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (((a - b + np.pi) % (2 * np.pi) - np.pi) ** 2).sum(-1)

    switch = apart(found[:-1], other[1:]) < apart(found[:-1], found[1:])
    state = np.zeros(found.shape[:-1], bool)
    state[1:] = np.cumsum(switch, axis=0) % 2 == 1
    return state
