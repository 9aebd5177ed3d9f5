"""Sparse matrices as files store them, every index checked before a library walks along it.

scipy's own check trusts the last of the row starts: `[0, 9, 0]` lets it read outside of its arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse

__all__ = ["StoredMatrix"]

_LONGEST_AXIS = 2**24
_MOST_DENSE = 2**24
"""Entries of a sparse matrix made dense; the largest regressor has 0.6 million."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredMatrix:
    """A sparse matrix as stored, nothing of it checked.

    Attributes:
        layout: coo, csr, csc, bsr or bsc.
        indices: of coo the ids of rows and of columns, of the others the starts and the ids.
        values: numbers, or blocks of them (n, rows, columns) of bsr and bsc.
        shape: of the matrix.
    """

    layout: str
    indices: tuple[np.ndarray, np.ndarray]
    values: np.ndarray
    shape: tuple[int, ...]

    def csr(self) -> scipy.sparse.csr_array:
        """The matrix in rows, entries at one place added, half precision as float32.

        Raises:
            ValueError: indices that leave the matrix or its values, or sizes that do not belong together.
        """
        if len(self.shape) != 2 or max(self.shape) > _LONGEST_AXIS:
            raise ValueError(f"a sparse matrix of the shape {self.shape}")
        if any(part.dtype.kind not in "iu" or part.ndim != 1 for part in self.indices):
            raise ValueError("a sparse matrix whose indices are no rows of integers")
        if self.values.dtype.kind not in "fiub":
            raise ValueError(f"a sparse matrix of {self.values.dtype}")
        block = self.values.shape[1:] if self.layout in ("bsr", "bsc") else (1, 1)
        if self.values.ndim != (3 if self.layout in ("bsr", "bsc") else 1) or 0 in block:
            raise ValueError(f"a sparse matrix of values of the shape {self.values.shape}")
        if any(size % part for size, part in zip(self.shape, block, strict=True)):
            raise ValueError(f"a sparse matrix of the shape {self.shape} in blocks of {block}")
        rows, columns = self._coordinates(
            *(size // part for size, part in zip(self.shape, block, strict=True))
        )
        inside = [np.arange(part) for part in block]
        rows = rows[:, None, None] * block[0] + inside[0][:, None]
        columns = columns[:, None, None] * block[1] + inside[1]
        rows, columns = (part.ravel() for part in np.broadcast_arrays(rows, columns))
        half = self.values.dtype == np.float16  # which scipy does not know
        values = self.values.astype(np.float32) if half else self.values
        return scipy.sparse.csr_array((values.ravel(), (rows, columns)), shape=self.shape)

    def dense(self) -> np.ndarray:
        """The matrix with its zeros.

        Raises:
            ValueError: as :meth:`csr`, or too many numbers.
        """
        if math.prod(self.shape) > _MOST_DENSE:
            raise ValueError(f"a sparse matrix of {' x '.join(map(str, self.shape))}")
        return self.csr().toarray()

    def _coordinates(self, row_count: int, column_count: int) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each block, within the matrix."""
        first, second = self.indices
        if self.layout != "coo":
            major = row_count if self.layout in ("csr", "bsr") else column_count
            first = _spread(first, major, len(second))
        if len(first) != len(second) or len(first) != len(self.values):
            raise ValueError(f"{len(self.values)} values and {len(second)} indices in a sparse matrix")
        rows, columns = (second, first) if self.layout in ("csc", "bsc") else (first, second)
        for ids, count in ((rows, row_count), (columns, column_count)):
            if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < count:
                raise ValueError(f"indices that leave the {count} rows or columns of a sparse matrix")
        return rows.astype(np.int64), columns.astype(np.int64)


def _spread(starts: np.ndarray, major: int, count: int) -> np.ndarray:
    """Index of the row or column that each of `count` entries belongs to."""
    starts = starts.astype(np.int64)
    if len(starts) != major + 1 or starts[0] != 0 or starts[-1] != count or (np.diff(starts) < 0).any():
        raise ValueError(f"starts that do not divide {count} entries into {major} rows or columns")
    return np.repeat(np.arange(major), np.diff(starts))
