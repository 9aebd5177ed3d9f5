"""Stage 2 of the skeleton fit: joint rotations by Kabsch and child alignment (paper, section 3.4.2)."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.constants import constant
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.rotations import shortest_arc
from soma_core.geometry.torch_func import transformed
from soma_core.rig.skeleton import Rig

__all__ = ["AlignmentPlan", "RotationFit", "alignment_plan"]

_SHORTEST_BONE = 1e-8
"""Bones shorter than this fraction of body height do not turn their joint."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AlignmentPlan:
    """Which joints are turned by what; index lists are over all J joints.

    Attributes:
        pivots: joints with children, Root excluded, (p,).
        child_table: (p, width) ids of each pivot's children, bones too short left out, padded with -1.
        source: for each joint the position in `pivots` whose displacement it takes; -1 is identity.
    """

    pivots: np.ndarray
    child_table: np.ndarray
    source: np.ndarray


def alignment_plan(rig: Rig) -> AlignmentPlan:
    """Sort the joints by how stage 2b turns them: one child, several, or none (takes its parent's)."""
    height = float(np.ptp(rig.bind_shape[:, 1])) if len(rig.bind_shape) else 1.0
    positions = rig.bind_world[:, :3, 3]
    children: dict[int, list[int]] = {}
    for joint in range(1, rig.joint_count):
        parent = int(rig.parents[joint])
        long_enough = np.linalg.norm(positions[joint] - positions[parent]) > _SHORTEST_BONE * height
        if parent > 0 and long_enough:
            children.setdefault(parent, []).append(joint)
    pivots = sorted(children)
    rank = {joint: index for index, joint in enumerate(pivots)}
    source = np.full(rig.joint_count, -1)
    for joint in range(1, rig.joint_count):
        source[joint] = rank.get(joint, source[rig.parents[joint]])
    width = max([2, *(len(children[joint]) for joint in pivots)])
    table = np.full((len(pivots), width), -1)
    for row, joint in enumerate(pivots):
        table[row, : len(children[joint])] = children[joint]
    return AlignmentPlan(pivots=np.array(pivots, np.int64), child_table=table, source=source)


