"""Forward kinematics in the frame of the T-pose (paper, section 3.5.1)."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.constants import constant
from soma_core.geometry.torch_func import exporting, transformed
from soma_core.geometry.tree import descendants, joint_levels
from soma_core.rig.skeleton import Rig

__all__ = ["Kinematics", "absolute_from_relative", "relative_from_absolute", "to_homogeneous"]


def relative_from_absolute(absolute: Tensor, orient: Tensor, parent_orient: Tensor) -> Tensor:
    """``R_j = O_p A_j O_j^T``: local rotations of the rig's own axes to T-pose-relative ones.

    Args:
        absolute: (..., J - 1, 3, 3) local rotations A of the user joints.
        orient, parent_orient: (J - 1, 3, 3) T-pose world rotations of each joint and of its parent.
    """
    return parent_orient @ absolute @ orient.transpose(-1, -2)


def absolute_from_relative(relative: Tensor, orient: Tensor, parent_orient: Tensor) -> Tensor:
    """``A_j = O_p^T R_j O_j``, the inverse of :func:`relative_from_absolute`."""
    return parent_orient.transpose(-1, -2) @ relative @ orient


def to_homogeneous(rotations: Tensor, positions: Tensor) -> Tensor:
    """Transforms (..., 4, 4) from rotations (..., 3, 3) and positions (..., 3)."""
    top = torch.cat((rotations, positions[..., None]), -1)
    bottom = top.new_zeros(*top.shape[:-2], 1, 4)
    bottom[..., 3] = 1
    return torch.cat((top, bottom), -2)


class Kinematics(torch.nn.Module):
    """The rig's joint tree with constant orientations.

    Rotations are T-pose-relative: in axes aligned with the world at T-pose, identity is the T-pose, and
    the joint orient cancels down the chain: ``W_j = (R_1 ... R_j) O_j``.

    Args:
        rig: joint tree, bind pose and T-pose.
        warp: run the Warp twin instead of the torch reference.
    """

    def __init__(
        self, rig: Rig, *, dtype: torch.dtype, device: torch.device | str, warp: bool = False
    ) -> None:
        super().__init__()
        self.warp, self.joint_count = warp, rig.joint_count
        parents = np.maximum(rig.parents, 0)
        orient = rig.t_pose_world[:, :3, :3].copy()
        orient[0] = np.eye(3)
        bind = rig.bind_world[:, :3, :3]
        bind_local = np.einsum("jba,jbc->jac", bind[parents], bind)
        bind_relative = np.einsum("jab,jbc,jdc->jad", orient[parents], bind_local, orient)
        levels = joint_levels(rig.parents)
        order = np.concatenate([[0], *levels])
        where = np.argsort(order)
        self.level_sizes = [len(level) for level in levels]

        keep = functools.partial(constant, device=device, dtype=dtype)
        self.parents = keep(parents[1:])
        self.tree = keep(rig.parents)
        self.order = keep(order)
        self.restore = keep(where)
        self.orient = keep(orient)
        self.parent_orient = keep(orient[parents])
        self.bind_relative = keep(bind_relative[1:])
        bind_turn = bind @ orient.transpose(0, 2, 1)  # accumulated turns of the bind pose
        self.bind_rotation = keep(bind)
        self.bind_parent_turn = keep(bind_turn[parents])
        self.ancestors = keep(descendants(rig.parents).T.astype(float))  # sums from the root down
        jumps = [parents]
        while 2 ** len(jumps) < len(levels):
            jumps.append(jumps[-1][jumps[-1]])
        self.jumps = keep(np.stack(jumps))  # to the parent, two joints up, four, ...
        first = 0  # rank, in level order, of the first joint on the level above
        for index, level in enumerate(levels):
            setattr(self, f"level_{index}", keep(level))
            setattr(self, f"level_parent_{index}", keep(where[parents[level]] - first))
            first += 1 if index == 0 else self.level_sizes[index - 1]

    def local_offsets(self, bind_world: Tensor) -> Tensor:
        """Bone vectors in parent-joint axes, turned to T-pose world axes; (B, J, 4, 4) -> (B, J, 3) [m]."""
        positions, rotations = bind_world[..., :3, 3], bind_world[..., :3, :3]
        step = positions[:, 1:] - positions[:, self.parents]
        turn = self.parent_orient[1:] @ rotations[:, self.parents].transpose(-1, -2)
        return torch.cat((positions[:, :1], (turn @ step[..., None]).squeeze(-1)), 1)

    def forward(self, relative: Tensor, offsets: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
        """World rotations (B, J, 3, 3) and positions (B, J, 3) [m].

        Args:
            relative: (B, J - 1, 3, 3) T-pose-relative rotations of the user joints.
            offsets: (B or 1, J, 3) from :meth:`local_offsets`.
            translation: (B, 3) Hips position [m]; replaces its offset.
        """
        batch = relative.shape[0]
        eye = torch.eye(3, dtype=relative.dtype, device=relative.device).expand(batch, 1, 3, 3)
        root, limbs = torch.zeros_like(translation)[:, None], offsets[:, 2:].expand(batch, -1, 3)
        turns = torch.cat((eye, relative), 1)
        offsets = torch.cat((root, translation[:, None], limbs), 1)
        if self.warp and not transformed():
            from soma_core.kernels.kinematics_wp import forward_kinematics

            turns, positions = forward_kinematics(turns, offsets, self.order, self.tree)
        else:
            turns, positions = self._walk(turns, offsets)
        return turns @ self.orient, positions

    def bind_positions(self, offsets: Tensor, hips: Tensor) -> Tensor:
        """Joint positions (B, J, 3) [m] in the bind pose, whose turns are constant; see :meth:`positions`."""
        return self.positions(self.bind_parent_turn, offsets, hips)

    def positions(self, parent_turns: Tensor, offsets: Tensor, hips: Tensor) -> Tensor:
        """Joint positions (B, J, 3) [m] where the turns are known: a sum down the tree.

        Args:
            parent_turns: turns from the T-pose of each joint's parent, (J, 3, 3) or (B, J, 3, 3).
            offsets: (B or 1, J, 3) from :meth:`local_offsets`.
            hips: (B, 3) Hips position [m].
        """
        steps = (parent_turns[..., 2:, :, :] @ offsets[:, 2:, :, None]).squeeze(-1)
        steps = torch.cat((torch.zeros_like(hips)[:, None], hips[:, None], steps), 1)
        return self.ancestors @ steps

    def _walk(self, relative: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Accumulate turns and positions level by level from the root.

        In an engine a step costs more than its products: there each joint takes up the turns of 1, 2, 4, ...
        joints above it, which the root's, no turn, ends.
        """
        if exporting():
            found = relative
            for jump in self.jumps:
                found = found.index_select(1, jump) @ found
            steps = found.index_select(1, self.jumps[0]) @ offsets[..., None]
            return found, self.ancestors @ steps.squeeze(-1)
        turns, places = [relative[:, :1]], [offsets[:, :1]]
        for index in range(len(self.level_sizes)):
            level, parent = getattr(self, f"level_{index}"), getattr(self, f"level_parent_{index}")
            above = turns[-1].index_select(1, parent)
            step = (above @ offsets.index_select(1, level)[..., None]).squeeze(-1)
            places.append(places[-1].index_select(1, parent) + step)
            turns.append(above @ relative.index_select(1, level))
        joined = torch.cat(turns, 1), torch.cat(places, 1)
        return joined[0].index_select(1, self.restore), joined[1].index_select(1, self.restore)
