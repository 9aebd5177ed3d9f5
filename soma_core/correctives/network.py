"""The trainable model: dense blocks where the masks allow, nothing where they do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

__all__ = ["CorrectivesNetwork"]

_OWN, _OTHER = 1.5, 0.4
"""Spread of the first weights that read the corrective's own joint, and those that read its neighbours."""


class CorrectivesNetwork(torch.nn.Module):
    """``tanh(relu(f W1)) W2`` over blocks: joints that a joint reads, vertices that it moves.

    Memory and work, forward and backward, grow with the entries of the masks, never with J x V.

    Args:
        joint_mask: M1 (J, J); see :func:`~soma_core.correctives.masks.joint_mask`.
        vertex_mask: M2 (J, v) in [0, 1] for the vertices that are trained.
        channels: activations a joint.
        seed: of the first weights.

    Attributes:
        joints: (a,) ids of the joints that have activations.
        sizes: how many vertices each of them moves.
        vertices: (p,) moved vertices, joint by joint.
        strength: (p,) their masks.
        first: parameters (a, 6 n, C), n the most joints that one reads; rows of absent joints see zeros.
        second: parameters (p, C, 3) [cm].
    """

    reads: Tensor
    vertices: Tensor
    strength: Tensor

    def __init__(
        self, joint_mask: np.ndarray, vertex_mask: scipy.sparse.csr_array, *, channels: int, seed: int
    ) -> None:
        super().__init__()
        count = len(joint_mask)
        self.channels, self.joint_count = channels, count
        self.vertex_count = vertex_mask.shape[1]
        self.joints = np.flatnonzero(joint_mask.any(0))  # the same at every level of detail
        mask = vertex_mask.tocsr()[self.joints].sorted_indices()
        self.sizes: Sequence[int] = np.diff(mask.indptr).tolist()
        reads = [np.flatnonzero(joint_mask[:, joint]) for joint in self.joints]
        width = max(map(len, reads))
        table = np.full((len(self.joints), width), count)  # `count` reads the zeros behind the last joint
        for row, found in enumerate(reads):
            table[row, : len(found)] = found
        self.register_buffer("reads", torch.as_tensor(table), persistent=False)
        self.register_buffer("vertices", torch.as_tensor(mask.indices.astype(np.int64)), persistent=False)
        self.register_buffer("strength", torch.as_tensor(mask.data).float(), persistent=False)
        spread = np.where(table == self.joints[:, None], _OWN, _OTHER) * (table < count)
        drawn = np.random.default_rng(seed).standard_normal((len(self.joints), width, 6, channels))
        first = (spread[:, :, None, None] * drawn).reshape(len(self.joints), 6 * width, channels)
        self.first = torch.nn.Parameter(torch.as_tensor(first).float())
        self.second = torch.nn.Parameter(torch.zeros(len(mask.indices), channels, 3))

    def activations(self, features: Tensor) -> Tensor:
        """Activations (a, B, C) in [0, 1) of features (B, J, 6)."""
        padded = torch.nn.functional.pad(features, (0, 0, 0, 1))
        seen = padded[:, self.reads].flatten(2).transpose(0, 1)
        return torch.tanh(torch.relu(torch.bmm(seen, self.first)))

    def forward(self, features: Tensor) -> Tensor:
        """Offsets (B, v, 3) [cm] of features (B, J, 6)."""
        active = self.activations(features)
        weights = self.masked_second()
        out = features.new_zeros(len(features), self.vertex_count, 3)
        blocks = zip(active, weights.split(self.sizes), self.vertices.split(self.sizes), strict=True)
        for joint_active, block, ids in blocks:
            moved = joint_active @ block.transpose(0, 1).flatten(1)
            out = out.index_add(1, ids, moved.unflatten(1, (-1, 3)))
        return out

    def masked_second(self) -> Tensor:
        """W2 with its mask multiplied in, (p, C, 3) [cm]."""
        return self.second * self.strength[:, None, None]

    @torch.no_grad()
    def take_first(self, matrix: scipy.sparse.csr_array) -> None:
        """Set W1 to a matrix (6 J, J C) of the same masks and channels; see :meth:`first_matrix`."""
        table, channels = self.reads.cpu().numpy(), self.channels
        padded = np.pad(matrix.toarray(), ((0, 6), (0, 0)))  # absent joints read the zeros at the end
        row = 6 * table[:, :, None, None] + np.arange(6)[:, None]
        column = channels * self.joints[:, None, None, None] + np.arange(channels)
        self.first.copy_(torch.as_tensor(padded[row, column]).view_as(self.first))

    def first_matrix(self) -> scipy.sparse.csr_array:
        """W1 as a matrix (6 J, J C), without the rows that see zeros."""
        table, values = self.reads.cpu().numpy(), self.first.detach().cpu().double().numpy()
        width, channels = table.shape[1], self.channels
        blocks = values.reshape(len(self.joints), width, 6, channels)
        row = 6 * table[:, :, None, None] + np.arange(6)[:, None]
        column = channels * self.joints[:, None, None, None] + np.arange(channels)
        row, column = np.broadcast_arrays(row, column)
        kept = np.broadcast_to((table < self.joint_count)[:, :, None, None], blocks.shape)
        entries = (blocks[kept], (row[kept], column[kept]))
        shape = (6 * self.joint_count, self.joint_count * channels)
        return scipy.sparse.csr_array(entries, shape=shape)
