"""Twist joints as joints of the fit whose turn is a known function of the pose (paper, section 3.5.1).

A helper hangs on its start joint and has one degree of freedom, its spin about the bone: a fixed sum of
twist angles, each read between two joints that a pose controls. So its place and turn follow from the pose,
and so does their derivative: a world-frame spin of a channel's joint turns the helper by ``m a (g . spin)``,
with a the helper's axis and ``g`` the gradient of the twist angle. Everything that holds for a tree of free
joints then holds for the pose alone, once the helpers' columns are folded onto those of the joints that drive
them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.twist import Twist
from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_quaternion
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["DrivenJoints", "DrivenRest", "half_angle", "rig_with_helpers"]


@dataclass(frozen=True, kw_only=True, eq=False)
class DrivenRest:
    """What the twist angles of an identity are read with; batch i is 1 or one a frame.

    With world turns D from the T-pose, channel k reads ``left^T D_ref^T D_joint right``.

    Attributes:
        left, right: (i, K, 3, 3).
        axis: (i, K, 3) unit axis of the channel; not used by Euler channels.
    """

    left: Tensor
    right: Tensor
    axis: Tensor


def rig_with_helpers(rig: Rig) -> Rig:
    """The rig with its procedural joints as ordinary ones, behind the J public joints."""
    procedural = rig.procedural
    assert procedural is not None
    start = procedural.start_joints
    step = np.linalg.inv(rig.bind_world[start]) @ procedural.bind_world
    return replace(
        rig,
        joint_names=(*rig.joint_names, *procedural.joint_names),
        parents=np.concatenate([rig.parents, start]).astype(rig.parents.dtype),
        bind_world=np.concatenate([rig.bind_world, procedural.bind_world]),
        t_pose_world=np.concatenate([rig.t_pose_world, rig.t_pose_world[start] @ step]),
        weights=procedural.weights,
        procedural=None,
    )


class DrivenJoints(torch.nn.Module):
    """The helpers of one rig in the frame of the T-pose.

    Args:
        rig: a rig with `procedural`.

    Attributes:
        public_count: J.
        start: (H,) joint that each helper hangs on.
        spin_axis: (H, 3) unit axis of each helper's spin, in the T-pose's world axes.
        mix: (H, K) helper angles from channels.
        joint, reference: (K,) joints that a channel is read between.
        chain: (K, J) 1 for the joints from below `reference` down to `joint`.
        turning: whether every channel is read as half angle, not by Euler angles.
    """

    start: Tensor
    spin_axis: Tensor
    mix: Tensor
    joint: Tensor
    reference: Tensor
    chain: Tensor
    orient: Tensor

    def __init__(self, rig: Rig, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        self.twist = twist = Twist(rig, dtype=dtype, device=device)
        exact = Twist(rig, dtype=torch.float64, device="cpu")
        self.public_count = rig.joint_count
        orient = rig.t_pose_world[:, :3, :3].copy()
        orient[0] = np.eye(3)
        axes = np.einsum("hab,hb->ha", orient[exact.start.numpy()], exact.axis.numpy())
        chain = np.zeros((len(exact.joint), rig.joint_count))
        ends = zip(exact.joint.tolist(), exact.reference.tolist(), strict=True)
        for row, (joint, reference) in enumerate(ends):
            step = joint
            while step != reference and step > 0:
                chain[row, step] = 1
                step = int(rig.parents[step])
        for name, array in (("orient", orient), ("spin_axis", axes), ("chain", chain)):
            tensor = torch.as_tensor(array, device=device).to(dtype)
            self.register_buffer(name, tensor, persistent=False)
        self.start, self.mix = twist.start, twist.mix
        self.joint, self.reference = twist.joint, twist.reference
        self.turning = not twist.counts[2]

    def extended(self, identity: Identity) -> Identity:
        """The identity with bind transforms (i, J + H, 4, 4) of the helpers behind the public ones [m]."""
        bind = identity.bind_world
        helpers = torch.eye(4, dtype=bind.dtype, device=bind.device).repeat(len(bind), len(self.start), 1, 1)
        helpers[..., :3, :3] = self.twist.bind_rotations(bind)
        helpers[..., :3, 3] = self.twist.bind_positions(bind)
        return replace(identity, bind_world=torch.cat((bind, helpers), 1))

    def offsets(self, bind_world: Tensor, bone_scale: Tensor | None) -> Tensor:
        """Helper places about their start joints in T-pose world axes, (i, H, 3) [m].

        Args:
            bind_world: (i, J, 4, 4) of the public joints.
            bone_scale: (1 or i, J - 1); a helper moves with the bone that leads to its end joint.
        """
        start = bind_world[:, self.start]
        away = self.twist.bind_positions(bind_world) - start[..., :3, 3]
        if bone_scale is not None:
            away = away * bone_scale[:, self.twist.end_user, None]
        turn = self.orient[self.start] @ start[..., :3, :3].mT
        return (turn @ away[..., None]).squeeze(-1)

    def rest(self, bind_world: Tensor) -> DrivenRest:
        """Constants of identities with bind transforms (i, J, 4, 4)."""
        turn = self.orient @ bind_world[..., :3, :3].mT
        aligned = self.twist.counts[0]
        fixed = self.orient.expand(len(bind_world), -1, 3, 3)
        read = [
            torch.cat((turn[:, of[:aligned]], fixed[:, of[aligned:]]), 1)
            for of in (self.reference, self.joint)
        ]
        axis = self.twist.source_axis.expand(len(bind_world), -1, 3)
        if aligned:
            directions = self.twist._directions(bind_world, slice(0, aligned))
            axis = torch.cat((directions, axis[:, aligned:]), 1)
        return DrivenRest(left=read[0], right=read[1], axis=axis)

    def read(self, turns: Tensor, rest: DrivenRest) -> tuple[Tensor, Tensor]:
        """Twist angles (F, K) [rad], and gradients (F, K, 3) by the spin of `joint` against `reference`.

        Args:
            turns: world turns (F, J or more, 3, 3) from the T-pose.
            rest: of the identities.
        """
        reference = turns[:, self.reference]
        seen = rest.left.mT @ (reference.mT @ turns[:, self.joint]) @ rest.right
        half = sum(self.twist.counts[:2])
        angle, slope = half_angle(seen[:, :half], rest.axis[:, :half])
        if half < seen.shape[1]:
            other, steep = self._euler(seen[:, half:])
            angle, slope = torch.cat((angle, other), 1), torch.cat((slope, steep), 1)
        return angle, (reference @ (rest.left @ slope[..., None])).squeeze(-1)

    def spins(self, turns: Tensor, rest: DrivenRest) -> tuple[Tensor, Tensor]:
        """Rotations (F, H, 3, 3) of the helpers against their start joints; gradients of :meth:`read`."""
        angle, slope = self.read(turns, rest)
        return axis_angle_to_matrix((angle @ self.mix.mT)[..., None] * self.spin_axis), slope

    def axes(self, turns: Tensor) -> Tensor:
        """World axes (F, H, 3) that the helpers spin about."""
        return (turns[:, self.start] @ self.spin_axis[..., None]).squeeze(-1)

    def columns(self, turns: Tensor, slope: Tensor, variables: Tensor) -> Tensor:
        """How spins of the joints `variables` (n,) turn the helpers, (F, H, 3, n, 3)."""
        share = torch.einsum("hk,kn,fkc->fhnc", self.mix, self.chain[:, variables], slope)
        return self.axes(turns)[..., :, None, None] * share[:, :, None]

    def _euler(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Euler channels (F, k) of rotations (F, k, 3, 3), and their gradients by a spin on the left."""
        tiny = torch.finfo(seen.dtype).eps ** 2
        (xx, xy, _), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in seen.unbind(-2))
        across = (xx * xx + xy * xy).clamp_min(tiny)
        down = (yy * yy + zy * zy).clamp_min(tiny)
        one, none = torch.ones_like(xx), torch.zeros_like(xx)
        about_x = torch.stack((one, -xy * yy / down, -xy * zy / down), -1)
        about_y = torch.stack((none, zz, -yz), -1) / across.sqrt()[..., None]
        about_z = torch.stack((none, (xy * zx - xx * zy), (xx * yy - xy * yx)), -1) / across[..., None]
        slopes = torch.stack((about_x, about_y, about_z), -2)
        chosen = self.twist.euler_axis.expand(slopes.shape[:-2])[..., None, None]
        slope = torch.take_along_dim(slopes, chosen, -2).squeeze(-2)
        return self.twist._euler(seen), self.twist.euler_sign[..., None] * slope


def half_angle(rotation: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Twist ``4 atan2(q_v . e, 1 + q_w)`` about unit axes, and its gradient by a spin on the left."""
    quaternion = matrix_to_quaternion(rotation)
    real, vector = quaternion[..., :1], quaternion[..., 1:]
    along = (vector * axis).sum(-1, keepdim=True)
    more = 1 + real
    slope = more * (real * axis + torch.linalg.cross(vector, axis.expand_as(vector), dim=-1)) + along * vector
    # Not atan2: PyTorch 2.13 rounds it by where an entry lies in a tensor, so that frames would touch.
    angle = 4 * torch.atan(along / more).squeeze(-1)
    return angle, 2 * slope / (more * more + along * along)
