"""Linear identities composed once: transfer, fill, axes and unit folded into the basis.

A linear backend is ``V(b) = V_0 + sum b_k V_k`` on native vertices. Everything the transfer does to them
is linear, except the normal offset of the few vertices that lie off the surface. Those with a real offset
are evaluated exactly; for the rest the offset is linearised at the default body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.geometry.barycentric import raised_normal, raised_normal_jacobian
from soma_core.geometry.sparse import SparseRows
from soma_core.plugin.spec import LinearBasis
from soma_core.topology.transfer import CanonicalPassThrough, TopologyTransfer

__all__ = ["ComposedBasis", "ExactOffsets", "compose"]

_REAL_OFFSET = 1e-5
"""Offset [m] above which a vertex's normal is evaluated exactly; below, linearising it costs < 0.01 mm."""

_NO_OFFSET = 1e-8
"""Offset [m] below which a vertex counts as lying on its face."""

_COLUMNS = 32
"""Basis columns composed at a time, to bound memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ExactOffsets:
    """Normal offsets that stay non-linear.

    Attributes:
        rows: canonical ids of the vertices, (e + u,).
        height: third tetrahedral coordinate times the unit scale [m per native unit], (e,).
        template: corners of their faces in the canonical frame and native unit, (e * 9,).
        basis: (e * 9, k).
        spread: response of filled vertices to those offsets, (u, e); the last u of `rows` are filled ones.
    """

    rows: Tensor
    height: Tensor
    template: Tensor
    basis: Tensor
    spread: Tensor

    def evaluate(self, coefficients: Tensor) -> Tensor:
        """Offsets [m] of `rows`, (len(rows), 3, B)."""
        corners = torch.addmm(self.template[:, None], self.basis, coefficients.T)
        corners = corners.view(len(self.height), 3, 3, -1).permute(3, 0, 1, 2)
        offsets = (self.height[:, None] * raised_normal(corners)).permute(1, 2, 0)
        if not len(self.spread):
            return offsets
        filled = (self.spread @ offsets.flatten(1)).view(len(self.spread), 3, -1)
        return torch.cat((offsets, filled))


@dataclass(frozen=True, kw_only=True, eq=False)
class ComposedBasis:
    """A linear identity on canonical vertices.

    Attributes:
        template: (v * 3,) [m].
        basis: (v * 3, k) [m], vertex-major.
        exact: the offsets to add, or None when the backend has none.
    """

    template: Tensor
    basis: Tensor
    exact: ExactOffsets | None


def compose(
    linear: LinearBasis, transfer: TopologyTransfer | CanonicalPassThrough, at: Tensor
) -> ComposedBasis:
    """Fold `transfer` into `linear`.

    Args:
        linear: template (n, 3) and basis (k, n, 3), native.
        transfer: the backend's exact transfer.
        at: coefficients (k,) of the body that offsets are linearised at.

    Raises:
        InputError: the template is not the mesh that `transfer` was made for.
    """
    transfer.check((1, *linear.template.shape))
    if isinstance(transfer, CanonicalPassThrough):
        return _compose_pass_through(linear, transfer)
    count = len(transfer.corners)
    default = torch.addmm(linear.template.reshape(1, -1), at[None], linear.basis.flatten(1)).view(-1, 3)
    corners = default[transfer.corners]
    scale = transfer.frame.norm(dim=1)[0]
    offset = transfer.height.abs() * raised_normal(corners).norm(dim=-1) * scale
    exact_rows = torch.nonzero(offset > _REAL_OFFSET).squeeze(1)
    height = torch.where(offset > _REAL_OFFSET, 0.0, transfer.height)
    height = torch.where(offset < _NO_OFFSET, 0.0, height)
    slope = _slope_rows(transfer, corners, height)

    def finish(points: Tensor) -> Tensor:
        filled = transfer.fill(points.reshape(count, -1)).view(count, 3, -1)
        return transfer.to_canonical(filled).reshape(count * 3, -1)

    columns = torch.empty(count * 3, len(linear.basis), dtype=linear.basis.dtype, device=linear.basis.device)
    for start in range(0, len(linear.basis), _COLUMNS):
        part = linear.basis[start : start + _COLUMNS].permute(1, 2, 0).contiguous()
        plane = transfer.affine(part.flatten(1)) + slope(part.flatten(0, 1)).view(count, -1)
        columns[:, start : start + _COLUMNS] = finish(plane)
    raised = height[:, None] * raised_normal(corners)
    change = (linear.template - default).reshape(-1, 1)
    constant = transfer.affine(linear.template.contiguous()) + raised + slope(change).view(count, 3)
    return ComposedBasis(
        template=finish(constant).squeeze(1),
        basis=columns,
        exact=_exact_offsets(linear, transfer, exact_rows),
    )


def _slope_rows(transfer: TopologyTransfer, corners: Tensor, height: Tensor) -> SparseRows:
    """Sparse derivative (v * 3, n * 3) of the linearised offsets ``height * raised normal``."""
    rows = torch.nonzero(height).squeeze(1).cpu().numpy()
    jacobian = raised_normal_jacobian(corners.double().cpu().numpy()[rows])
    jacobian = jacobian * height.double().cpu().numpy()[rows][:, None, None, None]
    ids = transfer.corners.cpu().numpy()[rows]
    row = np.broadcast_to((3 * rows[:, None] + np.arange(3))[:, :, None, None], jacobian.shape)
    column = np.broadcast_to((3 * ids[:, :, None] + np.arange(3))[:, None], jacobian.shape)
    matrix = scipy.sparse.csr_array(
        (jacobian.ravel(), (row.ravel(), column.ravel())), shape=(3 * len(height), 3 * transfer.native_count)
    )
    return SparseRows(matrix, dtype=height.dtype, device=height.device)


def _exact_offsets(linear: LinearBasis, transfer: TopologyTransfer, rows: Tensor) -> ExactOffsets | None:
    free = transfer.fill.free_vertices
    rows = rows[~torch.isin(rows, free)]
    if not len(rows):
        return None
    scale = transfer.frame.norm(dim=1)[0]
    turn = transfer.frame / scale
    ids = transfer.corners[rows]
    template = linear.template[ids] @ turn.T
    basis = torch.einsum("ac,keic->eiak", turn, linear.basis[:, ids])
    unit = transfer.height.new_zeros(len(transfer.corners), len(rows))
    unit[rows, torch.arange(len(rows), device=rows.device)] = 1
    return ExactOffsets(
        spread=transfer.fill(unit)[free],
        rows=torch.cat((rows, free)),
        height=transfer.height[rows] * scale,
        template=template.reshape(-1).contiguous(),
        basis=basis.reshape(len(rows) * 9, -1).contiguous(),
    )


def _compose_pass_through(linear: LinearBasis, transfer: CanonicalPassThrough) -> ComposedBasis:
    template = linear.template[transfer.mid_ids] @ transfer.frame.T
    basis = torch.empty(template.numel(), len(linear.basis), dtype=template.dtype, device=template.device)
    for start in range(0, len(linear.basis), _COLUMNS):
        part = linear.basis[start : start + _COLUMNS, transfer.mid_ids] @ transfer.frame.T
        basis[:, start : start + _COLUMNS] = part.flatten(1).T
    return ComposedBasis(template=template.reshape(-1).contiguous(), basis=basis, exact=None)
