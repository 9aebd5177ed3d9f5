"""Local transforms of joints, correctly rounded: the same bits on every machine."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

__all__ = ["local_transforms"]

_Matrix = list[list[Fraction]]


def _inverse_affine(matrix: _Matrix) -> _Matrix:
    """Invert a 4x4 affine matrix exactly, by cofactors of its 3x3 part."""
    a = [row[:3] for row in matrix[:3]]
    cofactor = [
        [
            a[(i + 1) % 3][(j + 1) % 3] * a[(i + 2) % 3][(j + 2) % 3]
            - a[(i + 1) % 3][(j + 2) % 3] * a[(i + 2) % 3][(j + 1) % 3]
            for j in range(3)
        ]
        for i in range(3)
    ]
    determinant = sum(a[0][j] * cofactor[0][j] for j in range(3))
    linear = [[cofactor[j][i] / determinant for j in range(3)] for i in range(3)]
    shift = [-sum(linear[i][j] * matrix[j][3] for j in range(3)) for i in range(3)]
    return [[*linear[i], Fraction(shift[i])] for i in range(3)] + [[Fraction(0)] * 3 + [Fraction(1)]]


def local_transforms(world: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Return local transforms ``inv(world[parent]) @ world``, correctly rounded.

    Args:
        world: (J, 4, 4) affine, column vectors.
        parents: (J,) int, -1 for a root.
    """
    exact = [[[Fraction(value) for value in row] for row in matrix] for matrix in world.tolist()]
    local = np.array(world, np.float64)
    for joint, parent in enumerate(parents.tolist()):
        if parent < 0:
            continue
        inverse = _inverse_affine(exact[parent])
        for i in range(4):
            for j in range(4):
                local[joint, i, j] = float(sum(inverse[i][k] * exact[joint][k][j] for k in range(4)))
    return local
