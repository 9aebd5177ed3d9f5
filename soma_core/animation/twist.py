"""Twist of procedural joints, driven by a definition alone (paper, section 3.5.1).

A helper rides on the start joint of its segment, sits at a share of the way to the end joint, and turns
about the segment by a weighted sum of twist channels. A channel is the twist angle of one public joint:

``local_x_euler``: from the absolute local rotation ``A``, ``s atan2(A[2, 1], A[1, 1])`` for axis x; for y
and z the second and third angle of ``A = Rx Ry Rz``.

``local_x_swing_twist``: ``s t(A, e)`` about the axis e of the joint's own frame.

``aligned_x_swing_twist``: ``t(D_ref^T D, x)``, with D the rotation of a joint from bind to posed in world
axes and x the direction of the segment at bind. The end joint is measured against the start joint, the
start joint of a reversed segment against the segment's parent. Zero in the bind pose.

``t(q, e) = 4 atan2(q_v . e, 1 + q_w)`` with ``q_w >= 0``: finite, with finite gradient, at every rotation.
An angle jumps by a full turn where a joint turns through 180 degrees: no function of the pose avoids that.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.kinematics import to_homogeneous
from soma_core.geometry.constants import constant
from soma_core.geometry.rotations import matrix_to_quaternion, skew
from soma_core.rig.procedural import ProceduralDefinition, TwistSegment
from soma_core.rig.skeleton import Rig

__all__ = ["Twist"]

_ALIGNED, _SWING = "aligned_x_swing_twist", "local_x_swing_twist"
_ORDER = {_ALIGNED: 0, _SWING: 1, "local_x_euler": 2}


@dataclass(frozen=True)
class _Channel:
    """One twist angle: how it is read, of which joint, against which, along which segment."""

    mode: str
    joint: int
    reference: int
    segment: TwistSegment


def _channel(definition: ProceduralDefinition, helper: str, source: str, rig: Rig) -> _Channel:
    """The channel that a column of the rotation matrix means for one helper."""
    mode, own = definition.modes[helper], definition.segment_of(helper)
    order = sorted(definition.segments, key=lambda segment: segment is not own)  # its own segment first
    ends = [segment for segment in order if segment.end == source]
    starts = [segment for segment in order if segment.reverse and segment.start == source]
    inherited = bool(starts) and (starts[0] is own or not ends)
    segment = (starts if inherited else ends)[0]
    joint = rig.joint_names.index(source)
    if mode != _ALIGNED:
        reference = max(int(rig.parents[joint]), 0)
    else:
        above = segment.parent if inherited else segment.start
        reference = rig.joint_names.index(str(above))
    return _Channel(mode, joint, reference, segment)


def _safe_atan2(y: Tensor, x: Tensor) -> Tensor:
    """atan2 with a zero, instead of undefined, value and gradient where both arguments vanish."""
    nothing = (x * x + y * y) < torch.finfo(x.dtype).eps ** 2
    return torch.atan2(y, torch.where(nothing, torch.ones_like(x), x))


def _half_angle(rotation: Tensor, axis: Tensor) -> Tensor:
    """Twist angle of rotations (..., 3, 3) about unit axes (..., 3), in [-pi, pi]."""
    quaternion = matrix_to_quaternion(rotation)
    along = (quaternion[..., 1:] * axis).sum(-1)
    return 4 * torch.atan2(along, 1 + quaternion[..., 0])


class Twist(torch.nn.Module):
    """World transforms of the helpers of one rig, from those of its public joints.

    Args:
        rig: a rig with `procedural`.
    """

    def __init__(self, rig: Rig, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        procedural = rig.procedural
        assert procedural is not None
        definition, names = procedural.definition, rig.joint_names
        segments = [definition.segment_of(helper) for helper in procedural.joint_names]
        ends = np.array([names.index(segment.end) for segment in segments])
        template = rig.bind_world[procedural.start_joints, :3, :3].transpose(0, 2, 1)
        step = template @ procedural.bind_world[:, :3, :3]
        axes = np.array([segment.sign * np.eye(3)[segment.axis] for segment in segments])

        keep = functools.partial(constant, device=device, dtype=dtype)
        self.start = keep(procedural.start_joints)
        self.end_user = keep(ends - 1)
        self.place = keep(definition.place(names))
        self.step = keep(step)
        self.axis = keep(np.einsum("hab,hb->ha", step, axes))  # in the frame of the start joint
        self.eye = keep(np.eye(3))
        self._keep_channels(keep, rig)

    def _keep_channels(self, keep: Callable[[np.ndarray], Tensor], rig: Rig) -> None:
        """Tables of the channels in use, and the matrix (H, K) from channels to angles."""
        procedural = rig.procedural
        assert procedural is not None
        definition = procedural.definition
        entries = [
            (row, _channel(definition, helper, source, rig), value)
            for row, helper in enumerate(procedural.joint_names)
            for source, value in definition.rotation.get(helper, {}).items()
        ]
        channels = sorted({channel for _, channel, _ in entries}, key=lambda c: (_ORDER[c.mode], c.joint))
        mix = np.zeros((len(procedural.joint_names), len(channels)))
        for row, channel, value in entries:
            mix[row, channels.index(channel)] += value
        self.mix = keep(mix)
        self.joint = keep(np.array([channel.joint for channel in channels], np.int64))
        self.reference = keep(np.array([channel.reference for channel in channels], np.int64))
        names, units = rig.joint_names, np.eye(3)
        self.low = keep(np.array([names.index(channel.segment.start) for channel in channels], np.int64))
        self.high = keep(np.array([names.index(channel.segment.end) for channel in channels], np.int64))
        signed = [channel.segment.sign * units[channel.segment.axis] for channel in channels]
        self.source_axis = keep(np.array(signed).reshape(-1, 3))
        self.counts = [sum(channel.mode == mode for channel in channels) for mode in _ORDER]
        euler = channels[sum(self.counts[:2]) :]
        self.euler_axis = keep(np.array([channel.segment.axis for channel in euler], np.int64))
        self.euler_sign = keep(np.array([float(channel.segment.sign) for channel in euler]))

    def forward(
        self, bind_world: Tensor, turns: Tensor, positions: Tensor, bone_scale: Tensor | None = None
    ) -> Tensor:
        """Skinning transforms ``G B^-1`` of the helpers, (B, H, 3, 4) [m].

        Args:
            bind_world: (B or 1, J, 4, 4) bind transforms of the identities [m].
            turns: (B, J, 3, 3) rotation of each public joint from bind to posed, world axes.
            positions: (B, J, 3) posed positions of the public joints [m].
            bone_scale: (B or 1, J - 1); a helper moves with the bone that leads to its end joint.
        """
        start = bind_world.index_select(1, self.start)
        bind = self.bind_positions(bind_world)
        away = bind - start[..., :3, 3]
        if bone_scale is not None:
            away = away * bone_scale[:, self.end_user, None]
        axis = start[..., :3, :3] @ self.axis[..., None]
        angle = (self.channels(bind_world, turns) @ self.mix.mT)[..., None, None]
        cosine = torch.cos(angle)
        spin = cosine * self.eye + torch.sin(angle) * skew(axis.squeeze(-1)) + (1 - cosine) * (axis @ axis.mT)
        carried = turns.index_select(1, self.start)
        shift = carried @ (away[..., None] - spin @ bind[..., None])
        placed = positions.index_select(1, self.start)[..., None] + shift
        return torch.cat((carried @ spin, placed), -1)

    def world_transforms(
        self, bind_world: Tensor, turns: Tensor, positions: Tensor, bone_scale: Tensor | None = None
    ) -> Tensor:
        """World transforms (B, H, 4, 4) [m] of the helpers; takes what :meth:`forward` does."""
        moved = self(bind_world, turns, positions, bone_scale)
        rotation, bind = moved[..., :3], self.bind_positions(bind_world)[..., None]
        return to_homogeneous(
            rotation @ self.bind_rotations(bind_world), (rotation @ bind + moved[..., 3:]).squeeze(-1)
        )

    def bind_positions(self, bind_world: Tensor) -> Tensor:
        """Positions of the helpers in the bind pose, (B, H, 3) [m], from (B, J, 4, 4)."""
        return self.place @ bind_world[..., :3, 3]

    def bind_rotations(self, bind_world: Tensor) -> Tensor:
        """Rotations of the helpers in the bind pose, (B, H, 3, 3), from (B, J, 4, 4)."""
        return bind_world[:, self.start, :3, :3] @ self.step

    def channels(self, bind_world: Tensor, turns: Tensor) -> Tensor:
        """Twist angles (B, K) [rad] of all channels in use."""
        between = turns.index_select(1, self.reference).mT @ turns.index_select(1, self.joint)
        aligned, local = self.counts[0], slice(self.counts[0], None)
        swing = slice(aligned, aligned + self.counts[1])
        parts = []
        if aligned:
            axis = self._directions(bind_world, slice(0, aligned))
            parts.append(_half_angle(between[:, :aligned], axis))
        if self.counts[1] or self.counts[2]:
            rotations = bind_world[..., :3, :3]
            before, after = rotations[:, self.reference[local]], rotations[:, self.joint[local]]
            absolute = before.mT @ between[:, local] @ after
            parts.append(_half_angle(absolute[:, : self.counts[1]], self.source_axis[swing]))
            parts.append(self._euler(absolute[:, self.counts[1] :]))
        return torch.cat(parts, -1)

    def _directions(self, bind_world: Tensor, part: slice) -> Tensor:
        """Unit vectors (B, k, 3) along the segments at bind, towards the positive source axis.

        The angle about them does not depend on the two other axes of a segment's frame.
        """
        places = bind_world[..., :3, 3]
        bone = places[:, self.high[part]] - places[:, self.low[part]]
        own = (bind_world[:, self.low[part], :3, :3] @ self.source_axis[part][..., None]).squeeze(-1)
        length = bone.norm(dim=-1, keepdim=True)
        bone = torch.where(length > 1e-8, bone / length.clamp_min(1e-8), own)
        return torch.where((bone * own).sum(-1, keepdim=True) < 0, -bone, bone)

    def _euler(self, absolute: Tensor) -> Tensor:
        """The Euler channels (B, k) of local rotations (B, k, 3, 3)."""
        entry = absolute.unbind(-2)
        (xx, xy, xz), (_, yy, _), (_, zy, _) = (row.unbind(-1) for row in entry)
        across = torch.sqrt((xx * xx + xy * xy).clamp_min(torch.finfo(xx.dtype).eps ** 2))
        angles = torch.stack((_safe_atan2(zy, yy), torch.atan2(xz, across), _safe_atan2(-xy, xx)), -1)
        chosen = angles.gather(-1, self.euler_axis.expand(angles.shape[:-1])[..., None])
        return self.euler_sign * chosen.squeeze(-1)
