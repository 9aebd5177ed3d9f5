"""The forward pose in two kernels, where no gradient is asked (paper, section 3.5)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.engine import Animation, ProceduralAnimation
from soma_core.animation.posed import Posed
from soma_core.animation.twist import Twist
from soma_core.correctives.model import Correctives
from soma_core.geometry.constants import constant
from soma_core.kernels._posing_text import BODY_INTS, BODY_REALS, JOINT_LIMIT
from soma_core.kernels.patches import Patches, side_by_side
from soma_core.skeleton.identity import Identity

if TYPE_CHECKING:
    from soma_core.kernels.body_skin_wp import Added, Blend

__all__ = ["FusedPose"]


class FusedPose(torch.nn.Module):
    """Poses bodies as ``ProceduralAnimation`` with ``Correctives`` does, without their derivative.

    Args:
        posing: joint tree, skin weights and twist joints.
        correctives: added on the way to the skin, or None.
        dtype, device: of constants and results.
        by_patches: skin as a GPU does, by patches of the mesh, instead of by bodies in SIMD lanes.

    Attributes:
        fits: whether the rig and the correctives fit into the kernels' shared memory.
    """

    def __init__(
        self,
        posing: Animation,
        correctives: Correctives | None,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
        by_patches: bool,
    ) -> None:
        super().__init__()
        twist = posing.twist if isinstance(posing, ProceduralAnimation) else None
        second = None if correctives is None else correctives.second.scipy()
        weights = posing.posed_skinning.weights.scipy()
        self.helper_count = 0 if twist is None else len(twist.start)
        ints, reals = _body_tables(posing, twist, correctives, raw=not by_patches)
        self.ints = constant(ints.astype(np.int32), device=device)
        self.reals = constant(reals, device=device, dtype=dtype)
        self.active_count = int(ints[3])
        self.patches: Patches | None = None
        self.skin: Blend | None = None
        channels = 0 if twist is None else len(twist.joint)
        self.fits = max(posing.kinematics.joint_count, channels) <= JOINT_LIMIT
        if by_patches:
            self.patches = Patches(weights, second, dtype=dtype, device=device)
            self.fits = self.fits and self.patches.fits
            return
        from soma_core.kernels.body_skin_wp import Added, blend_of

        self.skin = blend_of(weights, dtype=dtype)
        self.added: Added | None = None
        if correctives is not None and second is not None:
            first, moves = (
                blend_of(correctives.first.scipy(), dtype=dtype),
                blend_of(second, dtype=dtype, rows=3),
            )
            self.added = Added(first, moves, correctives.use_tanh)

    def forward(
        self,
        identity: Identity,
        rotations: Tensor,
        translation: Tensor,
        *,
        absolute: bool,
        bone_scale: Tensor | None = None,
        plain: Animation | None = None,
    ) -> Posed:
        """Posed bodies; what is given is already checked.

        Args:
            identity: of batch 1 or B.
            rotations: axis-angle [rad] (B, J - 1, 3) or matrices (B, J - 1, 3, 3); a batch of 1 or an
                expanded one is not copied.
            translation: Hips positions (B, 3) [m]; B is the batch that comes out.
            absolute: `rotations` are local rotations of the rig's own axes.
            bone_scale: (1 or B, J - 1).
            plain: skins by the public joints alone, and without correctives; None for all there is.
        """
        world, joints, skin, active = self._bodies(
            identity.bind_world, rotations, translation, absolute=absolute, bone_scale=bone_scale
        )
        blend, tables = self.skin, self.patches
        if plain is not None:
            skin, active, blend, tables = skin[:, : world.shape[1]], None, plain.blend, plain.patches
        if tables is None:
            from soma_core.kernels.body_skin_wp import skin_bodies

            assert blend is not None
            added = None if active is None else self.added
            vertices = skin_bodies(identity.rest, skin, blend, features=active, added=added)
        else:
            from soma_core.kernels.fused_pose_wp import skin_patches

            named = tables.ints, tables.shorts, tables.reals
            vertices = skin_patches(identity.rest, skin, active, *named, patches=tables.count)
        return Posed(vertices=vertices, joints=joints, transforms=world)

    def whole(
        self,
        bodies: Iterable[tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]],
        batch: int,
        animation: Animation | None,
        *,
        absolute: bool,
    ) -> Posed:
        """Pose chunks of bodies that nobody keeps: brought to the bind pose and posed in one pass.

        Args:
            bodies: of each chunk, fitted points as planes (3, v, B) [m] and transforms (B, J, 4, 4) [m];
                rotations, translation and bone scale, as in :meth:`forward`.
            batch: number of bodies in all.
            animation: brings bodies to the bind pose; None leaves them as they are.
            absolute: as in :meth:`forward`.
        """
        from soma_core.kernels.body_skin_wp import skin_bodies

        assert self.skin is not None
        vertices, found, start = None, [], 0
        for points, fitted, rotations, translation, bone_scale in bodies:
            if vertices is None:
                vertices = points.new_empty(batch, points.shape[1], 3)
            before, bind = (None, fitted) if animation is None else animation.to_bind_pose(fitted)
            if before is not None:  # one body for all poses
                before = before.expand(len(translation), -1, 3, 4)
            world, joints, skin, active = self._bodies(
                bind, rotations, translation, absolute=absolute, bone_scale=bone_scale
            )
            stop = start + len(world)
            skin_bodies(
                points.permute(2, 1, 0), skin, self.skin, before=before,
                first=None if animation is None else animation.blend, features=active, added=self.added,
                out=vertices[start:stop],
            )  # fmt: skip
            found.append((joints, world))
            start = stop
        assert vertices is not None
        joints, world = (torch.cat(parts) for parts in zip(*found, strict=True))
        return Posed(vertices=vertices, joints=joints, transforms=world)

    def _bodies(
        self,
        bind_world: Tensor,
        rotations: Tensor,
        translation: Tensor,
        *,
        absolute: bool,
        bone_scale: Tensor | None,
        skinned: bool = True,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """World transforms, joints, skinning transforms, and activations where there are any.

        Unless `skinned`, the last two are left out.
        """
        from soma_core.kernels.fused_pose_wp import pose_bodies

        world, joints, skin, active = pose_bodies(
            rotations, translation, bind_world, bone_scale, self.ints, self.reals,
            batch=len(translation), helpers=self.helper_count, activations=self.active_count,
            absolute=absolute, skinned=skinned,
        )  # fmt: skip
        return world, joints, skin, active if self.active_count else None


def _body_tables(
    posing: Animation, twist: Twist | None, correctives: Correctives | None, *, raw: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Constants of the first kernel: integers, behind a header that says where each begins; numbers."""
    kinematics = posing.kinematics
    tables = dict.fromkeys((*BODY_INTS, *BODY_REALS), np.zeros(0))
    sizes = kinematics.level_sizes
    tables |= {
        "order": _host(kinematics.order)[1:],
        "level_start": np.concatenate(([0], np.cumsum(sizes))),
        "parents": _host(kinematics.tree),
        "orient": _host(kinematics.orient),
        "parent_orient": _host(kinematics.parent_orient),
        "bone_length": np.ones(1),
    }
    channels = 0
    if twist is not None:
        channels = len(twist.joint)
        tables |= _twist_tables(twist)
    activations, squash = 0, 0
    if correctives is not None:
        activations, squash = correctives.first.shape[0], int(correctives.use_tanh)
        first = correctives.first.scipy()
        rows = np.concatenate((np.arange(activations), np.full(-activations % 32, -1)))
        start, ids, values = side_by_side(first.indptr.astype(np.int64), first.indices, first.data, rows)
        tables |= {
            "left": _host(correctives.features.left),
            "right": _host(correctives.features.right),
            "first_start": start,
            "first_id": ids,
            "first_value": values,
            "bone_length": np.array([correctives.length]),
        }
        if raw:
            activations, squash = 6 * kinematics.joint_count + 1, 2
    helpers = 0 if twist is None else len(twist.start)
    counts = (kinematics.joint_count, helpers, channels, activations, len(sizes), squash)
    header = len(counts) + len(BODY_INTS) + len(BODY_REALS)
    starts = [
        first + np.cumsum([0, *(tables[name].size for name in names)])[:-1]
        for names, first in ((BODY_INTS, header), (BODY_REALS, 0))
    ]
    ints = [np.array(counts), *starts, *(tables[name].ravel() for name in BODY_INTS)]
    return np.concatenate(ints).astype(np.int64), np.concatenate([tables[n].ravel() for n in BODY_REALS])


def _twist_tables(twist: Twist) -> dict[str, np.ndarray]:
    aligned, swing, euler = twist.counts
    tables = {
        name: _host(getattr(twist, name))
        for name in ("start", "end_user", "axis", "joint", "reference", "low", "high", "source_axis")
    }
    tables["mode"] = np.repeat([0, 1, 2], twist.counts)
    # Tables of Euler channels alone are as long as those of all.
    tables["euler_axis"] = np.concatenate((np.zeros(aligned + swing), _host(twist.euler_axis)))
    tables["euler_sign"] = np.concatenate((np.ones(aligned + swing), _host(twist.euler_sign)))
    assert len(tables["euler_axis"]) == aligned + swing + euler
    for name in ("place", "mix"):
        dense = _host(getattr(twist, name))
        row, column = np.nonzero(dense)
        counts = np.bincount(row, minlength=len(dense))
        tables[f"{name}_start"] = np.concatenate(([0], np.cumsum(counts)))
        tables[f"{name}_id"], tables[f"{name}_value"] = column, dense[row, column]
    return tables


def _host(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
