"""Stage 2 of the skeleton fit: joint rotations by Kabsch and child alignment (paper, section 3.4.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.rotations import shortest_arc
from soma_core.rig.skeleton import Rig

__all__ = ["AlignmentPlan", "alignment_plan", "fit_rotations"]

_SHORTEST_BONE = 1e-8
"""Bones shorter than this fraction of body height do not turn their joint."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AlignmentPlan:
    """Which joints are turned by what; index lists are over all J joints.

    Attributes:
        pivots: joints with children, Root excluded, (p,).
        only_child: for each pivot the id of its single child, or -1, (p,).
        child_start: offsets into `children`, (p + 1,).
        children: children of the pivots, bones too short left out, concatenated.
        source: for each joint the position in `pivots` whose displacement it takes; -1 is identity.
    """

    pivots: np.ndarray
    only_child: np.ndarray
    child_start: np.ndarray
    children: np.ndarray
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
    counts = [len(children[joint]) for joint in pivots]
    return AlignmentPlan(
        pivots=np.array(pivots, np.int64),
        only_child=np.array([children[j][0] if len(children[j]) == 1 else -1 for j in pivots], np.int64),
        child_start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        children=np.array([c for j in pivots for c in children[j]], np.int64),
        source=source,
    )


class RotationFit(torch.nn.Module):
    """Stage 2 for all joints at once, on constant index lists; see :func:`fit_rotations`."""

    def __init__(self, rig: Rig, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        self.plan = plan = alignment_plan(rig)
        bind = rig.bind_world[:, :3, 3]
        single = np.flatnonzero(plan.only_child >= 0)
        several = np.flatnonzero(plan.only_child < 0)
        owner = np.repeat(np.arange(len(plan.pivots)), np.diff(plan.child_start))
        fan = np.isin(owner, several)
        slot = np.searchsorted(several, owner[fan])

        def keep(name: str, array: np.ndarray) -> None:
            tensor = torch.as_tensor(np.ascontiguousarray(array), device=device)
            self.register_buffer(name, tensor.to(dtype) if tensor.is_floating_point() else tensor, persistent=False)

        keep("pivots", plan.pivots)
        keep("single", single)
        keep("single_parent", plan.pivots[single])
        keep("single_child", plan.only_child[single])
        keep("single_bone", bind[plan.only_child[single]] - bind[plan.pivots[single]])
        keep("several", several)
        keep("fan_slot", slot)
        keep("fan_owner", owner[fan])
        keep("fan_parent", plan.pivots[owner[fan]])
        keep("fan_child", plan.children[fan])
        keep("fan_bone", bind[plan.children[fan]] - bind[plan.pivots[owner[fan]]])
        keep("order", np.argsort(np.concatenate([single, several])))
        keep("source", plan.source + 1)
        keep("bind_rotation", rig.bind_world[:, :3, :3])

    def forward(self, joints: Tensor, covariances: Tensor) -> Tensor:
        """World rotations (B, J, 3, 3) from joint positions (B, J, 3) and covariances (B, J, 3, 3)."""
        initial = rotation_from_covariance(covariances[:, self.pivots])
        first = initial[:, self.single]
        turned = (first @ self.single_bone[:, :, None]).squeeze(-1)
        target = joints[:, self.single_child] - joints[:, self.single_parent]
        aligned = shortest_arc(turned, target) @ first
        fan = (initial[:, self.fan_owner] @ self.fan_bone[:, :, None]).squeeze(-1)
        reach = joints[:, self.fan_child] - joints[:, self.fan_parent]
        outer = reach[..., :, None] * fan[..., None, :]
        sums = outer.new_zeros(len(joints), len(self.several), 3, 3).index_add(1, self.fan_slot, outer)
        spread = rotation_from_covariance(sums) @ initial[:, self.several]
        displacement = torch.cat((aligned, spread), 1)[:, self.order]
        eye = torch.eye(3, dtype=joints.dtype, device=joints.device).expand(len(joints), 1, 3, 3)
        return torch.cat((eye, displacement), 1)[:, self.source] @ self.bind_rotation


def fit_rotations(rig: Rig, joints: Tensor, covariances: Tensor) -> Tensor:
    """World rotations of all joints; (B, J, 3), (B, J, 3, 3) -> (B, J, 3, 3).

    Stage a: ``R_init`` is the rotation nearest to the covariance ``sum (x - j)(a - j_bind)^T`` of the
    joint's vertices. Stage b: one child, the shortest arc from the turned bind bone to the fitted one;
    several children, the rotation nearest to their covariance; none, the displacement of the parent.
    The world rotation is ``R_align R_init R_bind``. Differentiable; every joint independent of the
    others, so a posed body is fitted as well as a body at rest.
    """
    return RotationFit(rig, dtype=joints.dtype, device=joints.device)(joints, covariances)
