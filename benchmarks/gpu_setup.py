"""Layers and inputs that the sections of the device benchmark share; made when first asked for."""

from __future__ import annotations

import functools

import numpy as np
import torch
from inputs import PHENOTYPES, forward_inputs, own_motion
from torch import Tensor

from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
from soma_core.layer import SomaLayer
from soma_core.plugin.registry import default_registry
from soma_core.rig import load_canonical

__all__ = ["KINDS", "SEED", "backends", "far_mm", "inputs_of", "layer_of", "motion", "shape_of"]

SEED = 0
KINDS = {"plain": {"procedural": False, "correctives": None}, "default": {}}
"""Skinning by the 78 public joints alone, and the layer as it ships."""


def backends() -> list[str]:
    """Anny only where its data is there."""
    found = ["soma"]
    try:
        default_registry().spec("anny")
        found.append("anny")
    except Exception as error:
        print(f"no anny: {error}", flush=True)
    return found


@functools.lru_cache(maxsize=16)
def layer_of(
    backend: str, kind: str, device: str, dtype: torch.dtype = torch.float32, lod: str = "mid"
) -> SomaLayer:
    return SomaLayer(backend, lod=lod, device=device, dtype=dtype, **KINDS[kind])


def inputs_of(
    backend: str, batch: int, seed: int, device: str, dtype: torch.dtype = torch.float32
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Parameters, poses (batch, 77, 3) [rad] and translations (batch, 3) [m]: those that the peers get."""
    names = load_canonical("mid")[1].user_joint_names
    arrays = forward_inputs(names, batch, seed)
    poses, shift, shape, values = (
        torch.from_numpy(arrays[name]).to(device, dtype)
        for name in ("poses", "translation", "shape", "phenotypes")
    )
    if backend == "soma":
        return {"shape": shape}, poses, shift
    return {name: values[:, index].contiguous() for index, name in enumerate(PHENOTYPES)}, poses, shift


def shape_of(device: str, dtype: torch.dtype = torch.float32) -> Tensor:
    """The one body (1, 128) of the motions."""
    random = np.random.default_rng([SEED, 7])
    return torch.from_numpy(0.5 * random.standard_normal((1, 128))).to(device, dtype)


@functools.lru_cache(maxsize=4)
def motion(count: int) -> tuple[Tensor, Tensor]:
    """A smooth motion: rotation vectors (count, 77, 3) [rad] and translations (count, 3) [m].

    Long ones are several clips of 512 frames, so that they turn as fast as short ones.
    """
    if count <= 512:
        arrays = own_motion(count, SEED)
        return torch.from_numpy(arrays["poses"]), torch.from_numpy(arrays["translation"])
    spread = joint_spread(load_canonical("mid")[1].user_joint_names)
    seeds = [np.random.default_rng([SEED, 2, number]) for number in range(count // 512)]
    clips = [smooth_axis_angles(spread, 512, random) for random in seeds]
    drift = 0.01 * np.random.default_rng([SEED, 3]).standard_normal((count, 3)).cumsum(0)
    return (
        torch.from_numpy(np.concatenate(clips)).float(),
        torch.from_numpy(drift + np.array([0.1, 0.95, 0.0])).float(),
    )


def far_mm(found: Tensor, expected: Tensor) -> float:
    """Largest distance [mm] of two sets of points."""
    off = found.detach().cpu().double() - expected.detach().cpu().double()
    worst = 1e3 * float(off.norm(dim=-1).max())
    return worst if worst == worst else float("inf")
