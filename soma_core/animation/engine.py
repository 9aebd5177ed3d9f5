"""Repose and pose on one rig, by the torch reference or its Warp twins (paper, section 3.5.1)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from soma_core.animation.kinematics import Kinematics, relative_from_absolute, to_homogeneous
from soma_core.animation.posed import Posed
from soma_core.animation.skinning import Skinning, skinning_transforms
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["Animation"]

_POSES = 128
"""Poses skinned at a time when one body is shared; bounds memory at a few tens of megabytes."""


class Animation(torch.nn.Module):
    """Forward kinematics and skinning of one rig at one LOD.

    Args:
        rig: joints and weights.
        kernels: ``torch``, ``warp`` or ``auto``.
    """

    def __init__(
        self, rig: Rig, *, dtype: torch.dtype, device: torch.device, kernels: Literal["auto", "torch", "warp"]
    ) -> None:
        super().__init__()
        # Measured (benchmarks/README.md): on CPU Warp wins the tree walk and torch the sparse blend.
        self.warp_skinning = kernels == "warp" or (kernels == "auto" and device.type == "cuda")
        self.kinematics = Kinematics(rig, dtype=dtype, device=device, warp=kernels != "torch")
        self.skinning = Skinning(rig.weights, dtype=dtype, device=device)

    def repose(self, vertices: Tensor, fitted: Tensor) -> tuple[Tensor, Tensor]:
        """Bring fitted bodies to the rig's bind pose.

        Args:
            vertices: (v, 3, B) [m].
            fitted: (B, J, 4, 4) transforms fitted to them [m].

        Returns:
            Vertices (v, 3, B) and world transforms (B, J, 4, 4) in the bind pose; the Hips stay in place.
        """
        relative = self.kinematics.bind_relative.expand(len(fitted), -1, 3, 3)
        offsets = self.kinematics.local_offsets(fitted)
        rotations, positions = self.kinematics(relative, offsets, fitted[:, 1, :3, 3])
        transforms = skinning_transforms(rotations, positions, fitted)
        if self.warp_skinning:
            skinned = self._skin(vertices.permute(2, 0, 1), transforms).permute(1, 2, 0)
        else:
            skinned = self.skinning(vertices, transforms)
        return skinned, to_homogeneous(rotations, positions)

    def pose(self, identity: Identity, relative: Tensor, translation: Tensor, *, absolute: bool) -> Posed:
        """Posed bodies; `relative` (B, J - 1, 3, 3) and `translation` (B, 3) [m] are already checked."""
        kinematics = self.kinematics
        if absolute:
            relative = relative_from_absolute(relative, kinematics.orient[1:], kinematics.parent_orient[1:])
        offsets = kinematics.local_offsets(identity.bind_world)
        rotations, positions = kinematics(relative, offsets, translation)
        transforms = skinning_transforms(rotations, positions, identity.bind_world)
        return Posed(
            vertices=self._skin(identity.rest, transforms),
            joints=positions[:, 1:],
            transforms=to_homogeneous(rotations, positions),
        )

    def _skin(self, rest: Tensor, transforms: Tensor) -> Tensor:
        """Posed vertices (B, v, 3), contiguous."""
        batch, count = len(transforms), rest.shape[1]
        if self.warp_skinning:
            from soma_core.kernels.skinning_wp import skin

            weights = self.skinning.weights
            return skin(rest.expand(batch, count, 3).contiguous(), transforms, weights.csr, weights.transpose)
        if len(rest) == 1 and not rest.requires_grad:
            parts = [
                self.skinning.shared(rest[0], transforms[start : start + _POSES])
                for start in range(0, batch, _POSES)
            ]
        else:
            parts = [self.skinning(rest.permute(1, 2, 0), transforms)]
        rows = [part.reshape(count * 3, -1).t() for part in parts]
        flat = rows[0].contiguous() if len(rows) == 1 else torch.cat(rows)
        return flat.view(batch, count, 3)
