"""A native model small enough to differentiate by hand: a few joints, a cloud of vertices, blend shapes."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from soma_core.layer import Kernels
from soma_core.native.model import NativeBody, NativeRig
from soma_core.native.poses import PoseFit
from soma_core.plugin.spec import SkinnedModel

__all__ = ["PARENTS", "make_fit", "make_model", "make_rig", "random_pose"]

Blend = Literal["none", "zero", "linear", "curved"]
"""What a pose adds to the rest mesh: nothing, zeros, or functions of the rotations' entries."""

PARENTS = (-1, 0, 1, 2, 0, 4)
_AROUND = 40
_KIND = {"dtype": torch.float64, "device": torch.device("cpu")}


def make_model(*, blend: Blend = "linear", betas: Tensor | None = None) -> SkinnedModel:
    """Two chains with clouds of vertices about their bones; `betas` (2,) or (batch, 2) lengthen and widen."""
    random = torch.Generator().manual_seed(3)
    joints = torch.tensor(
        [[0, 0, 0], [0, 0.3, 0], [0, 0.6, 0], [0, 0.8, 0.1], [0.2, -0.1, 0], [0.2, -0.5, 0.0]]
    ).double()
    count = len(PARENTS)
    middle = joints + 0.1 * torch.randn(count, 3, generator=random, **_KIND)
    cloud = 0.12 * torch.randn(count, _AROUND, 3, generator=random, **_KIND)
    rest = (middle[:, None] + cloud).flatten(0, 1)
    weights = torch.zeros(len(rest), count, **_KIND)
    owner = torch.arange(count).repeat_interleave(_AROUND)
    weights[torch.arange(len(rest)), owner] = 1
    share = 0.5 * torch.rand(len(rest), generator=random, **_KIND)
    above = torch.tensor(PARENTS).clamp_min(0)[owner]
    weights[torch.arange(len(rest)), owner] -= share
    weights[torch.arange(len(rest)), above] += share
    shapes = 0.01 * torch.randn(9 * count, len(rest), 3, generator=random, **_KIND)
    shapes *= blend != "zero"
    shapes[:9] = 0  # turning the whole body changes no shape

    def offsets(rotations: Tensor) -> Tensor:
        change = rotations - torch.eye(3, **_KIND)
        if blend == "curved":
            change = change + 0.3 * change @ change
        return torch.einsum("bm,mvc->bvc", change.flatten(1), shapes)

    scale = torch.ones(1, 3, **_KIND)
    if betas is not None:
        across, along = betas.reshape(-1, 2).unbind(1)
        scale = torch.stack((1 + 0.1 * across, 1 + 0.1 * along, 1 + 0.1 * across), 1)
    return SkinnedModel(
        joint_names=tuple("abcdef"), parents=PARENTS, rest=rest * scale[:, None],
        joints=joints * scale[:, None], weights=weights, pose_offsets=None if blend == "none" else offsets,
    )  # fmt: skip


def make_rig(model: SkinnedModel, *, covered: Tensor | None = None, kernels: Kernels = "torch") -> NativeRig:
    """Its rig in metres."""
    chosen = torch.ones(model.rest.shape[1], dtype=torch.bool) if covered is None else covered
    return NativeRig(model, 1.0, chosen.numpy(), kernels=kernels, **_KIND)


def make_fit(rig: NativeRig, model: SkinnedModel, *, iterations: int = 30) -> PoseFit:
    """The pose fit of its first body."""
    identity = rig.bodies(model.rest[:1], model.joints[:1])
    body = NativeBody(params={}, identity=identity, pelvis=model.joints[0, 0])
    weights = torch.ones(model.rest.shape[1], **_KIND)
    return PoseFit(rig, body, weights, iterations=iterations, tolerance=1e-9)


def random_pose(count: int, *, amount: float = 0.4) -> tuple[Tensor, Tensor]:
    """Axis-angle (count, J, 3) and places of the root joint (count, 3)."""
    random = torch.Generator().manual_seed(5)
    turns = amount * torch.randn(count, len(PARENTS), 3, generator=random, **_KIND)
    return turns, torch.randn(count, 3, generator=random, **_KIND)
