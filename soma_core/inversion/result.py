"""The result of pose inversion: the rig's rotations that reproduce posed vertices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from soma_core.inversion.problem import Pose
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["IdentityFit", "InversionResult", "PointResult", "joined"]


@dataclass(frozen=True, kw_only=True, eq=False)
class InversionResult:
    """Pose of every frame, and how well it explains the target; paper, section 3.6.

    :meth:`posed` reconstructs the target: as ``layer.pose(identity, result.rotations, result.translation)``
    does, and ``layer.pose_plain`` for the frames that are `plain`.

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
        plain: (frames,) bool; whether the pose, and all that is said of it, are those of plain skinning under
            a layer that has more. So are frames whose skin another rig moved, where twist joints and
            correctives explain less of it than plain skinning does, and all frames if that was asked for.
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
    plain: Tensor
    angle_std: Tensor

    def pose(self, origin: Tensor | float = 0.0) -> Pose:
        """The poses as a fit takes them, about an origin (frames, 3) [m]; they carry no gradient."""
        rotations = self.rotations.detach()
        still = torch.eye(3).to(rotations).expand(len(rotations), 1, 3, 3)
        return Pose.begin(torch.cat((still, rotations), 1), self.translation.detach() - origin)

    def posed(self, layer: SomaLayer, identity: Identity, bone_scale: Tensor | None = None) -> Tensor:
        """Vertices (frames, v, 3) [m] of the reconstruction, under the skinning that each frame was told by.

        Args:
            layer, identity, bone_scale: as given to the fit.
        """
        given = identity, self.rotations, self.translation
        full = layer.pose(*given, bone_scale=bone_scale).vertices
        if not bool(self.plain.any()):
            return full
        plain = layer.pose_plain(*given, bone_scale=bone_scale).vertices
        return torch.where(self.plain[:, None, None], plain, full)

    def where(self, chosen: Tensor, other: InversionResult) -> InversionResult:
        """This result for the frames `chosen` (frames,), another's for the rest."""
        parts = {}
        for one in fields(self):
            own, their = getattr(self, one.name), getattr(other, one.name)
            parts[one.name] = torch.where(chosen.view(-1, *[1] * (own.ndim - 1)), own, their)
        return InversionResult(**parts)

    def mean_error(self, weights: Tensor) -> Tensor:
        """Mean vertex error (frames,) [m] under weights (1 or frames, v)."""
        known = torch.where(weights > 0, self.vertex_error, 0.0).nan_to_num(nan=0.0)
        return (weights * known).sum(1) / weights.sum(1)

    def put(self, rows: Tensor, other: InversionResult) -> InversionResult:
        """This result, with that of another in the place of some frames."""
        names = [one.name for one in fields(self)]
        return InversionResult(
            **{name: getattr(self, name).index_copy(0, rows, getattr(other, name)) for name in names}
        )

    def part(self, chunk: slice | Tensor) -> InversionResult:
        """The result of some frames."""
        return InversionResult(**{one.name: getattr(self, one.name)[chunk] for one in fields(self)})


@dataclass(frozen=True, kw_only=True, eq=False)
class PointResult(InversionResult):
    """The pose of every frame, and how well it explains the points.

    ``vertex_error`` is that of the points, (frames, P). ``determined`` says which joints the points tell more
    of than what is expected of a person anyway; ``angle_std`` of the others is the spread that is expected.

    Attributes:
        noise: standard deviation of a coordinate of the points [m], as it was given or found.
    """

    noise: float

    @property
    def point_error(self) -> Tensor:
        """Distance of each point to its target [m], (frames, P); NaN where it is not known."""
        return self.vertex_error


def joined(parts: Sequence[InversionResult]) -> InversionResult:
    """One result of consecutive chunks of frames."""
    if len(parts) == 1:
        return parts[0]
    names = [one.name for one in fields(InversionResult)]
    return InversionResult(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True, kw_only=True, eq=False)
class IdentityFit:
    """One identity for a sequence, and its poses.

    Attributes:
        identity: the rest shape and its skeleton, batch of 1.
        params: the backend's parameters of that shape; when unposed, of the shape it began from.
        pose: of every frame under the identity.
        frames: (n,) numbers of the frames that the identity was estimated from.
        history: root mean square vertex error [m] over those frames at the start and after each step, while
            joint centres may move. It rises where vertices that are not explained begin to count less.
        converged: whether the last step no longer changed the error noticeably.
    """

    identity: Identity
    params: Mapping[str, Tensor]
    pose: InversionResult
    frames: Tensor
    history: tuple[float, ...]
    converged: bool
