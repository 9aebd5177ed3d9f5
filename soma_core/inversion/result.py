"""The result of pose inversion: the rig's rotations that reproduce posed vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

__all__ = ["InversionResult", "joined"]


@dataclass(frozen=True, kw_only=True, eq=False)
class InversionResult:
    """Pose of every frame, and how well it explains the target; paper, section 3.6.

    ``layer.pose(identity, result.rotations, result.translation)`` is the reconstruction.

    Attributes:
        rotations: T-pose-relative rotations, (frames, J - 1, 3, 3).
        translation: world position of the Hips [m], (frames, 3).
        vertex_error: distance of each canonical vertex of the reconstruction to its target [m], (frames, v);
            NaN where the frame is not valid or the target has no value.
        valid: (frames,) bool; False where a frame could not be used (NaN, collapsed, mirrored, out of scale).
            Its rotations are identity, and no other frame is affected.
        determined: (frames, J - 1) bool; whether the target determines the joint's rotation. False for joints
            without skin weight, without weighted vertices, whose vertices have collapsed to a point, or of
            which a robust fit left out most vertices.
        converged: (frames,) bool; a Newton step under the model that was fitted would change the frame by
            less than a hundredth or so of the error that is left, and that is not all on few of the
            vertices, as it is where a limb stopped in a wrong place, or where a few vertices are wrong and
            `robust` was not asked for. Under plain skinning, the last step no longer lowered the energy
            noticeably.
        iterations: (frames,) int, accepted steps.
        residual: root mean square of the weighted vertex error [m], (frames,); NaN where not valid.
        angle_std: standard deviation of each joint's own rotation, (frames, J - 1) [degrees]: root mean
            square angle that independent noise of the vertices, as large as the error left, turns the joint
            by against its parent. To first order: many degrees say no more than that it is open. NaN
            where the frame is not valid or the joint not determined.
    """

    rotations: Tensor
    translation: Tensor
    vertex_error: Tensor
    valid: Tensor
    determined: Tensor
    converged: Tensor
    iterations: Tensor
    residual: Tensor
    angle_std: Tensor

    def where(self, chosen: Tensor, other: InversionResult) -> InversionResult:
        """This result for the frames `chosen` (frames,), another's for the rest."""
        parts = {}
        for one in fields(self):
            own, their = getattr(self, one.name), getattr(other, one.name)
            parts[one.name] = torch.where(chosen.view(-1, *[1] * (own.ndim - 1)), own, their)
        return InversionResult(**parts)

    def part(self, chunk: slice) -> InversionResult:
        """The result of a chunk of frames."""
        return InversionResult(**{one.name: getattr(self, one.name)[chunk] for one in fields(self)})


def joined(parts: Sequence[InversionResult]) -> InversionResult:
    """One result of consecutive chunks of frames."""
    if len(parts) == 1:
        return parts[0]
    names = [one.name for one in fields(InversionResult)]
    return InversionResult(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
