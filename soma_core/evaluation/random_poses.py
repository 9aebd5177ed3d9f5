"""Random poses and motions whose joints turn about as far as a person's do."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

__all__ = ["joint_spread", "random_axis_angles", "smooth_axis_angles"]

_SPREAD = (
    (r"Hips", 0.5),
    (r"Spine\d|Chest", 0.15),
    (r"Neck\d", 0.12),
    (r"Head", 0.25),
    (r"Jaw", 0.08),
    (r"(Left|Right)Eye", 0.15),
    (r"(Left|Right)Shoulder", 0.15),
    (r"(Left|Right)(Arm|ForeArm)", 0.6),
    (r"(Left|Right)Hand", 0.35),
    (r"(Left|Right)Hand\w+End", 0.0),
    (r"(Left|Right)Hand\w+\d", 0.25),
    (r"(Left|Right)(Leg|Shin)", 0.5),
    (r"(Left|Right)Foot", 0.25),
    (r"(Left|Right)ToeBase", 0.15),
)
"""Joint name pattern -> standard deviation [rad] about each axis; joints not listed stay at rest."""

_LONGEST = 1.6
"""Rotation vectors are cut to this angle [rad]."""

_HARMONICS, _RESTING, _SWAYING = 3, 0.36, 0.42
"""Of a smooth motion: harmonics of the clip; share of the spread in the resting angle and in the first."""


def joint_spread(names: Sequence[str]) -> np.ndarray:
    """Standard deviation [rad] of each joint's rotation vector, (J,)."""
    found = [
        next((spread for pattern, spread in _SPREAD if re.fullmatch(pattern, name)), 0.0) for name in names
    ]
    return np.array(found)


def random_axis_angles(names: Sequence[str], count: int, random: np.random.Generator) -> np.ndarray:
    """Rotation vectors [rad], (count, J, 3): normal about zero, T-pose-relative, at most 1.6 rad long."""
    return _cut(joint_spread(names)[:, None] * random.standard_normal((count, len(names), 3)))


def smooth_axis_angles(spread: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Rotation vectors [rad], (count, J, 3), of a motion that ends where it begins, at most 1.6 rad long.

    Each axis of each joint sways about a random resting angle in three harmonics of the whole clip.

    Args:
        spread: (J,) rad, how far each joint turns; about the standard deviation over clips.
        count: frames.
        random: source of the angles and phases.
    """
    shape = (len(spread), 3)
    clock = np.arange(count) / count
    value = np.tile(_RESTING * random.standard_normal(shape), (count, 1, 1))
    for harmonic in range(1, _HARMONICS + 1):
        height, phase = random.standard_normal(shape) / harmonic, random.uniform(size=shape)
        turns = harmonic * clock[:, None, None] + phase
        value += _SWAYING * height * np.sin(2 * np.pi * turns)
    return _cut(spread[:, None] * value)


def _cut(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors * np.minimum(1.0, _LONGEST / np.maximum(length, 1e-12))
