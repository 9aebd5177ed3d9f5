"""Constant sparse matrices as a few dense blocks, for engines that have no sparse product."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.animation.skinning import Skinning
from soma_core.animation.twist import Twist
from soma_core.correctives.model import Correctives
from soma_core.deploy.correctives import BatchedCorrectives
from soma_core.deploy.fit import ShortRotationFit
from soma_core.deploy.turns import ShortTwist
from soma_core.geometry.constants import constant
from soma_core.geometry.sparse import SparseRows
from soma_core.skeleton.rotations import RotationFit

__all__ = ["BlockRows", "BlockSkinning", "split_rows", "without_sparse"]

_LEAST_GAIN = 20_000
"""Entries that a split has to spare: what an engine multiplies in the time that one more product costs."""

_WIDEST = 4096
"""Columns above which no split is sought; the search is quadratic in them."""

_FEW = 16
"""Entries a row, at most, that are gathered one by one where there is no split."""


def split_rows(matrix: scipy.sparse.csr_array) -> list[np.ndarray]:
    """Sets of rows whose dense blocks, on the columns that each set uses, hold few zeros.

    Empty rows are in none. A set is halved by whether a row uses one column: that which spares most entries.
    """
    pattern = scipy.sparse.csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)
    todo, done = [np.flatnonzero(np.diff(pattern.indptr))], []
    while todo:
        rows = todo.pop()
        part = pattern[rows]
        together = (part.T @ part).toarray()  # rows that use both of two columns
        uses, count = np.diag(together), len(rows)
        size = uses * (together > 0).sum(1) + (count - uses) * (uses > together).sum(1)
        size = np.where((uses == 0) | (uses == count), np.inf, size)
        best = int(size.argmin())
        if count * (uses > 0).sum() - size[best] <= _LEAST_GAIN:
            done.append(rows)
            continue
        chosen = part[:, [best]].toarray().ravel() > 0
        todo += [rows[chosen], rows[~chosen]]
    return done


class BlockRows(torch.nn.Module):
    """The product with a constant sparse matrix (m, n), by gathers and dense products alone.

    Stands in for ``SparseRows``: ``operator(dense)`` takes (n, f) to (m, f); equal to rounding. Blocks are
    kept transposed, and stand on the right: engines are several times as fast at that where f is 1.
    """

    def __init__(
        self, matrix: scipy.sparse.csr_array, *, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        super().__init__()
        matrix, (count, width) = matrix.sorted_indices(), matrix.shape
        entries = np.diff(matrix.indptr)
        self.width = 0
        if width > _WIDEST and entries.max(initial=0) <= _FEW:
            self._keep_entries(matrix, entries, dtype=dtype, device=device)
            return
        parts = split_rows(matrix) if width <= _WIDEST else [np.flatnonzero(entries)]
        filled = sum(map(len, parts))
        place = np.full(count, filled)
        place[np.concatenate(parts)] = np.arange(filled)
        self.place = constant(place, device=device)
        self.block_count, self.empty = len(parts), int(filled < count)
        for index, rows in enumerate(parts):
            columns = np.unique(matrix[rows].indices).astype(np.int64)
            setattr(self, f"columns_{index}", constant(columns, device=device))
            block = matrix[rows][:, columns].toarray().T.copy()
            setattr(self, f"block_{index}", constant(block, device=device, dtype=dtype))

    def _keep_entries(
        self,
        matrix: scipy.sparse.csr_array,
        entries: np.ndarray,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        self.width = max(int(entries.max()), 1)
        columns = np.zeros((matrix.shape[0], self.width), np.int64)
        values = np.zeros(columns.shape)
        slot = np.arange(self.width) < entries[:, None]
        columns[slot], values[slot] = matrix.indices, matrix.data
        self.columns = constant(columns.ravel(), device=device)
        self.values = constant(values[..., None], device=device, dtype=dtype)

    def forward(self, dense: Tensor) -> Tensor:
        """Product with (n, f); (m, f)."""
        if self.width:
            return (dense.index_select(0, self.columns).unflatten(0, (-1, self.width)) * self.values).sum(1)
        parts = [
            dense.T.index_select(1, getattr(self, f"columns_{index}")) @ getattr(self, f"block_{index}")
            for index in range(self.block_count)
        ]
        found = torch.nn.functional.pad(torch.cat(parts, 1), (0, self.empty))
        return found.T.index_select(0, self.place)


class BlockSkinning(torch.nn.Module):
    """Linear blend skinning by one dense product; stands in for ``Skinning``.

    Blocks would spare half of the product, and cost as much again to put vertices into their order. Vertices
    are innermost throughout: an engine spreads a number over an axis of one body slowly.
    """

    def __init__(
        self, weights: scipy.sparse.csr_array, *, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        super().__init__()
        self.weights = constant(weights.toarray().T.copy(), dtype=dtype, device=device)

    def forward(self, points: Tensor, transforms: Tensor, *, rows: bool) -> Tensor:
        """Skinned vertices: (B, v, 3) when `rows`, else planes (3, v, B); takes what ``Skinning`` does."""
        skinned = self.planes(points.permute(2, 0, 1), transforms.permute(2, 3, 1, 0))
        return skinned.transpose(1, 2) if rows else skinned.permute(1, 2, 0)

    def planes(self, points: Tensor, transforms: Tensor) -> Tensor:
        """Skinned vertices (B, 3, v) from (B or 1, 3, v) and transforms (3, 4, J, B)."""
        blended = transforms.permute(3, 0, 1, 2).flatten(1, 2) @ self.weights  # all twelve numbers in one
        place = torch.nn.functional.pad(points, (0, 0, 0, 1), value=1.0)
        return (blended.unflatten(1, (3, 4)) * place[:, None]).sum(2)

    def shared(self, vertices: Tensor, transforms: Tensor) -> Tensor:
        """Skin one body (v, 3) in many poses: (B, v, 3)."""
        return self(vertices.T[..., None], transforms, rows=True)


def without_sparse(module: torch.nn.Module, *, dtype: torch.dtype, device: torch.device | str) -> None:
    """Put blocks in the place of every sparse product and skinning below a module."""
    for name, child in list(
        module._modules.items()
    ):  # named_children() leaves out a second name of one child
        if child is None:
            continue
        if isinstance(child, Skinning):
            setattr(module, name, BlockSkinning(child.weights.scipy(), dtype=dtype, device=device))
        elif isinstance(child, Correctives) and len(child.owner):
            setattr(module, name, BatchedCorrectives(child, dtype=dtype, device=device))
        elif isinstance(child, Twist) and not any(child.counts[1:]):
            setattr(module, name, ShortTwist(child, dtype=dtype, device=device))
        elif isinstance(child, RotationFit):
            setattr(module, name, ShortRotationFit(child, dtype=dtype, device=device))
        elif isinstance(child, SparseRows):
            setattr(module, name, BlockRows(child.scipy(), dtype=dtype, device=device))
        else:
            without_sparse(child, dtype=dtype, device=device)
