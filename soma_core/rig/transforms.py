"""Joint transforms at the asset boundary: local and world, and rotations made exact.

Local and world transforms are converted with correctly rounded or plain scalar arithmetic instead
of BLAS, so that the same file gives the same bits, and the same rig hash, on every machine.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from soma_core.geometry.tree import depth_order

__all__ = ["fused_product", "local_transforms", "project_rotations", "world_transforms"]

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


def fused_product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return ``left @ right``, terms added in order and each rounded once, as a chain of fused multiply-adds.

    So the shipped rig was made. BLAS gives these bits or others, by the kernel it has for a processor.

    Args:
        left: (m, n) finite; zeros are skipped.
        right: (n, k) finite.
    """
    product = np.zeros((len(left), right.shape[1]))
    factors = right.tolist()
    for row, weights in enumerate(left.tolist()):
        for weight, values in zip(weights, factors, strict=True):
            if weight:
                product[row] = [
                    float(Fraction(weight) * Fraction(value) + Fraction(sum_before))
                    for sum_before, value in zip(product[row].tolist(), values, strict=True)
                ]
    return product


def world_transforms(local: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Compose ``world = world[parent] @ local`` down the tree in a fixed order of additions."""
    steps = local.tolist()
    world: list[list[list[float]]] = [[] for _ in steps]
    for joint in depth_order(parents).tolist():
        parent = int(parents[joint])
        if parent < 0:
            world[joint] = steps[joint]
            continue
        above, step = world[parent], steps[joint]
        world[joint] = [
            [
                row[0] * step[0][j] + row[1] * step[1][j] + row[2] * step[2][j] + row[3] * step[3][j]
                for j in range(4)
            ]
            for row in above
        ]
    return np.array(world, np.float64).reshape(-1, 4, 4)


def project_rotations(transforms: np.ndarray) -> np.ndarray:
    """Replace the 3x3 parts of (J, 4, 4) transforms by the nearest rotations (float64 SVD)."""
    left, _, right = np.linalg.svd(transforms[:, :3, :3].astype(np.float64))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    projected = np.array(transforms, np.float64)
    projected[:, :3, :3] = left @ right
    return projected
