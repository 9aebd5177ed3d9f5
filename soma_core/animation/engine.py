"""Repose and pose on one rig, by the torch reference or its Warp twins (paper, section 3.5.1)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import torch
from torch import Tensor

from soma_core.animation.kinematics import Kinematics, relative_from_absolute, to_homogeneous
from soma_core.animation.posed import Posed
from soma_core.animation.skinning import Skinning, skinning_transforms
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["Animation"]


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

    def repose(self, points: Tensor, fitted: Tensor) -> tuple[Tensor, Tensor]:
        """Bring fitted bodies to the rig's bind pose.

        Args:
            points: vertices as planes (3, v, B) [m].
            fitted: (B, J, 4, 4) transforms fitted to them [m].

        Returns:
            Planes (3, v, B) and world transforms (B, J, 4, 4) in the bind pose; the Hips stay in place.
        """
        kinematics = self.kinematics
        positions = kinematics.bind_positions(kinematics.local_offsets(fitted), fitted[:, 1, :3, 3])
        rotations = kinematics.bind_rotation.expand(len(fitted), -1, 3, 3)
        transforms = skinning_transforms(rotations, positions, fitted)
        if self.warp_skinning:
            skinned = self._skin_warp(points.permute(2, 1, 0), transforms).permute(2, 1, 0)
        else:
            skinned = self.skinning(points, transforms, rows=False)
        return skinned, to_homogeneous(rotations, positions)

    def bone_vectors(self, identity: Identity, bone_scale: Tensor | None = None) -> Tensor:
        """Bone vectors in T-pose world axes, (B, J, 3) [m], times `bone_scale` (1 or B, J - 1)."""
        offsets = self.kinematics.local_offsets(identity.bind_world)
        if bone_scale is None:
            return offsets
        return offsets * torch.nn.functional.pad(bone_scale, (1, 0), value=1.0)[..., None]

    def pose(
        self,
        identity: Identity,
        relative: Tensor,
        translation: Tensor,
        *,
        absolute: bool,
        bone_scale: Tensor | None = None,
    ) -> Posed:
        """Posed bodies; what is given is already checked.

        Args:
            identity: of batch 1 or B.
            relative: (B, J - 1, 3, 3), or local rotations of the rig's own axes when `absolute`.
            translation: Hips positions (B, 3) [m].
            bone_scale: factors (1 or B, J - 1) of the user joints' bone vectors; the skin is not refitted.
        """
        rotations, positions = self._walk(identity, relative, translation, bone_scale, absolute=absolute)
        transforms = skinning_transforms(rotations, positions, identity.bind_world)
        return Posed(
            vertices=self._skin(identity.rest, transforms),
            joints=positions[:, 1:],
            transforms=to_homogeneous(rotations, positions),
        )

    def pose_all(
        self, bodies: Iterable[tuple[Identity, Tensor, Tensor, Tensor | None]], batch: int, *, absolute: bool
    ) -> Posed:
        """Pose a stream of (identity, relative, translation, bone scale) chunks; no derivative.

        Each is dropped after use.

        Args:
            bodies: chunks that add up to `batch` bodies, one identity a pose.
            batch: total number of bodies.
        """
        vertices, world, start = None, [], 0
        for identity, relative, translation, bone_scale in bodies:
            if vertices is None:
                vertices = identity.rest.new_empty(batch, *identity.rest.shape[1:])
            rotations, positions = self._walk(identity, relative, translation, bone_scale, absolute=absolute)
            transforms = skinning_transforms(rotations, positions, identity.bind_world)
            stop = start + len(relative)
            self.skinning.into(vertices[start:stop], identity.rest.permute(2, 1, 0), transforms)
            world.append(to_homogeneous(rotations, positions))
            start = stop
        joined = torch.cat(world)
        return Posed(vertices=vertices, joints=joined[:, 1:, :3, 3], transforms=joined)

    def _walk(
        self,
        identity: Identity,
        relative: Tensor,
        translation: Tensor,
        bone_scale: Tensor | None,
        *,
        absolute: bool,
    ) -> tuple[Tensor, Tensor]:
        """World rotations and positions of the joints."""
        if absolute:
            kinematics = self.kinematics
            relative = relative_from_absolute(relative, kinematics.orient[1:], kinematics.parent_orient[1:])
        return self.kinematics(relative, self.bone_vectors(identity, bone_scale), translation)

    def _skin(self, rest: Tensor, transforms: Tensor) -> Tensor:
        """Posed vertices (B, v, 3), contiguous, from rest vertices (B or 1, v, 3)."""
        if self.warp_skinning:
            return self._skin_warp(rest, transforms)
        if len(rest) == 1 and not rest.requires_grad:
            return self.skinning.shared(rest[0], transforms)
        return self.skinning(rest.permute(2, 1, 0), transforms, rows=True)

    def _skin_warp(self, rest: Tensor, transforms: Tensor) -> Tensor:
        from soma_core.kernels.skinning_wp import skin

        points = rest.expand(len(transforms), -1, 3).contiguous()
        return skin(points, transforms, self.skinning.weights.csr, self.skinning.weights.transpose)
