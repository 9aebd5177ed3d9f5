"""Smooth local rotations of a skinned surface, in closed form: Direct Delta Mush."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy.sparse
import torch
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.sparse import sparse_product

__all__ = ["SurfaceFrames", "diffused"]

_SMALLEST = 1e-4
"""Smoothed weights below this are dropped."""

_PAIRS = tuple((row, column) for row in range(4) for column in range(row, 4))


def diffused(
    values: np.ndarray, laplacian: scipy.sparse.csr_array, *, step: float, rounds: int
) -> np.ndarray:
    """Columns (v, n) after `rounds` implicit steps ``(I + step L)^-1``; a constant stays what it is."""
    factor = splu((scipy.sparse.eye_array(len(values)) + step * laplacian).tocsc())
    for _ in range(rounds):
        values = factor.solve(values)
    return values


class SurfaceFrames:
    """The rotation of the surface around each vertex, for any pose, without iterating.

    Smoothing a skinned surface and fitting a rotation to the smoothed neighbourhood of each vertex is a
    linear map of the joint transforms followed by one polar decomposition: ``Q_i = sum_j M_j Omega_ij``
    with ``Omega_ij = sum_k b_ik w_kj u_k u_k^T`` (u_k homogeneous rest points, b the smoothing). Source:
    Le and Lewis, Direct Delta Mush Skinning and Variants, 2019, equations 11 to 17.

    Args:
        rest: (v, 3) [m] float64.
        weights: (v, T) skin weights.
        laplacian: (v, v), see :func:`soma_core.geometry.laplacian.random_walk`.
        step, rounds: strength of the smoothing.
        kernels: ``torch`` or ``warp``; ``auto`` is Warp, which needs no block matrix in memory.
    """

    def __init__(
        self,
        rest: np.ndarray,
        weights: scipy.sparse.csr_array,
        laplacian: scipy.sparse.csr_array,
        *,
        step: float,
        rounds: int,
        kernels: Literal["auto", "torch", "warp"] = "auto",
    ) -> None:
        self._warp = kernels != "torch"
        count, joints = weights.shape
        factor = splu((scipy.sparse.eye_array(count) + step * laplacian).tocsc())
        points = np.concatenate([rest, np.ones((count, 1))], 1)
        products = np.stack([points[:, row] * points[:, column] for row, column in _PAIRS], 1)
        found = [_smoothed_moments(weights[:, [joint]], products, factor, rounds) for joint in range(joints)]
        kept = np.concatenate([values for _, values in found], 0)
        joint = np.repeat(np.arange(joints), [len(ids) for ids, _ in found])
        vertex = np.concatenate([ids for ids, _ in found])
        order = np.lexsort((joint, vertex))
        kept, joint, vertex = kept[order].T, joint[order], vertex[order]
        starts = np.concatenate([[0], np.cumsum(np.bincount(vertex, minlength=count))])
        self.crow, self.col = torch.as_tensor(starts), torch.as_tensor(joint.copy())
        full = np.empty((len(vertex), 4, 4))
        for index, (row, column) in enumerate(_PAIRS):
            full[:, row, column] = full[:, column, row] = kept[index]
        total = np.add.reduceat(full, starts[:-1])
        centre = total[:, :3, 3] / total[:, 3:, 3]
        # About the smoothed rest point of each vertex, so that no large numbers cancel.
        shift = np.tile(np.eye(4), (count, 1, 1))
        shift[:, :3, 3] = -centre
        moved = shift[vertex] @ full @ shift[vertex].transpose(0, 2, 1)
        self.centre = torch.as_tensor(centre)
        self.moments = torch.as_tensor(moved[:, :, :3].copy())  # (e, 4, 3): the last row is the first moment

    def __call__(self, transforms: Tensor) -> Tensor:
        """Rotations (B, v, 3, 3) float64 from skinning transforms (B, T, 3, 4) of the same dtype."""
        if self._warp:
            from soma_core.kernels.surface_frames_wp import surface_frames

            return surface_frames(transforms, self.crow, self.col, self.moments, self.centre)
        return surface_frames_reference(transforms, self.crow, self.col, self.moments, self.centre)


def _smoothed_moments(
    column: scipy.sparse.csr_array, products: np.ndarray, factor: SuperLU, rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that one joint reaches when its weights are smoothed, and the ten moments of each."""
    if not column.nnz:
        return np.empty(0, int), np.empty((0, len(_PAIRS)))
    value = column.toarray() * products
    for _ in range(rounds):
        value = factor.solve(value)
    ids = np.flatnonzero(value[:, -1] > _SMALLEST)  # the last pair is 1 * 1: the smoothed weights
    return ids, value[ids]


def surface_frames_reference(
    transforms: Tensor, crow: Tensor, col: Tensor, moments: Tensor, centre: Tensor
) -> Tensor:
    """Readable twin of ``kernels.surface_frames_wp``; see :class:`SurfaceFrames`.

    ``H_i = sum_j R_j S_ij + (R_j p_i + t_j) s_ij^T``, S and s the second and first moments of the smoothed
    neighbourhood about p_i. The first moments add up to zero, so no mean is left to subtract.

    Args:
        transforms: (B, T, 3, 4).
        crow, col: influences of each vertex, CSR.
        moments: (e, 4, 3) of each influence.
        centre: (v, 3).
    """
    counts = crow.diff()
    vertex = torch.repeat_interleave(torch.arange(len(counts)), counts)
    moved = torch.cat((moments[:, :3] + centre[vertex][:, :, None] * moments[:, 3:], moments[:, 3:]), 1)
    batch, joints = len(transforms), transforms.shape[1]
    columns = (4 * col[:, None, None] + torch.arange(4)[:, None]).expand(-1, 4, 3)
    order = moved.permute(0, 2, 1)  # every (vertex, column of H) is one sparse row
    starts = torch.cat((crow[:1], torch.repeat_interleave(4 * counts, 3).cumsum(0)))
    entry = _row_major(counts, order, columns.permute(0, 2, 1))
    dense = transforms.permute(1, 3, 2, 0).reshape(4 * joints, 3 * batch).contiguous()
    rows = sparse_product((starts, *entry), dense)
    covariance = rows.view(len(counts), 3, 3, batch).permute(3, 0, 2, 1)
    return rotation_from_covariance(covariance.contiguous())


def _row_major(counts: Tensor, values: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """Order entries (e, 3, 4) by vertex, then by the second index: columns and values of a CSR matrix."""
    vertex = torch.repeat_interleave(torch.arange(len(counts)), counts)
    key = (3 * vertex[:, None] + torch.arange(3)).flatten()
    order = torch.argsort(key, stable=True)
    return columns.reshape(-1, 4)[order].flatten(), values.reshape(-1, 4)[order].flatten()
