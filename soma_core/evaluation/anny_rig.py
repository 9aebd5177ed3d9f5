"""Motions of Anny's own rig of 104 bones: vertices, and how far its bones truly turned."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.evaluation.anny_package import anny_package_model
from soma_core.evaluation.random_poses import smooth_axis_angles
from soma_core.geometry.rotations import axis_angle_to_matrix

__all__ = ["BONES_OF", "HINGE_BONES", "AnnyClip", "hinge_clip", "smooth_clip"]

_BONE_SPREAD = (
    (r"root", 0.4),
    (r"toe.*|metacarpal.*", 0.06),
    (r"finger.*", 0.3),
    (r"wrist.*", 0.4),
    (r"upperarm.*", 0.52),
    (r"lowerarm.*|lowerleg.*", 0.4),
    (r"shoulder.*|clavicle.*|spine.*|neck.*", 0.14),
    (r"upperleg.*", 0.46),
    (r"foot.*", 0.29),
    (r"head", 0.23),
    (r"eye.*", 0.12),
)
"""Bones of Anny's rig -> how far they turn [rad]; bones not listed stay at rest."""

_STEP = 0.01
"""Standard deviation of the body's drift from frame to frame [m]."""

_TRUNK = {
    "Hips": ("root",),
    "Spine1": ("spine05", "spine04"),
    "Spine2": ("spine04", "spine03"),
    "Chest": ("spine02", "spine01"),
    "Neck1": ("neck01", "neck02"),
    "Neck2": ("neck02", "neck03"),
    "Head": ("head",),
}
_LIMBS = {
    "Shoulder": ("clavicle", "shoulder01"),
    "Arm": ("upperarm01", "upperarm02"),
    "ForeArm": ("lowerarm01", "lowerarm02"),
    "Hand": ("wrist",),
    "Leg": ("upperleg01", "upperleg02"),
    "Shin": ("lowerleg01", "lowerleg02"),
    "Foot": ("foot",),
    "ToeBase": tuple(f"toe{number}-1" for number in range(1, 6)),
}
BONES_OF: Mapping[str, tuple[str, ...]] = _TRUNK | {
    f"{side}{limb}": tuple(f"{bone}.{side[0]}" for bone in bones)
    for side in ("Left", "Right")
    for limb, bones in _LIMBS.items()
}
"""Body joint -> the bones of Anny that carry the same skin."""

HINGE_BONES: Mapping[str, tuple[str, str]] = {
    "LeftForeArm": ("lowerarm01.L", "LeftArm"),
    "RightForeArm": ("lowerarm01.R", "RightArm"),
    "LeftShin": ("lowerleg01.L", "LeftLeg"),
    "RightShin": ("lowerleg01.R", "RightLeg"),
}
"""Elbow or knee -> the bone that turns there, and the parent joint."""

_STIFF = re.compile(r"(upper|lower)(arm|leg)02.*|lower(arm|leg)01.*")
"""Bones that stay in line while elbows and knees are pure hinges."""

_BENT = 110.0
"""Degrees that a hinge turns at most beyond Anny's rest pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AnnyClip:
    """Frames posed by the anny package.

    Attributes:
        vertices: (F, n, 3) [m], +Z up.
        bones: (F, B, 3, 3) global rotations of the bones.
        names: of the bones.
        bent: (F,) angle of elbows and knees beyond the rest pose [rad]; empty where they are no hinges.
    """

    vertices: Tensor
    bones: Tensor
    names: tuple[str, ...]
    bent: np.ndarray


def smooth_clip(params: Mapping[str, float], count: int, random: np.random.Generator) -> AnnyClip:
    """All bones in smooth random motion.

    Raises:
        InputError: the anny package is not installed.
    """
    model = anny_package_model(rig="anny", topology="anny", dtype=torch.float32)
    turns = smooth_axis_angles(bone_spread(model.bone_labels), count, random)
    drift = np.cumsum(_STEP * random.standard_normal((count, 3)), axis=0)
    return _posed(model, params, turns, drift, np.empty(0))


def hinge_clip(
    params: Mapping[str, float],
    axes: Mapping[str, np.ndarray],
    count: int,
    random: np.random.Generator,
) -> AnnyClip:
    """Elbows and knees bend by up to 110 degrees and straighten; the rest sways, limbs without twist bones.

    Args:
        params: phenotypes.
        axes: joint of `HINGE_BONES` -> axis (3,) in Anny's world at rest, +Z up; its sign is that of bending.
        count: frames; the first one is at rest.
        random: source of the sway.

    Raises:
        InputError: the anny package is not installed.
    """
    model = anny_package_model(rig="anny", topology="anny", dtype=torch.float32)
    names = list(model.bone_labels)
    free = np.array([_STIFF.fullmatch(name) is None for name in names])
    turns = smooth_axis_angles(bone_spread(names) * free, count, random)
    bent = np.radians(_BENT) / 2 * (1 - np.cos(2 * np.pi * np.arange(count) / count))
    for joint, axis in axes.items():
        turns[:, names.index(HINGE_BONES[joint][0])] = bent[:, None] * axis
    drift = np.cumsum(_STEP * random.standard_normal((count, 3)), axis=0)
    return _posed(model, params, turns, drift, bent)


@torch.no_grad()
def _posed(
    model: Any, params: Mapping[str, float], turns: np.ndarray, drift: np.ndarray, bent: np.ndarray
) -> AnnyClip:
    """Pose Anny by rotation vectors (F, B, 3) [rad] of its bones, in world-aligned axes at rest."""
    count = len(turns)
    deltas = torch.eye(4).repeat(count, len(model.bone_labels), 1, 1)
    deltas[..., :3, :3] = axis_angle_to_matrix(torch.as_tensor(turns)).float()
    deltas[:, 0, :3, 3] = torch.as_tensor(drift).float()
    phenotypes = {name: torch.full((count,), value) for name, value in params.items()}
    out = model(pose_parameters=deltas, phenotype_kwargs=phenotypes)
    return AnnyClip(
        vertices=out["vertices"], bones=out["bone_poses"][..., :3, :3], names=tuple(model.bone_labels),
        bent=bent,
    )  # fmt: skip


def bone_spread(names: Sequence[str]) -> np.ndarray:
    """How far each bone turns [rad], (B,)."""
    found = [
        next((spread for pattern, spread in _BONE_SPREAD if re.fullmatch(pattern, name)), 0.0)
        for name in names
    ]
    return np.array(found)
