"""Linear blend skinning with every influence kept (paper, section 3.5, equation 6)."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.geometry.constants import constant
from soma_core.geometry.sparse import Csr, SparseRows, gather_rows, sparse_product
from soma_core.geometry.torch_func import operator, transformed

if TYPE_CHECKING:
    from soma_core.kernels.body_skin_wp import Blend

__all__ = ["Skinning", "skinning_transforms"]

_CHUNK = 32
"""Poses blended at a time: keeps blended matrices in cache and buffers below malloc's mmap limit."""


def skinning_transforms(rotations: Tensor, positions: Tensor, bind_world: Tensor) -> Tensor:
    """``G B^-1`` (B, J, 3, 4) from posed rotations, positions [m] and bind transforms (B or 1, J, 4, 4)."""
    bind_rotation, bind_position = bind_world[..., :3, :3], bind_world[..., :3, 3]
    turn = rotations @ bind_rotation.transpose(-1, -2)
    shift = positions - (turn @ bind_position[..., None]).squeeze(-1)
    return torch.cat((turn, shift[..., None]), -1)


def _chunks(batch: int) -> Iterator[slice]:
    starts = range(0, batch, _CHUNK) or (0,)  # an empty batch is one empty chunk
    return (slice(start, min(start + _CHUNK, batch)) for start in starts)


def _part(points: Tensor, chunk: slice) -> Tensor:
    """Columns of (3, v, B) for a chunk of poses; (3, v, 1) serves every chunk."""
    return points if points.shape[2] == 1 else points[:, :, chunk]


def _blend_into(out: Tensor, points: Tensor, planes: Tensor, weights: Csr, *, rows: bool) -> None:
    """Skin a chunk of poses at a time into `out`: (B, v, 3) when `rows`, else (3, v, B)."""
    count, batch = len(weights[0]) - 1, planes.shape[3]
    for chunk in _chunks(batch):
        local, plane = _part(points, chunk), planes[..., chunk].contiguous()
        width = plane.shape[3]
        target = planes.new_empty(count, 3, width).transpose(0, 1) if rows else out[:, :, chunk]
        for row in range(3):
            total = sparse_product(weights, plane[row, 3])
            total.addcmul_(sparse_product(weights, plane[row, 0]), local[0])
            total.addcmul_(sparse_product(weights, plane[row, 1]), local[1])
            torch.addcmul(total, sparse_product(weights, plane[row, 2]), local[2], out=target[row])
        if rows:
            out[chunk] = target.permute(2, 1, 0)


# Operators of their own, so that torch.compile takes them whole: chunks, strided outputs and all.
@operator("soma_core::blend")
def _blend(points: Tensor, planes: Tensor, rows: bool, matrix: Sequence[Tensor]) -> Tensor:
    """Blend, apply and lay out, one chunk of poses at a time; `matrix` is weights, then their transpose."""
    count, batch = len(matrix[0]) - 1, planes.shape[3]
    out = planes.new_empty((batch, count, 3) if rows else (3, count, batch))
    _blend_into(out, points, planes, (matrix[0], matrix[1], matrix[2]), rows=rows)
    return out


@_blend.register_fake
def _(_points: Tensor, planes: Tensor, rows: bool, matrix: Sequence[Tensor]) -> Tensor:
    count, batch = matrix[0].shape[0] - 1, planes.shape[3]
    return planes.new_empty((batch, count, 3) if rows else (3, count, batch))


