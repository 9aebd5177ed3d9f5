"""Pose correctives as a few batched products, for engines in which each operator costs more than its sum."""

from __future__ import annotations

import functools

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.correctives.model import Correctives
from soma_core.geometry.constants import constant

__all__ = ["BatchedCorrectives", "alike", "equal_parts"]

_TILE = 8
"""Vertices that take up the same joints."""

_SIZES = 4
"""Kinds of tiles, by how many joints they take up: a product each."""


def alike(uses: np.ndarray) -> np.ndarray:
    """An order of the rows of a mask (n, k) in which neighbours use nearly the same columns."""
    todo, done = [np.arange(len(uses))], []
    while todo:
        rows = todo.pop()
        part = uses[rows]
        together = part.T.astype(np.int64) @ part  # rows that use both of two columns
        own, count = np.diag(together), len(rows)
        size = own * (together > 0).sum(1) + (count - own) * (own > together).sum(1)
        size = np.where((own == 0) | (own == count), np.iinfo(np.int64).max, size)
        best = int(size.argmin())
        if own[best] in (0, count):
            done.append(rows)
            continue
        todo += [rows[~part[:, best]], rows[part[:, best]]]
    return np.concatenate(done)


def equal_parts(widths: np.ndarray, parts: int) -> list[int]:
    """Ends of runs of descending `widths`, at most `parts`, that waste least where all take a run's first."""
    first = np.flatnonzero(np.diff(widths, prepend=np.inf))  # a run begins with another width
    stops = np.append(first, len(widths))
    waste = (stops[:, None] - first) * widths[first]
    waste = np.where(np.arange(len(stops))[:, None] > np.arange(len(first)), waste, np.inf)
    cost, chosen = np.append(0.0, np.full(len(first), np.inf)), []
    for _ in range(min(parts, len(first))):
        total = cost[:-1] + waste
        cost = total.min(1)
        chosen.append(total.argmin(1))
    ends = [len(first)]
    for begin in reversed(chosen):
        ends.append(int(begin[ends[-1]]))
    return [int(stops[end]) for end in ends[-2::-1]]


class BatchedCorrectives(torch.nn.Module):
    """Stands in for ``Correctives``; equal to rounding.

    An activation sees few joints, and all of one joint see the same: their products are one, over the joints.
    Vertices that a few joints move are tiles, the products of tiles of one size are one.
    """

    def __init__(self, given: Correctives, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        keep = functools.partial(constant, dtype=dtype, device=device)
        self.scale, self.use_tanh = given.scale, given.use_tanh
        joints, owner = np.unique(given.owner, return_inverse=True)
        rank = np.arange(len(owner)) - np.searchsorted(owner, owner)  # owners are in order
        self.width = int(rank.max(initial=0)) + 1
        left, right = (each.double().cpu().numpy() for each in (given.features.left, given.features.right))
        self.bind = keep((right @ left).transpose(2, 1, 0)[..., None])  # the turns whose features are zero

        first = given.first.scipy().toarray().reshape(len(owner), -1, 6)[:, 1:]  # of the root they are zero
        sees = np.stack([np.abs(first[owner == joint]).sum((0, 2)) > 0 for joint in range(len(joints))])
        near = np.argsort(~sees, axis=1, kind="stable")[:, : max(int(sees.sum(1).max()), 1)]
        linear = np.einsum("jra,jbc->jrcab", left, right[..., :2]).reshape(-1, 6, 9)
        excite = np.zeros((*near.shape, 9, self.width))
        for entry, (joint, place) in enumerate(zip(owner, rank, strict=True)):
            seen = near[joint]
            excite[joint, :, :, place] = np.einsum("jf,jfk->jk", first[entry, seen], linear[seen])
        self.near = keep(near.ravel())
        self.excite = keep(excite.reshape(len(joints), -1, self.width))
        self._keep_tiles(given.second.scipy(), owner, rank, len(joints), keep)

    def _keep_tiles(
        self,
        second: scipy.sparse.csr_array,
        owner: np.ndarray,
        rank: np.ndarray,
        joints: int,
        keep: functools.partial[Tensor],
    ) -> None:
        vertices = second.shape[0] // 3
        entries = second.tocoo()
        uses = np.zeros((vertices, joints), bool)
        uses[entries.row // 3, owner[entries.col]] = True
        moved = np.flatnonzero(uses.any(1))
        moved = moved[alike(uses[moved])]
        # one more than fill tiles: what is left over is zero, for all that nothing moves
        tiles = np.pad(moved, (0, _TILE - len(moved) % _TILE), constant_values=-1).reshape(-1, _TILE)
        taken = np.stack([uses[tile[tile >= 0]].any(0) for tile in tiles])
        order = np.argsort(-taken.sum(1), kind="stable")
        tiles, taken = tiles[order], taken[order]
        dense = second.tocsr()
        place, done, begin = np.full((vertices + 1, 3), -1), 0, 0
        self.kinds = 0
        for end in equal_parts(np.maximum(taken.sum(1), 1), _SIZES):
            part, count = tiles[begin:end], max(int(taken[begin].sum()), 1)
            picks = np.argsort(~taken[begin:end], axis=1, kind="stable")[:, :count]
            block = np.zeros((len(part), count, self.width, 3 * _TILE))
            for row, (tile, pick) in enumerate(zip(part, picks, strict=True)):
                rows = (3 * tile[tile >= 0, None] + np.arange(3)).ravel()
                slot = np.full(joints, -1)
                slot[pick] = np.arange(count)
                some = dense[rows].tocoo()
                used = slot[owner[some.col]]
                block[row, used, rank[some.col], some.row] = some.data
            setattr(self, f"picks_{self.kinds}", keep(picks.ravel()))
            setattr(self, f"block_{self.kinds}", keep(block.reshape(len(part), -1, 3 * _TILE)))
            place[part.ravel()] = done + np.arange(3 * part.size).reshape(-1, 3)
            done, begin, self.kinds = done + 3 * part.size, end, self.kinds + 1
        place = np.where(place < 0, place[-1], place)[:-1]
        self.place = keep(place.T.reshape(1, -1))

    def forward(self, relative: Tensor, bind_world: Tensor) -> Tensor:
        """Offsets (B, v, 3) [m]; takes what ``Correctives`` does."""
        return self.planes(relative.permute(2, 3, 1, 0), self.scale(bind_world)).transpose(1, 2)

    def planes(self, relative: Tensor, size: Tensor) -> Tensor:
        """Offsets (B, 3, v) [m] from rotations (3, 3, J - 1, B) and sizes (B or 1,).

        Bodies stand behind joints and tiles.
        """
        turns = (relative - self.bind).flatten(0, 1).permute(1, 2, 0)
        seen = _grouped(turns.index_select(0, self.near), len(self.excite))
        active = torch.relu(seen @ self.excite)
        if self.use_tanh:
            active = torch.tanh(active)
        active = active * size[:, None]
        parts = []
        for kind in range(self.kinds):
            picks, block = getattr(self, f"picks_{kind}"), getattr(self, f"block_{kind}")
            product = _grouped(active.index_select(0, picks), len(block)) @ block
            parts.append(product.transpose(0, 1).flatten(1))
        found = torch.cat(parts, 1).gather(1, self.place.expand(relative.shape[3], -1))
        return found.unflatten(1, (3, -1))


def _grouped(rows: Tensor, groups: int) -> Tensor:
    """Rows (g r, B, k) of `groups` groups of r side by side, (g, B, r k)."""
    return rows.unflatten(0, (groups, -1)).transpose(1, 2).flatten(2)
