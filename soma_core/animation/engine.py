"""Repose and pose on one rig, by the torch reference or its Warp twins (paper, section 3.5.1)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from torch import Tensor

from soma_core.animation.kinematics import Kinematics, relative_from_absolute, to_homogeneous
from soma_core.animation.posed import Posed
from soma_core.animation.skinning import Skinning, skinning_transforms
from soma_core.animation.twist import Twist
from soma_core.geometry.torch_func import transformed, untracked
from soma_core.kernels.patches import Patches
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

if TYPE_CHECKING:
    from soma_core.kernels.body_skin_wp import Blend

__all__ = ["Animation", "Body", "ProceduralAnimation"]


class Body(NamedTuple):
    """What poses a batch of bodies, checked; the fields are the arguments of :meth:`Animation.pose`."""

    identity: Identity
    relative: Tensor
    translation: Tensor
    bone_scale: Tensor | None = None
    offsets: Tensor | None = None


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
        self.skinning = Skinning(rig.skin, dtype=dtype, device=device)
        self.posed_skinning = self.skinning
        self.patches: Patches | None = None
        self.blend: Blend | None = None

    def fuse(self, *, by_patches: bool) -> None:
        """Skin :meth:`repose` by one kernel where no gradient is asked; `by_patches` as a GPU does."""
        weights, kinematics = self.skinning.weights.scipy(), self.kinematics
        device, dtype = kinematics.orient.device, kinematics.orient.dtype
        if by_patches:
            patches = Patches(weights, None, dtype=dtype, device=device)
            self.patches = patches if patches.fits else None
            return
        from soma_core.kernels.body_skin_wp import blend_of

        self.blend = blend_of(weights, dtype=dtype)

    def repose(self, points: Tensor, fitted: Tensor) -> tuple[Tensor, Tensor]:
        """Bring fitted bodies to the rig's bind pose.

        Args:
            points: vertices as planes (3, v, B) [m].
            fitted: (B, J, 4, 4) transforms fitted to them [m].

        Returns:
            Planes (3, v, B) and world transforms (B, J, 4, 4) in the bind pose; the Hips stay in place.
        """
        transforms, world = self.to_bind_pose(fitted)
        if (self.patches or self.blend) and untracked(points, fitted):
            return self._skin_fused(points.permute(2, 1, 0), transforms).permute(2, 1, 0), world
        if self.warp_skinning and not transformed():
            return _skin_warp(self.skinning, points.permute(2, 1, 0), transforms).permute(2, 1, 0), world
        return self.skinning(points, transforms, rows=False), world

    def _skin_fused(self, points: Tensor, transforms: Tensor) -> Tensor:
        """Skinned vertices (B, v, 3) by one kernel, without their derivative."""
        if self.patches is not None:
            from soma_core.kernels.fused_pose_wp import skin_patches

            tables = self.patches.ints, self.patches.shorts, self.patches.reals
            return skin_patches(points, transforms, None, *tables, patches=self.patches.count)
        from soma_core.kernels.body_skin_wp import skin_bodies

        assert self.blend is not None
        return skin_bodies(points, transforms, self.blend)

    def to_bind_pose(self, fitted: Tensor) -> tuple[Tensor, Tensor]:
        """What brings fitted bodies to the bind pose, (B, J, 3, 4), and transforms there, (B, J, 4, 4)."""
        kinematics = self.kinematics
        if (self.patches or self.blend) and untracked(fitted):
            from soma_core.kernels.identity_wp import to_bind_pose

            constants = kinematics.bind_rotation, kinematics.parent_orient, kinematics.bind_parent_turn
            world, transforms = to_bind_pose(fitted, kinematics.tree, *constants)
            return transforms, world
        positions = kinematics.bind_positions(kinematics.local_offsets(fitted), fitted[:, 1, :3, 3])
        rotations = kinematics.bind_rotation.expand(fitted.shape[0], -1, 3, 3)
        return skinning_transforms(rotations, positions, fitted), to_homogeneous(rotations, positions)

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
        offsets: Tensor | None = None,
    ) -> Posed:
        """Posed bodies; what is given is already checked.

        Args:
            identity: of batch 1 or B.
            relative: (B, J - 1, 3, 3), or local rotations of the rig's own axes when `absolute`.
            translation: Hips positions (B, 3) [m].
            bone_scale: factors (1 or B, J - 1) of the user joints' bone vectors; the skin is not refitted.
            offsets: (B, v, 3) added to the rest shape before skinning [m].
        """
        rotations, positions = self._walk(identity, relative, translation, bone_scale, absolute=absolute)
        transforms = self._skinning_transforms(identity, rotations, positions, bone_scale)
        return Posed(
            vertices=self._skin(_moved(identity.rest, offsets), transforms),
            joints=positions[:, 1:],
            transforms=to_homogeneous(rotations, positions),
        )

    def transforms(self, body: Body, *, absolute: bool) -> Tensor:
        """World transforms of the joints alone (B, J, 4, 4) [m], without the mesh."""
        return to_homogeneous(*self._walk(*body[:4], absolute=absolute))

    def pose_all(self, bodies: Iterable[Body], batch: int, *, absolute: bool) -> Posed:
        """Pose a stream of chunks; no derivative. Each is dropped after use.

        Args:
            bodies: chunks that add up to `batch` bodies, one identity a pose.
            batch: total number of bodies.
        """
        vertices, world, start = None, [], 0
        for identity, relative, translation, bone_scale, moves in bodies:
            if vertices is None:
                vertices = identity.rest.new_empty(batch, *identity.rest.shape[1:])
            rotations, positions = self._walk(identity, relative, translation, bone_scale, absolute=absolute)
            transforms = self._skinning_transforms(identity, rotations, positions, bone_scale)
            stop = start + len(relative)
            rest = _moved(identity.rest, moves)
            self.posed_skinning.into(vertices[start:stop], rest.permute(2, 1, 0), transforms)
            world.append(to_homogeneous(rotations, positions))
            start = stop
        joined = torch.cat(world)
        assert vertices is not None
        return Posed(vertices=vertices, joints=joined[:, 1:, :3, 3], transforms=joined)

    def _skinning_transforms(
        self,
        identity: Identity,
        rotations: Tensor,
        positions: Tensor,
        bone_scale: Tensor | None,  # noqa: ARG002 - moves the helpers of a rig that has any
    ) -> Tensor:
        """``G B^-1`` (B, T, 3, 4) of every joint that carries skin."""
        return skinning_transforms(rotations, positions, identity.bind_world)

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
        reference = transformed()
        if self.warp_skinning and not reference:
            return _skin_warp(self.posed_skinning, rest, transforms)
        if rest.shape[0] == 1 and not rest.requires_grad and not reference:
            return self.posed_skinning.shared(rest[0], transforms)
        return self.posed_skinning(rest.permute(2, 1, 0), transforms, rows=True)


class ProceduralAnimation(Animation):
    """The same, with the skin on the rig's procedural joints as well: what the full model poses with.

    Bodies are still brought to the bind pose by the public joints, where no twist acts.

    Args:
        rig: a rig with `procedural`.
    """

    def __init__(
        self, rig: Rig, *, dtype: torch.dtype, device: torch.device, kernels: Literal["auto", "torch", "warp"]
    ) -> None:
        super().__init__(rig, dtype=dtype, device=device, kernels=kernels)
        assert rig.procedural is not None
        self.twist = Twist(rig, dtype=dtype, device=device)
        self.posed_skinning = Skinning(rig.procedural.skin, dtype=dtype, device=device)

    def _skinning_transforms(
        self, identity: Identity, rotations: Tensor, positions: Tensor, bone_scale: Tensor | None
    ) -> Tensor:
        public = skinning_transforms(rotations, positions, identity.bind_world)
        helpers = self.twist(identity.bind_world, public[..., :3], positions, bone_scale)
        return torch.cat((public, helpers), 1)

    def helper_transforms(
        self, identity: Identity, transforms: Tensor, bone_scale: Tensor | None = None
    ) -> Tensor:
        """World transforms (B, H, 4, 4) [m] of the procedural joints of posed bodies.

        Args:
            identity: of batch 1 or B.
            transforms: (B, J, 4, 4) posed world transforms of the public joints [m].
            bone_scale: the scale that the bodies were posed with.
        """
        bind = identity.bind_world
        rotations, positions = transforms[..., :3, :3], transforms[..., :3, 3]
        return self.twist.world_transforms(bind, rotations @ bind[..., :3, :3].mT, positions, bone_scale)


def _moved(rest: Tensor, offsets: Tensor | None) -> Tensor:
    """Rest vertices with offsets added, where there are any."""
    return rest if offsets is None else rest + offsets


def _skin_warp(skinning: Skinning, rest: Tensor, transforms: Tensor) -> Tensor:
    from soma_core.kernels.skinning_wp import skin

    points = rest.expand(len(transforms), -1, 3).contiguous()
    return skin(points, transforms, skinning.weights.csr, skinning.weights.transpose)
