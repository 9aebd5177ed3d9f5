"""Joint transforms at the asset boundary: local ones to world, and rotations made exact.

World transforms are composed with plain scalar arithmetic instead of BLAS, so that the same file gives the
same bits, and the same rig hash, on every machine.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from soma_core.geometry.tree import depth_order

__all__ = ["fused_product", "project_rotations", "world_transforms"]


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
