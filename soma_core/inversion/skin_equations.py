"""The skinning error's normal equations over the moments of one rig (paper, section 3.6).

Perturbations are world-frame: joint j turns its whole subtree about its own centre, and a translation moves
everything. The Gauss-Newton matrix and the gradient follow from 4 x 4 moments by sums up the tree, each about
the joint's own centre (the parallel-axis rule), which keeps float32 accurate at the fingertips.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.constants import constant
from soma_core.geometry.rotations import skew
from soma_core.geometry.tree import joint_levels
from soma_core.inversion.driven import DrivenJoints
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.problem import Pose
from soma_core.inversion.structure import MomentStructure

__all__ = ["SkinEquations"]


class SkinEquations(torch.nn.Module):
    """The tree of one rig, and what the skinning error does when its joints turn.

    Args:
        structure: which joints share vertices; with `driven`, of the rig that has the helpers as joints.
        dtype, device: of the state.
        driven: joints whose turn follows from the others'; a pose does not hold them.

    Attributes:
        variables: (n,) joints that a step turns.
        movable: (N,) these and the driven joints that move skin.
        joints: (T,) joints that carry weight, driven ones included.
    """

    def __init__(
        self,
        structure: MomentStructure,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
        driven: DrivenJoints | None = None,
    ) -> None:
        super().__init__()
        self.driven = driven
        self.joint_count = len(structure.parents)
        self.public_count = self.joint_count if driven is None else driven.public_count
        self.level_count = 0

        keep = functools.partial(constant, device=device)
        self.joints = keep(structure.joints)
        self.movable = keep(structure.variables)
        self.variables = keep(structure.variables[structure.variables < self.public_count])
        self.parents = keep(np.maximum(structure.parents, 0))
        first, second = structure.pairs.T
        self.above = keep(structure.ancestors[structure.variables][:, structure.joints])
        self.pair_first = keep(first)
        self.pair_second = keep(second)
        for index, level in enumerate(joint_levels(structure.parents)):
            setattr(self, f"level_{index}", keep(level))
            setattr(self, f"public_{index}", keep(level[level < self.public_count]))
            self.level_count = index + 1
        self.eye = keep(torch.eye(3, dtype=dtype))

    def dense(self, second: Tensor) -> Tensor:
        """``N`` as symmetric matrices (i, 4 T, 4 T) from its pairs (i, p, 4, 4)."""
        count = len(self.joints)
        full = second.new_zeros(len(second), count, 4, count, 4)
        full[:, self.pair_second, :, self.pair_first] = second.transpose(-1, -2).transpose(0, 1)
        full[:, self.pair_first, :, self.pair_second] = second.transpose(0, 1)
        return full.flatten(3, 4).flatten(1, 2)

    def walk(self, pose: Pose, rest: RestMoments) -> tuple[Tensor, Tensor]:
        """Accumulated turns (F, J, 3, 3) and joint positions (F, J, 3) [m], of driven joints too."""
        turns, places = self.walk_public(pose, rest.offsets)
        if self.driven is None:
            return turns, places
        assert rest.driven is not None
        start, offsets = self.driven.start, rest.offsets[:, self.public_count :]
        spins, _ = self.driven.spins(turns, rest.driven)
        above = turns[:, start]
        step = (above @ offsets[..., None]).squeeze(-1)
        return torch.cat((turns, above @ spins), 1), torch.cat((places, places[:, start] + step), 1)

    def transforms(self, turns: Tensor, places: Tensor) -> Tensor:
        """``[D_t | c_t]`` (F, T, 3, 4) of the weighted joints."""
        return torch.cat((turns, places[..., None]), -1)[:, self.joints]

    def walk_public(self, pose: Pose, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """The same of the joints that a pose holds; bone vectors `offsets` (1 or F, J, 3) [m]."""
        turns = pose.relative.clone()
        places = torch.zeros_like(pose.relative[..., 0])
        for index in range(self.level_count):
            level = getattr(self, f"public_{index}")
            above = self.parents[level]
            turns[:, level] = turns[:, above] @ pose.relative[:, level]
            if index == 0:
                places[:, level] = pose.translation[:, None]
            else:
                step = (turns[:, above] @ offsets[:, level, :, None]).squeeze(-1)
                places[:, level] = places[:, above] + step
        return turns, places

    def times_second(self, transforms: Tensor, second: Tensor) -> Tensor:
        """``G N`` for (F, T, 3, 4) rows and dense ``N`` (i, 4 T, 4 T)."""
        flat = transforms.transpose(1, 2).flatten(2)
        shared = len(second) == 1
        product = (flat.flatten(0, 1) @ second[0]).view_as(flat) if shared else flat @ second
        return product.unflatten(2, (-1, 4)).transpose(1, 2)

    def gradient(self, turns: Tensor, places: Tensor, second: Tensor, target: Tensor) -> Tensor:
        """``P = G N - R`` (F, T, 3, 4), half the derivative of the energy by the joint transforms."""
        return self.times_second(self.transforms(turns, places), second) - target

    def normal_equations(
        self, turns: Tensor, places: Tensor, rest: RestMoments, residual: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """``J^T J`` (F, n + 1, 3, n + 1, 3) and ``J^T r`` (F, n + 1, 3), the translation last.

        Args:
            turns, places: of all joints, from :meth:`walk`.
            rest: of the identities.
            residual: ``P`` (F, T, 3, 4); None for zero.
        """
        if residual is None:
            residual = turns.new_zeros(len(turns), len(self.joints), 3, 4)
        matrix = self._free_matrix(turns, places, rest.second)
        slope = self._free_slopes(turns, places, residual)
        if self.driven is None:
            return matrix, slope
        fold = self.fold(turns, rest)
        once = self.folded(matrix.permute(0, 3, 4, 1, 2), fold)  # columns on the variables
        return self.folded(once.permute(0, 3, 4, 1, 2), fold), self.folded(slope, fold)

    def fold(self, turns: Tensor, rest: RestMoments) -> Tensor:
        """How the variables turn the driven joints that move skin, (F, h, 3, n, 3)."""
        assert self.driven is not None
        assert rest.driven is not None
        _, slope = self.driven.read(turns, rest.driven)
        columns = self.driven.columns(turns, slope, self.variables)
        return columns[:, self.movable[len(self.variables) :] - self.public_count]

    def folded(self, rows: Tensor, fold: Tensor) -> Tensor:
        """Rows (F, N + 1, 3, ...) by all movable joints onto the variables, (F, n + 1, 3, ...)."""
        n = len(self.variables)
        own, driven, last = rows[:, :n], rows[:, n:-1], rows[:, -1:]
        flat = driven.flatten(3) if driven.ndim > 3 else driven[..., None]
        moved = torch.einsum("fhanb,fhac->fnbc", fold, flat).reshape(own.shape)
        return torch.cat((own + moved, last), 1)

    def _free_matrix(self, turns: Tensor, places: Tensor, second: Tensor) -> Tensor:
        """``J^T J`` (F, N + 1, 3, N + 1, 3) as if driven joints turned freely."""
        moments = self._subtree_moments(turns, places, second)
        n = self.movable
        block = moments[:, n][:, :, n]
        spread = block[..., :3, :3]
        trace = spread.diagonal(dim1=-2, dim2=-1).sum(-1)
        rotational = trace[..., None, None] * self.eye - spread.transpose(-1, -2)
        lever = skew(moments[:, n, 0, :3, 3])
        count = len(n)
        matrix = turns.new_zeros(len(turns), count + 1, 3, count + 1, 3)
        matrix[:, :count, :, :count] = rotational.transpose(2, 3)
        matrix[:, :count, :, count] = lever
        matrix[:, count, :, :count] = lever.permute(0, 3, 1, 2)
        matrix[:, count, :, count] = moments[:, 0, 0, 3, 3][:, None, None] * self.eye
        return matrix

    def slopes(self, turns: Tensor, places: Tensor, rest: RestMoments, residual: Tensor) -> Tensor:
        """``J^T r`` (F, n + 1, 3) of the moments (F, T, 3, 4) of residuals, the translation last."""
        slope = self._free_slopes(turns, places, residual)
        return slope if self.driven is None else self.folded(slope, self.fold(turns, rest))

    def _free_slopes(self, turns: Tensor, places: Tensor, residual: Tensor) -> Tensor:
        spread, force = self.subtree_forces(turns, places, residual)
        torque = torch.stack(
            (
                spread[..., 1, 2] - spread[..., 2, 1],
                spread[..., 2, 0] - spread[..., 0, 2],
                spread[..., 0, 1] - spread[..., 1, 0],
            ),
            -1,
        )
        return torch.cat((torque[:, self.movable], force[:, :1]), 1)

    def _subtree_moments(self, turns: Tensor, places: Tensor, second: Tensor) -> Tensor:
        """``H_ij`` (F, J, J, 4, 4): second moments of subtree i against subtree j about their joints."""
        count = self.joint_count
        top = torch.cat((turns, torch.zeros_like(turns[..., :1])), -1)[:, self.joints]
        bottom = torch.zeros_like(top[..., :1, :])
        bottom[..., 3] = 1
        world = torch.cat((top, bottom), -2)
        block = world[:, self.pair_first] @ second @ world[:, self.pair_second].transpose(-1, -2)
        sums = turns.new_zeros(len(turns), count, count, 4, 4)
        first, other = self.joints[self.pair_first], self.joints[self.pair_second]
        sums[:, other, first] = block.transpose(-1, -2)
        sums[:, first, other] = block
        for index in reversed(range(self.level_count)):
            level = getattr(self, f"level_{index}")
            above = self.parents[level]
            shift = places[:, level] - places[:, above]
            rows = sums[:, level]
            rows[..., :3, :] += shift[:, :, None, :, None] * rows[..., 3:, :]
            sums.index_add_(1, above, rows)
        for index in reversed(range(self.level_count)):
            level = getattr(self, f"level_{index}")
            above = self.parents[level]
            shift = places[:, level] - places[:, above]
            columns = sums[:, :, level]
            columns[..., :3] += columns[..., 3:] * shift[:, None, :, None, :]
            sums.index_add_(2, above, columns)
        return sums

    def subtree_forces(self, turns: Tensor, places: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        """``sum q r^T`` (F, J, 3, 3) of each subtree about its joint, and the force on it (F, J, 3).

        Args:
            turns, places: of the joints, (F, J, 3, 3) and (F, J, 3).
            residual: moments (F, T, 3, 4) of the residuals r.
        """
        spread = turns.new_zeros(len(turns), self.joint_count, 3, 3)
        spread[:, self.joints] = turns[:, self.joints] @ residual[..., :3].transpose(-1, -2)
        force = turns.new_zeros(len(turns), self.joint_count, 3)
        force[:, self.joints] = residual[..., 3]
        for index in reversed(range(self.level_count)):
            level = getattr(self, f"level_{index}")
            above = self.parents[level]
            shift = places[:, level] - places[:, above]
            moved = spread[:, level] + shift[..., :, None] * force[:, level][..., None, :]
            spread.index_add_(1, above, moved)
            force.index_add_(1, above, force[:, level])
        return spread, force