@operator("soma_core::blend_backward")
def _blend_backward(
    grad: Tensor, points: Tensor, planes: Tensor, rows: bool, matrix: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Gradients of points and planes; blending again costs less than reading blended matrices back."""
    crow, col, val, t_crow, t_col, t_val = matrix
    weights, transpose = (crow, col, val), (t_crow, t_col, t_val)
    points_grad = torch.zeros_like(points, memory_format=torch.contiguous_format)
    planes_grad = torch.empty_like(planes, memory_format=torch.contiguous_format)
    for chunk in _chunks(planes.shape[3]):
        local, plane = _part(points, chunk), planes[..., chunk].contiguous()
        g = (grad[chunk].permute(2, 1, 0) if rows else grad[:, :, chunk]).contiguous()
        for row in range(3):
            for axis in range(3):
                planes_grad[row, axis, :, chunk] = sparse_product(transpose, g[row] * local[axis])
            planes_grad[row, 3, :, chunk] = sparse_product(transpose, g[row])
        for axis in range(3):
            total = sparse_product(weights, plane[0, axis]).mul_(g[0])
            total.addcmul_(sparse_product(weights, plane[1, axis]), g[1])
            total.addcmul_(sparse_product(weights, plane[2, axis]), g[2])
            if points.shape[2] == 1:
                points_grad[axis, :, 0] += total.sum(1)
            else:
                points_grad[axis, :, chunk] = total
    return points_grad, planes_grad


@_blend_backward.register_fake
def _(
    _grad: Tensor, points: Tensor, planes: Tensor, _rows: bool, _matrix: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    dense = torch.contiguous_format
    return torch.empty_like(points, memory_format=dense), torch.empty_like(planes, memory_format=dense)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001 - PyTorch names its arguments
    points, planes, ctx.rows, matrix = inputs
    ctx.save_for_backward(points, planes, *matrix)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    points, planes, *matrix = ctx.saved_tensors
    gradients = torch.ops.soma_core.blend_backward(grad, points, planes, ctx.rows, matrix)
    return *gradients, None, [None] * len(matrix)


_blend.register_autograd(_backward, setup_context=_save)


class Skinning(torch.nn.Module):
    """Skin weights (v, J) as constants; computes ``y_v = sum_k w_vk M_k (x_v; 1)``.

    Vertices travel as planes (3, v, B), batch innermost, so that one sparse row touches many poses at once
    and every elementwise step runs over contiguous memory.

    Attributes:
        blend: the weights for a kernel that does the same with bodies in SIMD lanes, where there is one.
    """

    def __init__(
        self, weights: scipy.sparse.csr_array, *, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        super().__init__()
        self.weights = SparseRows(weights, dtype=dtype, device=device)
        self.blend: Blend | None = None
        weights = weights.sorted_indices()
        vertices, joints = weights.shape
        columns = (4 * weights.indices.astype(np.int64)[:, None] + np.arange(4)).ravel()
        starts = 4 * weights.indptr.astype(np.int64)
        order = scipy.sparse.csr_array(
            (np.arange(len(columns)), columns, starts), shape=(vertices, 4 * joints)
        )
        turned = order.T.tocsr()

        keep = functools.partial(constant, device=device, dtype=dtype)
        self.point_col = keep(columns)
        self.point_crow = keep(starts)
        self.point_t_col = keep(turned.indices)
        self.point_t_crow = keep(turned.indptr)
        self.point_t_order = keep(turned.data)
        self.influence_vertex = keep(np.repeat(np.arange(vertices), np.diff(weights.indptr)))

    def forward(self, points: Tensor, transforms: Tensor, *, rows: bool) -> Tensor:
        """Skinned vertices: contiguous (B, v, 3) when `rows`, else planes (3, v, B).

        Args:
            points: (3, v, B) or (3, v, 1) [m].
            transforms: (B, J, 3, 4) from :func:`skinning_transforms`.
        """
        if self.blend is not None and not transformed():
            skinned = self._in_lanes(points.permute(2, 1, 0), transforms)
            return skinned if rows else skinned.permute(2, 1, 0)
        planes = transforms.permute(2, 3, 1, 0)
        if transformed():
            blended = self.weights(planes.permute(2, 0, 1, 3).flatten(1)).unflatten(1, planes[:, :, 0].shape)
            skinned = (blended[:, :, :3] * points.transpose(0, 1)[:, None]).sum(2) + blended[:, :, 3]
            return skinned.permute(2, 0, 1).contiguous() if rows else skinned.transpose(0, 1)
        return _blend(points, planes, rows, [*self.weights.csr, *self.weights.transpose])

    def _in_lanes(self, points: Tensor, transforms: Tensor) -> Tensor:
        from soma_core.kernels.body_skin_back_wp import skin

        assert self.blend is not None
        return skin(points, transforms, self.blend)

    def into(self, out: Tensor, points: Tensor, transforms: Tensor) -> None:
        """Write skinned vertices into `out`, contiguous (B, v, 3); no derivative."""
        _blend_into(out, points, transforms.permute(2, 3, 1, 0), self.weights.csr, rows=True)

    def shared(self, vertices: Tensor, transforms: Tensor) -> Tensor:
        """Skin one body in many poses: (v, 3) and (B, J, 3, 4) -> (B, v, 3); constant in `vertices`.

        Weights and points fold into one sparse matrix (v, 4 J), so a pose costs one sparse product.
        Gradients reach the transforms only.
        """
        if self.blend is not None:
            return self._in_lanes(vertices[None], transforms)
        point = torch.cat((vertices, torch.ones_like(vertices[:, :1])), 1)
        values = (self.weights.val[:, None] * point[self.influence_vertex]).ravel()
        pattern = (self.point_crow, self.point_col, values)
        turned = values[self.point_t_order] if transforms.requires_grad else values
        transpose = (self.point_t_crow, self.point_t_col, turned)
        dense = transforms.permute(1, 3, 2, 0).flatten(0, 1)  # (4 J, 3, B)
        parts = []
        for chunk in _chunks(len(transforms)):
            part = gather_rows(dense[..., chunk].flatten(1), pattern, transpose)
            width = part.shape[1] // 3
            parts.append(part.view(len(vertices), 3, width).permute(2, 0, 1))
        return parts[0].contiguous() if len(parts) == 1 else torch.cat(parts)
