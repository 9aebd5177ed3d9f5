"""Linear blend skinning with every influence kept (paper, equation 6)."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.geometry.sparse import SparseRows, gather_rows

__all__ = ["Skinning", "skinning_transforms"]

_CHUNK = 32
"""Poses blended at a time: keeps the blended matrices in cache and every buffer below malloc's mmap limit."""


def skinning_transforms(rotations: Tensor, positions: Tensor, bind_world: Tensor) -> Tensor:
    """``G B^-1`` as (B, J, 3, 4), from posed rotations, positions [m] and bind transforms (B or 1, J, 4, 4)."""
    bind_rotation, bind_position = bind_world[..., :3, :3], bind_world[..., :3, 3]
    turn = rotations @ bind_rotation.transpose(-1, -2)
    shift = positions - (turn @ bind_position[..., None]).squeeze(-1)
    return torch.cat((turn, shift[..., None]), -1)


class Skinning(torch.nn.Module):
    """Skin weights (v, J) as constants; computes ``y_v = sum_k w_vk M_k (x_v; 1)``.

    Vertices travel as (v, 3, B), batch innermost, so that one sparse row touches B poses at once.
    """

    def __init__(self, weights: scipy.sparse.csr_array, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        self.weights = SparseRows(weights, dtype=dtype, device=device)
        weights = weights.sorted_indices()
        vertices, joints = weights.shape
        columns = (4 * weights.indices.astype(np.int64)[:, None] + np.arange(4)).ravel()
        starts = 4 * weights.indptr.astype(np.int64)
        order = scipy.sparse.csr_array((np.arange(len(columns)), columns, starts), shape=(vertices, 4 * joints))
        turned = order.T.tocsr()

        def keep(name: str, array: np.ndarray) -> None:
            self.register_buffer(name, torch.as_tensor(array, dtype=torch.int64, device=device), persistent=False)

        keep("point_col", columns)
        keep("point_crow", starts)
        keep("point_t_col", turned.indices)
        keep("point_t_crow", turned.indptr)
        keep("point_t_order", turned.data)
        keep("influence_vertex", np.repeat(np.arange(vertices), np.diff(weights.indptr)))

    def forward(self, vertices: Tensor, transforms: Tensor) -> Tensor:
        """Skinned vertices (v, 3, B).

        Args:
            vertices: (v, 3, B) or (v, 3, 1) [m].
            transforms: (B, J, 3, 4) from :func:`skinning_transforms`.
        """
        parts = [
            self._blend(vertices if vertices.shape[2] == 1 else vertices[:, :, start : start + _CHUNK],
                        transforms[start : start + _CHUNK])
            for start in range(0, len(transforms), _CHUNK)
        ]  # fmt: skip
        return parts[0] if len(parts) == 1 else torch.cat(parts, 2)

    def _blend(self, vertices: Tensor, transforms: Tensor) -> Tensor:
        planes = transforms.permute(2, 3, 1, 0).contiguous()  # (3, 4, J, B)
        rows = []
        for row in planes:
            turned = self.weights(row[0]) * vertices[:, 0]
            turned = torch.addcmul(turned, self.weights(row[1]), vertices[:, 1])
            turned = torch.addcmul(turned, self.weights(row[2]), vertices[:, 2])
            rows.append(turned + self.weights(row[3]))
        return torch.stack(rows, 1)

    def shared(self, vertices: Tensor, transforms: Tensor) -> Tensor:
        """Skin one body in many poses: (v, 3) and (B, J, 3, 4) -> (v, 3, B); constant in `vertices`.

        Weights and points fold into one sparse matrix (v, 4 J), so a pose costs one sparse product.
        Gradients reach the transforms only.
        """
        point = torch.cat((vertices, torch.ones_like(vertices[:, :1])), 1)
        values = (self.weights.val[:, None] * point[self.influence_vertex]).ravel()
        batch, joints = transforms.shape[:2]
        dense = transforms.permute(1, 3, 2, 0).reshape(4 * joints, 3 * batch)
        pattern = (self.point_crow, self.point_col, values)
        turned = values[self.point_t_order] if dense.requires_grad else values
        out = gather_rows(dense, pattern, (self.point_t_crow, self.point_t_col, turned))
        return out.view(-1, 3, batch)
