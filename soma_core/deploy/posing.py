"""Repose, kinematics, twist, correctives and skinning in few operators; numbers of a matrix are outermost."""

from __future__ import annotations

import functools
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from soma_core.deploy.blocks import BlockSkinning
from soma_core.deploy.correctives import BatchedCorrectives
from soma_core.deploy.turns import AxisAngle, ShortTwist, product
from soma_core.geometry.constants import constant
from soma_core.layer import SomaLayer

__all__ = ["Bound", "ShortPosing"]


class Bound(NamedTuple):
    """A body in the bind pose.

    Attributes:
        rest: vertices (B, 3, v) [m].
        positions: of the joints (3, J, B) [m].
        offsets: from each joint's parent in T-pose world axes (3, J, B) [m].
        size: beside the canonical body, (B,).
    """

    rest: Tensor
    positions: Tensor
    offsets: Tensor
    size: Tensor


class ShortPosing(torch.nn.Module):
    """What a layer that reposes does with a rest shape and a pose; equal to rounding.

    Args:
        layer: after ``without_sparse``; see :meth:`serves`.
    """

    def __init__(self, layer: SomaLayer) -> None:
        super().__init__()
        keep = functools.partial(constant, dtype=layer.dtype, device=layer.device)
        kinematics, posing = layer.animation.kinematics, layer.posing
        bind, orient, above_orient, ancestors = (
            getattr(kinematics, name).double().cpu().numpy()
            for name in ("bind_rotation", "orient", "parent_orient", "ancestors")
        )
        parents = kinematics.tree.cpu().numpy().clip(0)
        limb = np.arange(len(parents)) > 1  # not the root, nor the Hips, which stand where they are told
        steps = np.eye(len(parents))
        steps[np.flatnonzero(limb), parents[limb]] -= 1

        def planes(matrices: np.ndarray) -> Tensor:
            return keep(matrices.transpose(1, 2, 0)[..., None])

        self.steps, self.ancestors, self.above = keep(steps), keep(ancestors), keep(parents)
        self.limb = keep(1.0 * limb[None])
        self.below_hips = keep(1.0 * (np.arange(len(parents)) > 0)[:, None])
        self.bind, self.orient = planes(bind), planes(orient)
        self.bind_above = planes(bind[parents] * limb[:, None, None])
        self.above_orient = planes(above_orient * limb[:, None, None])
        self.bind_to_orient = planes(orient @ bind.transpose(0, 2, 1))
        self.jumps = kinematics.jumps
        self.bottom = keep(np.diag([0.0, 0, 0, 1]))
        self.turn = AxisAngle(dtype=layer.dtype, device=layer.device)
        self.skinning = cast(BlockSkinning, layer.animation.skinning)
        self.posed_skinning = cast(BlockSkinning, posing.posed_skinning)
        self.twist: ShortTwist | None = getattr(posing, "twist", None)
        self.correctives = cast("BatchedCorrectives | None", layer.correctives)
        self.length = float(np.linalg.norm(steps @ layer.rig.bind_world[:, :3, 3], axis=1) @ limb)

    @staticmethod
    def serves(layer: SomaLayer) -> bool:
        """Whether a layer, after ``without_sparse``, is made of parts that are known here."""
        twist = getattr(layer.posing, "twist", None)
        known = isinstance(layer.animation.skinning, BlockSkinning)
        known &= twist is None or isinstance(twist, ShortTwist)
        return known and layer.repose and isinstance(layer.correctives, BatchedCorrectives | None)

    def bound(self, points: Tensor, fitted: Tensor) -> Bound:
        """Bring bodies to the bind pose; takes what ``Animation.repose`` does."""
        rotations, places = fitted[..., :3, :3].permute(2, 3, 1, 0), fitted[..., :3, 3].permute(2, 1, 0)
        away = (rotations.index_select(2, self.above) * (self.steps @ places)[:, None]).sum(0)
        positions = self.ancestors @ (self.bind_above * away).sum(1) + self.below_hips * places[:, 1:2]
        turn = (self.bind[:, None] * rotations[None]).sum(2)
        shift = positions - (turn * places).sum(1)
        moved = torch.cat((turn, shift[:, None]), 1)
        size = (self.limb @ away.norm(dim=0)).squeeze(0) / self.length
        rest = self.skinning.planes(points.permute(2, 0, 1), moved)
        return Bound(rest, positions, (self.above_orient * away).sum(1), size)

    def forward(self, body: Bound, rotations: Tensor, translation: Tensor) -> tuple[Tensor, ...]:
        """Vertices (B, v, 3), joints (B, J - 1, 3) and transforms (B, J, 4, 4) [m].

        Args:
            body: one, or B.
            rotations: rotation vectors (B, J - 1, 3) [rad].
            translation: Hips positions (B, 3) [m].
        """
        vectors = torch.nn.functional.pad(rotations, (0, 0, 1, 0)).permute(2, 1, 0)  # the root turns nothing
        relative = self.turn.exponential(vectors.flatten(1)).view(3, 3, *vectors.shape[1:])
        turns = relative
        for jump in self.jumps:
            turns = product(turns.index_select(2, jump), turns)
        steps = (turns.index_select(2, self.above) * body.offsets).sum(1)
        placed = self.ancestors @ steps + self.below_hips * translation.T[:, None]
        moved = product(turns, self.bind_to_orient)
        shift = placed - (moved * body.positions).sum(1)
        transforms = torch.cat((moved, shift[:, None]), 1)
        if self.twist is not None:
            helpers = self.twist.planes(self.bind, body.positions, moved, placed)
            transforms = torch.cat((transforms, helpers), 2)
        rest = body.rest
        if self.correctives is not None:
            rest = rest + self.correctives.planes(relative[:, :, 1:], body.size)
        vertices = self.posed_skinning.planes(rest, transforms).transpose(1, 2)
        top = torch.cat((product(turns, self.orient), placed[:, None]), 1).permute(3, 2, 0, 1)
        world = torch.nn.functional.pad(top, (0, 0, 0, 1)) + self.bottom
        return vertices, placed[:, 1:].permute(2, 1, 0), world
