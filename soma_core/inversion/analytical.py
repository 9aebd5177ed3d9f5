"""Hierarchical inverse skinning: Procrustes of one tree level after the other (paper, section 3.6).

With all other joints fixed, turning the whole subtree of joint j about its centre c_j by Q moves its share
``q_vj = sum_(t in subtree) w_vt (y_vt - c_j)`` of every vertex to ``Q q_vj``. The best Q is the rotation
nearest to ``sum_v o_v (q_vj - r_v) q_vj^T = S_j - Y_j^T``, r_v the residual: what the paper computes by
subtracting the ancestors' part from the posed vertices. Both terms follow from the moments, so that no vertex
is touched, and none has to be assigned to one subtree.
"""

from __future__ import annotations

import functools
import itertools
import re
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.geometry.constants import constant
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.tree import joint_levels
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.problem import Pose
from soma_core.inversion.structure import MomentStructure
from soma_core.rig.skeleton import Rig

__all__ = ["Analytical", "AnalyticalOptions", "Level", "sweep_levels"]

_FINGERS = r"(Left|Right)Hand\w+"
"""Joints below the hands."""


@dataclass(frozen=True, kw_only=True)
class AnalyticalOptions:
    """How often the tree is swept; the defaults are the paper's.

    Attributes:
        body: sweeps over all joints but the fingers, which follow their hand.
        fingers: sweeps over the fingers alone.
        full: sweeps over all joints.

    Raises:
        InputError: a negative number.
    """

    body: int = 2
    fingers: int = 0
    full: int = 1

    def __post_init__(self) -> None:
        for name in ("body", "fingers", "full"):
            count = getattr(self, name)
            if count < 0:
                raise InputError(
                    f"analytical.{name}",
                    got=count,
                    expected="at least 0",
                    fix=f"Pass {name}=1, or 0 for none.",
                )


class Level(torch.nn.Module):
    """Joints of one depth that are turned together, and what hangs from them.

    Attributes:
        moved: (m,) joints, none of which lies below another.
        below: (b,) joints of their subtrees, themselves included.
        owner: (b,) position in `moved` of the joint that each hangs from.
        weighted: (r,) positions in `below` of those that carry weight.
        rows: (r,) their positions among the weighted joints of the moments.
        columns: (4 r,) rows of theirs in the dense ``N``.
        hips: whether this is the Hips, which the translation moves too.
    """

    def __init__(self, structure: MomentStructure, moved: np.ndarray, *, device: torch.device | str) -> None:
        super().__init__()
        owner, below = np.nonzero(structure.ancestors[moved])
        rank = np.full(len(structure.parents), -1)
        rank[structure.joints] = np.arange(len(structure.joints))
        weighted = np.flatnonzero(rank[below] >= 0)
        self.hips = bool((structure.parents[moved] == 0).all())
        rows = rank[below[weighted]]
        keep = functools.partial(constant, device=device)
        self.moved, self.below, self.owner = keep(moved), keep(below), keep(owner)
        self.weighted, self.rows = keep(weighted), keep(rows)
        self.columns = keep((4 * rows[:, None] + np.arange(4)).ravel())


def sweep_levels(
    structure: MomentStructure, chosen: np.ndarray, *, device: torch.device | str
) -> torch.nn.ModuleList:
    """Levels from the root to the leaves, of those joints in `chosen` that a fit can determine.

    Each level must lie below the one before: a sweep follows the residual of what is below alone.
    """
    kept = np.intersect1d(structure.variables, chosen)
    parts = [np.intersect1d(level, kept) for level in joint_levels(structure.parents)]
    parts = [part for part in parts if len(part)]
    assert all(structure.ancestors[a].any(0)[b].all() for a, b in itertools.pairwise(parts))
    return torch.nn.ModuleList(Level(structure, part, device=device) for part in parts)


