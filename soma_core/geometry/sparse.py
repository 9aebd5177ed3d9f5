"""Sparse operators on tall matrices: gather, weigh and add rows, forward and backward in fixed order."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from soma_core.geometry.torch_func import transformed

__all__ = ["Csr", "SparseRows", "gather_rows", "sparse_product"]

Csr = tuple[Tensor, Tensor, Tensor]
"""Row starts (m + 1,), column ids (e,), values (e,)."""


def sparse_product(matrix: Csr, dense: Tensor) -> Tensor:
    """Product of a sparse (m, n) matrix in CSR form and a contiguous dense (n, f) one; no derivative."""
    crow, col, val = matrix
    if dense.shape[1] == 0:  # an empty batch, which embedding_bag refuses
        return dense.new_empty(crow.shape[0] - 1, 0)
    return embedding_bag(col, dense, crow, mode="sum", per_sample_weights=val, include_last_offset=True)


class _Gather(torch.autograd.Function):
    """``out = A @ dense`` with constant A; the backward pass applies the transpose, row by row."""

    @staticmethod
    def forward(dense: Tensor, crow: Tensor, col: Tensor, val: Tensor, *_transpose: Tensor) -> Tensor:
        return sparse_product((crow, col, val), dense)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], _output: Tensor) -> None:
        ctx.save_for_backward(*inputs[4:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        back = sparse_product(ctx.saved_tensors, grad.contiguous())
        return back, None, None, None, None, None, None


class _GatherAnyWay(_Gather):
    """The same for every transform of ``torch.func``, in any order."""

    @staticmethod
    def forward(dense: Tensor, *matrix: Tensor) -> Tensor:
        crow, col, val = matrix[:3]
        return sparse_product((crow, col, val), dense.contiguous())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], _output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:])
        ctx.save_for_forward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        matrix = ctx.saved_tensors
        return _GatherAnyWay.apply(grad, *matrix[3:], *matrix[:3]), *[None] * 6

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_constant: Tensor) -> Tensor:
        return _GatherAnyWay.apply(tangent, *ctx.saved_tensors)

    @staticmethod
    def vmap(_info: Any, in_dims: Any, dense: Tensor, *matrix: Tensor) -> tuple[Tensor, int]:
        assert not any(dim is not None for dim in in_dims[1:]), "the matrix is constant"
        dense = dense.movedim(in_dims[0], 2)
        out = _GatherAnyWay.apply(dense.flatten(1), *matrix)
        return out.unflatten(1, dense.shape[1:]), 2


def gather_rows(dense: Tensor, matrix: Csr, transpose: Csr) -> Tensor:
    """Product of a sparse (m, n) matrix, given with its transpose, and a dense (n, f) one; (m, f).

    Differentiable in `dense` only; the transpose is read in the backward pass alone.
    """
    function = _GatherAnyWay if transformed() else _Gather
    return function.apply(dense, *matrix, *transpose)


class SparseRows(torch.nn.Module):
    """A constant sparse matrix (m, n) in CSR form, with its transpose for the backward pass.

    ``operator(dense)`` computes the (m, f) product with a contiguous dense (n, f) matrix. Sums run in
    index order on every device, so results are deterministic.
    """

    crow: Tensor
    col: Tensor
    val: Tensor
    t_crow: Tensor
    t_col: Tensor
    t_val: Tensor

    def __init__(
        self, matrix: scipy.sparse.sparray, *, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        super().__init__()
        forward, backward = matrix.tocsr(), matrix.T.tocsr()
        self.shape = tuple(forward.shape)
        for prefix, csr in (("", forward), ("t_", backward)):
            csr = csr.sorted_indices()
            self._keep(prefix + "crow", csr.indptr, torch.int64, device)
            self._keep(prefix + "col", csr.indices, torch.int64, device)
            self._keep(prefix + "val", csr.data, dtype, device)

    def _keep(self, name: str, array: np.ndarray, dtype: torch.dtype, device: torch.device | str) -> None:
        self.register_buffer(
            name, torch.as_tensor(array.copy()).to(dtype=dtype, device=device), persistent=False
        )

    @property
    def csr(self) -> Csr:
        """Row starts, column ids and values of the matrix."""
        return self.crow, self.col, self.val

    @property
    def transpose(self) -> Csr:
        """Row starts, column ids and values of its transpose."""
        return self.t_crow, self.t_col, self.t_val

    def scipy(self) -> scipy.sparse.csr_array:
        """The matrix on the host, in float64."""
        start, column, value = (part.cpu().numpy() for part in self.csr)
        return scipy.sparse.csr_array((value.astype(np.float64), column, start), shape=self.shape)

    def forward(self, dense: Tensor) -> Tensor:
        """Product with (n, f); (m, f)."""
        return gather_rows(dense, self.csr, self.transpose)

    def pull_back(self, rows: Tensor) -> Tensor:
        """Product of (f, m) with the matrix, (f, n); no derivative."""
        return sparse_product(self.transpose, rows.T.contiguous()).T