class RotationFit(torch.nn.Module):
    """World rotations of all joints; (B, J, 3), (B, J, 3, 3) -> (B, J, 3, 3).

    Stage a: ``R_init`` is the rotation nearest to the covariance ``sum (x - j)(a - j_bind)^T`` of the
    joint's vertices. Stage b: one child, the shortest arc from the turned bind bone to the fitted one;
    several children, the rotation nearest to the covariance of their bones and of the normals of each
    pair of bones; none, the displacement of the parent.
    A fan of children is nearly flat (hips, chest, hand): its bones alone leave the tilt of that plane
    to their smallest deviations. The pairs' normals hold it, whatever the order of the children.
    The world rotation is ``R_align R_init R_bind``. Differentiable; every joint independent of the
    others, so a posed body is fitted as well as a body at rest.

    Args:
        rig: joints and bind pose.
        warp: run the Warp twin instead of the torch reference.

    Attributes:
        fused: whether :meth:`world` stands in for :meth:`forward` where no gradient is asked.
    """

    def __init__(
        self, rig: Rig, *, dtype: torch.dtype, device: torch.device | str, warp: bool = False
    ) -> None:
        super().__init__()
        self.warp = warp
        self.fused = warp and torch.device(device).type == "cuda"
        plan = alignment_plan(rig)
        table, bind = plan.child_table, rig.bind_world[:, :3, 3]
        single, several = np.flatnonzero(table[:, 1] < 0), np.flatnonzero(table[:, 1] >= 0)
        slot, column = np.nonzero(table[several] >= 0)

        keep = functools.partial(constant, device=device, dtype=dtype)
        self.pivots = keep(plan.pivots)
        self.child_table = keep(np.where(table < 0, plan.pivots[:, None], table))  # padded with itself
        self.single = keep(single)
        self.single_child = keep(table[single, 0])
        self.several = keep(several)
        self.fan_slot = keep(slot)
        self.fan_child = keep(table[several[slot], column])
        pairs = [
            (rank, i, j)
            for rank in range(len(several))
            for i in np.flatnonzero(slot == rank)
            for j in np.flatnonzero(slot == rank)
            if i < j
        ]
        self.pair = keep(np.array(pairs, np.int64).reshape(-1, 3).T)
        self.order = keep(np.argsort(np.concatenate([single, several])))
        self.source = keep(plan.source + 1)
        self.bind = keep(bind)
        self.bones = keep(bind - bind[np.maximum(rig.parents, 0)])
        self.bind_rotation = keep(rig.bind_world[:, :3, :3])

    def forward(self, joints: Tensor, covariances: Tensor) -> Tensor:
        """World rotations (B, J, 3, 3) from joint positions (B, J, 3) and covariances (B, J, 3, 3)."""
        if self.warp and not transformed():
            from soma_core.kernels.skeleton_fit_wp import fit_displacements

            displacement = fit_displacements(joints, covariances, self.bind, self.pivots, self.child_table)
        else:
            displacement = self.displacements(joints, covariances, self.bones)
        eye = torch.eye(3, dtype=joints.dtype, device=joints.device).expand(joints.shape[0], 1, 3, 3)
        world = torch.cat((eye, displacement), 1)[:, self.source] @ self.bind_rotation
        return 1.5 * world - 0.5 * world @ (world.transpose(-1, -2) @ world)  # undo the products' rounding

    def world(self, joints: Tensor, covariances: Tensor) -> Tensor:
        """World transforms (B, J, 4, 4) [m] by kernels alone; takes what :meth:`forward` does."""
        from soma_core.kernels.identity_wp import fitted_world
        from soma_core.kernels.skeleton_fit_wp import fit_displacements

        turns = fit_displacements(joints, covariances, self.bind, self.pivots, self.child_table)
        return fitted_world(turns, self.source, self.bind_rotation, joints)

    def displacements(self, joints: Tensor, covariances: Tensor, bones: Tensor) -> Tensor:
        """Turns (B, p, 3, 3) of the pivots that take `bones`, each from a joint's parent, to `joints`.

        Args:
            joints: positions (B, J, 3).
            covariances: (B, J, 3, 3), with points in the axes of the bones.
            bones: (J, 3), or (B or 1, J, 3).
        """
        initial = rotation_from_covariance(covariances[:, self.pivots])
        bones = bones.expand(joints.shape[0], -1, -1)
        first, target = self._bones(joints, initial, bones, self.single, self.single_child)
        aligned = shortest_arc(first, target) @ initial[:, self.single]
        rank = self.several[self.fan_slot]
        first, target = self._bones(joints, initial, bones, rank, self.fan_child)
        outer = target[..., :, None] * first[..., None, :]
        sums = outer.new_zeros(joints.shape[0], len(self.several), 3, 3).index_add(1, self.fan_slot, outer)
        sums = sums.index_add(1, self.pair[0], self._pair_normals(first, target))
        spread = rotation_from_covariance(sums) @ initial[:, self.several]
        return torch.cat((aligned, spread), 1)[:, self.order]

    def _pair_normals(self, first: Tensor, target: Tensor) -> Tensor:
        """Covariance of the normals of each pair of bones, scaled to length by the area they span."""
        (i, j), tiny = self.pair[1:], torch.finfo(first.dtype).tiny ** 0.5
        source = torch.linalg.cross(first[:, i], first[:, j], dim=-1)
        goal = torch.linalg.cross(target[:, i], target[:, j], dim=-1)
        area = (((source * source).sum(-1) + tiny) * ((goal * goal).sum(-1) + tiny)) ** -0.25
        return area[..., None, None] * goal[..., :, None] * source[..., None, :]

    def _bones(
        self, joints: Tensor, initial: Tensor, bones: Tensor, rank: Tensor, child: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Bones turned by stage a, and fitted bones, from the pivots at `rank` to `child`."""
        turned = (initial[:, rank] @ bones[:, child, :, None]).squeeze(-1)
        return turned, joints[:, child] - joints[:, self.pivots[rank]]