class Analytical(torch.nn.Module):
    """Sweeps the tree from the root to the leaves; a level that would raise the energy is left as it was.

    Args:
        structure: which joints share vertices.
        rig: for the names of the fingers' joints.
        solver: keeps the tree and multiplies by the moments.
        options: number of sweeps.
    """

    def __init__(
        self, structure: MomentStructure, rig: Rig, solver: GaussNewton, *, options: AnalyticalOptions
    ) -> None:
        super().__init__()
        self.solver, self.options = solver, options
        device = solver.joints.device
        fingers = [joint for joint, name in enumerate(rig.joint_names) if re.fullmatch(_FINGERS, name)]
        self.body = sweep_levels(structure, np.setdiff1d(structure.variables, fingers), device=device)
        self.fingers = sweep_levels(structure, np.array(fingers, np.int64), device=device)
        self.full = sweep_levels(structure, structure.variables, device=device)
        self.meeting = constant(_meeting_joints(structure), device=device)

    def forward(self, target: Tensor, rest: RestMoments, start: Pose) -> Pose:
        """Refine `start`; never worse than it.

        Args:
            target: ``R`` (F, T, 3, 4) of the targets.
            rest: moments of one identity or of one a frame.
            start: poses to begin from.
        """
        options, second = self.options, self.solver.dense(rest.second)
        schedule = [self.body] * options.body + [self.fingers] * options.fingers + [self.full] * options.full
        pose = start
        for levels in schedule:
            pose = self.sweep(pose, levels, target, rest, second)
        return pose

    def sweep(
        self,
        pose: Pose,
        levels: torch.nn.ModuleList,
        target: Tensor,
        rest: RestMoments,
        second: Tensor,
    ) -> Pose:
        """Turn each level's joints to their optimum; `second` is the dense ``N``."""
        turns, places = self.solver.walk(pose, rest)
        residual = self.solver.gradient(turns, places, second, target)
        # A joint's own moments, in its own axes, change only when joints below it are turned.
        spread = self._spread(pose.relative, turns, places, rest)
        relative, shift = pose.relative.clone(), pose.translation
        gained = torch.zeros_like(pose.last_change)
        for level in levels:
            assert isinstance(level, Level)
            turn, step = _best_step(level, turns, places, residual, spread[:, level.moved])
            change = _change(level, turns, places, turn, step)
            block = second[:, level.columns][:, :, level.columns]
            product = self.solver.times_second(change[:, level.weighted], block)
            energy = (change[:, level.weighted] * (product + 2 * residual[:, level.rows])).sum((1, 2, 3))
            better = energy < 0
            keep = better[:, None, None, None]
            local = turns[:, level.moved].transpose(-1, -2) @ turn @ turns[:, level.moved]
            moved = relative[:, level.moved] @ local
            moved = 1.5 * moved - 0.5 * moved @ (moved.transpose(-1, -2) @ moved)
            relative[:, level.moved] = torch.where(keep, moved, relative[:, level.moved])
            shift = torch.where(better[:, None], shift + step, shift)
            change = torch.where(keep, change, 0)
            turns[:, level.below] += change[..., :3]
            places[:, level.below] += change[..., 3]
            residual[:, level.rows] += torch.where(keep, product, 0)
            gained = gained + torch.where(better, energy, 0)
        return replace(
            pose,
            relative=relative,
            translation=shift,
            accepted=pose.accepted + (gained < 0),
            last_change=(-gained / rest.own[..., 3, 3].sum(1)).sqrt(),
        )

    def _spread(self, relative: Tensor, turns: Tensor, places: Tensor, rest: RestMoments) -> Tensor:
        """Second moments (F, J, 4, 4) of ``(q_vj; s_v)`` about each joint, in its own axes."""
        solver, meeting = self.solver, self.meeting
        first, other = (solver.joints[pair] for pair in (solver.pair_first, solver.pair_second))
        back = turns[:, meeting].transpose(-1, -2)

        def seen(joint: Tensor) -> Tensor:
            step = (places[:, joint] - places[:, meeting])[..., None]
            return _homogeneous(back @ turns[:, joint], (back @ step).squeeze(-1))

        block = seen(first) @ rest.second @ seen(other).transpose(-1, -2)
        twice = (first != other)[:, None, None]
        block = block + torch.where(twice, block.transpose(-1, -2), 0)
        sums = turns.new_zeros(*turns.shape[:2], 4, 4).index_add(1, meeting, block)
        down = _homogeneous(relative, rest.offsets.expand(len(relative), -1, -1))
        for index in reversed(range(1, solver.level_count)):
            level = getattr(solver, f"level_{index}")
            step = down[:, level]
            sums.index_add_(1, solver.parents[level], step @ sums[:, level] @ step.transpose(-1, -2))
        return sums


def _best_step(
    level: Level, turns: Tensor, places: Tensor, residual: Tensor, spread: Tensor
) -> tuple[Tensor, Tensor]:
    """World turns (F, m, 3, 3) of a level's joints, each the best one by itself, and the shift (F, 3) [m]."""
    own = turns[:, level.moved]
    below, owner = level.below[level.weighted], level.owner[level.weighted]
    pull, force = residual[:, level.rows, :, :3], residual[:, level.rows, :, 3]
    arm = places[:, below] - places[:, level.moved[owner]]
    torque = turns[:, below] @ pull.transpose(-1, -2) + arm[..., :, None] * force[..., None, :]
    torque = torch.zeros_like(own).index_add(1, owner, torque)
    cloud = own @ spread[..., :3, :3] @ own.transpose(-1, -2) - torque.transpose(-1, -2)
    if not level.hips:
        return rotation_from_covariance(cloud), torch.zeros_like(places[:, 0])
    # The translation follows the Hips' rotation: eliminate it, which centres the cloud.
    mass = spread[..., 3, 3, None].clamp_min(torch.finfo(cloud.dtype).tiny)
    mean = (own @ spread[..., :3, 3:]).squeeze(-1)
    goal = mean - force.sum(1, keepdim=True)
    turn = rotation_from_covariance(cloud - goal[..., :, None] * (mean / mass)[..., None, :])
    return turn, ((goal - (turn @ mean[..., None]).squeeze(-1)) / mass).sum(1)


def _change(level: Level, turns: Tensor, places: Tensor, turn: Tensor, step: Tensor) -> Tensor:
    """Change (F, b, 3, 4) of the transforms below a level when its joints are turned, and all is shifted."""
    by = (turn - torch.eye(3, dtype=turn.dtype, device=turn.device))[:, level.owner]
    arm = places[:, level.below] - places[:, level.moved[level.owner]]
    return torch.cat((by @ turns[:, level.below], by @ arm[..., None] + step[:, None, :, None]), -1)


def _homogeneous(turn: Tensor, place: Tensor) -> Tensor:
    bottom = turn.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*turn.shape[:-2], 1, 4)
    return torch.cat((torch.cat((turn, place[..., None]), -1), bottom), -2)


def _meeting_joints(structure: MomentStructure) -> np.ndarray:
    """(p,) lowest joint that has both joints of a pair in its subtree."""
    above = structure.ancestors
    first, second = structure.joints[structure.pairs].T
    both = above[:, first] & above[:, second]
    depth = above.sum(0)
    return np.where(both, depth[:, None], -1).argmax(0).astype(np.int64)
