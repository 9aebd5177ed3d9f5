"""Where a fit begins: each joint's own points, aligned one joint at a time (paper, section 3.6)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.constants import constant
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.inversion.limbs import LimbStart
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.structure import MomentStructure

__all__ = ["ProcrustesStart", "best_translation", "cloud_extent"]


class ProcrustesStart(torch.nn.Module):
    """Weighted Procrustes of every joint's points about their own centre; the Hips by the mean residual.

    Needs nothing but the moments of the target, so that missing vertices and any vertex weights are no
    special case. Joints without points follow their parent.

    Args:
        structure: joints, and which of them carry weight.
        public_count: how many of the joints a pose has, the first ones; None for all.
        limbs: what turns the joints that twist joints hang on; None without such.
        warp: align by the Warp twin where no derivative is asked for; None, on a CPU.
    """

    def __init__(
        self,
        structure: MomentStructure,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
        public_count: int | None = None,
        limbs: LimbStart | None = None,
        warp: bool | None = None,
    ) -> None:
        super().__init__()
        self.warp = torch.device(device).type == "cpu" if warp is None else warp
        self.limbs = limbs
        parents = np.maximum(structure.parents[:public_count], 0)
        source = np.full(len(parents), len(structure.joints))  # the root: identity, appended last
        own = structure.joints < len(parents)
        source[structure.joints[own]] = np.flatnonzero(own)
        for joint in range(1, len(parents)):
            if source[joint] == len(structure.joints):
                source[joint] = source[parents[joint]]
        self.parents, self.source = constant(parents, device=device), constant(source, device=device)
        self.eye = constant(np.eye(3), device=device, dtype=dtype)

    def forward(self, target: Tensor, rest: RestMoments) -> Tensor:
        """T-pose-relative rotations (F, J, 3, 3) from ``R`` (F, T, 3, 4)."""
        turns = self._nearest(_covariance(target, rest.own[..., 3, :]))
        eye = self.eye.expand(len(turns), 1, 3, 3)
        limbs = None if self.limbs is None else self.limbs(turns, rest.own[..., 3, 3])
        turns = torch.cat((turns, eye), 1)[:, self.source]
        if self.limbs is not None and limbs is not None:
            turns = turns.index_copy(1, self.limbs.starts, limbs)
        relative = turns[:, self.parents].transpose(-1, -2) @ turns
        return torch.cat((eye, relative[:, 1:]), 1)

    def _nearest(self, covariance: Tensor) -> Tensor:
        if not self.warp or (torch.is_grad_enabled() and covariance.requires_grad):
            return rotation_from_covariance(covariance)
        from soma_core.kernels.nearest_rotation_wp import nearest_rotation

        return nearest_rotation(covariance)


def best_translation(target: Tensor, rest: RestMoments, turns: Tensor, places: Tensor) -> Tensor:
    """Shift (F, 3) [m] that takes the mean residual of a pose to zero.

    Args:
        target: ``R`` (F, T, 3, 4).
        rest: moments of the identity.
        turns, places: world turns (F, T, 3, 3) and positions (F, T, 3) of the weighted joints.
    """
    mean = rest.own[..., 3, :]
    reached = (turns @ mean[..., :3, None]).squeeze(-1) + places * mean[..., 3:]
    return (target[..., 3].sum(1) - reached.sum(1)) / mean[..., 3].sum(1)[:, None].clamp_min(1e-12)


def cloud_extent(target: Tensor, rest: RestMoments) -> tuple[Tensor, Tensor]:
    """How much of each joint's cloud is left, and on which side of a mirror it lies.

    Args:
        target: ``R`` (F, T, 3, 4).
        rest: moments of the identity.

    Returns:
        Norm of the covariance with the rest points over that of the rest points with themselves, (F, T):
        one for a rigid motion, s for a scaling by s, zero for a collapsed cloud. And the sign of the
        covariance's determinant, (F, T): -1 for a mirrored cloud.
    """
    covariance = _covariance(target, rest.own[..., 3, :])
    own = _covariance(rest.own[..., :3, :], rest.own[..., 3, :])
    norm = torch.linalg.matrix_norm
    ratio = norm(covariance) / norm(own).clamp_min(torch.finfo(own.dtype).tiny)
    a, b, c = covariance.unbind(-2)
    return ratio, torch.sign((a * torch.linalg.cross(b, c, dim=-1)).sum(-1))


def _covariance(moments: Tensor, mean: Tensor) -> Tensor:
    """Covariance (..., T, 3, 3) of posed and rest points of each joint about their weighted centres."""
    mass = mean[..., 3:].clamp_min(torch.finfo(mean.dtype).tiny)
    return moments[..., :3] - moments[..., 3:] * (mean[..., :3] / mass)[..., None, :]
