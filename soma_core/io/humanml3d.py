"""Joints from the vectors of 263 numbers a frame that HumanML3D has."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from soma_core.errors import InputError

__all__ = ["joints_of_humanml3d"]


def joints_of_humanml3d(path: Path, data: np.ndarray) -> np.ndarray:
    """Joints (F, 22, 3) [m] of vectors (F, 263) of a file: +Y up, from the origin, facing +Z at first.

    Raises:
        InputError: the vectors are normalised.
    """
    turn = np.concatenate(([0.0], np.cumsum(data[:-1, 0])))  # half the angle about the vertical
    cosine, sine = np.cos(2 * turn), np.sin(2 * turn)

    def back(vectors: np.ndarray) -> np.ndarray:
        c, s = (one.reshape(-1, *[1] * (vectors.ndim - 2)) for one in (cosine, sine))
        x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
        return np.stack((c * x - s * z, y, s * x + c * z), -1)

    step = np.zeros((len(data), 3))
    step[1:, 0], step[1:, 2] = data[:-1, 1], data[:-1, 2]
    root = np.cumsum(back(step), axis=0)
    root[:, 1] = data[:, 3]
    joints = back(data[:, 4:67].reshape(len(data), 21, 3))
    joints[..., [0, 2]] += root[:, None, [0, 2]]
    height = float(np.median(data[:, 3]))
    if not 0.05 < abs(height) < 3:
        raise InputError(
            str(path), got=f"a median height of {height:.3g} in the fourth number",
            expected="HumanML3D's vectors in metres", fix="Undo the normalisation first: data * std + mean.",
        )  # fmt: skip
    return np.concatenate((root[:, None], joints), 1)
