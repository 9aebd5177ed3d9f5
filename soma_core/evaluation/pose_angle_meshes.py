"""Bodies and poses that the angles of pose inversion are measured on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion.priors import HINGES
from soma_core.layer import Identity, SomaLayer
from soma_core.rig.skeleton import Rig

__all__ = [
    "ANNY_BODIES", "BODIES", "LIMITS", "TestBody", "drifting_hips", "named_poses", "rotation_matrices",
    "smooth_poses", "strong_poses",
]  # fmt: skip

LIMITS = (1.6, 2.6, 3.1)
"""Rotation vectors of strong poses are cut to these angles [rad], a third of the frames each."""

_FACTOR = (2.0, 3.0)
"""Strong poses turn this many times as far as those of `random_poses`."""

_BENT, _CURL, _THUMB = 140.0, 80.0, 35.0
"""Degrees: of elbows and knees at most; of each finger joint and of each thumb joint in a fist."""

_HIPS, _STEP = (0.1, 0.95, 0.0), 0.01


@dataclass(frozen=True, kw_only=True)
class TestBody:
    """An identity: its name in tables, backend and parameters."""

    __test__ = False

    name: str
    backend: str
    params: Mapping[str, Any]

    def identity(self, layer: SomaLayer) -> Identity:
        """It in a layer of its backend; a shape space with fewer components takes the leading ones."""
        widths = {each.name: each.shape[0] for each in layer.spec.params if each.shape}
        cut = {
            name: value[: widths[name]] if name in widths else value for name, value in self.params.items()
        }
        return layer.identity(cut)


ANNY_BODIES: dict[str, dict[str, float]] = {
    "infant": {"gender": 0.5, "age": -0.25},
    "child": {"gender": 0.6, "age": 0.3},
    "tall woman": {"gender": 1.0, "age": 0.67, "height": 0.95, "weight": 0.4},
    "muscular man": {"gender": 0.0, "age": 0.67, "muscle": 0.9, "weight": 0.55},
    "old heavy man": {"gender": 0.0, "age": 0.95, "weight": 0.95, "muscle": 0.4},
}
"""Phenotypes of Anny from infant to old, 0 is male; what is not named keeps its default."""

BODIES = (
    TestBody(
        name="soma, random shape", backend="soma",
        params={"shape": np.random.default_rng(5).standard_normal(16).tolist()},
    ),
    *(
        TestBody(name=f"anny, {who}", backend="anny", params=ANNY_BODIES[who])
        for who in ("old heavy man", "tall woman", "infant")
    ),
)  # fmt: skip
"""Identities that the layer under test poses itself."""


def rotation_matrices(vectors: np.ndarray, layer: SomaLayer) -> Tensor:
    """Rotation matrices (F, J, 3, 3) of rotation vectors (F, J, 3) [rad]."""
    return axis_angle_to_matrix(torch.as_tensor(vectors)).to(layer.device, layer.dtype)


def drifting_hips(count: int, random: np.random.Generator, layer: SomaLayer) -> Tensor:
    """Positions of the Hips (F, 3) [m] that wander from frame to frame."""
    drift = np.cumsum(_STEP * random.standard_normal((count, 3)), axis=0) + _HIPS
    return torch.as_tensor(drift).to(layer.device, layer.dtype)


def smooth_poses(layer: SomaLayer, count: int, random: np.random.Generator) -> np.ndarray:
    """Rotation vectors (F, J, 3) [rad] of a smooth random motion."""
    return smooth_axis_angles(joint_spread(layer.joint_names), count, random)


def strong_poses(layer: SomaLayer, count: int, limit: float, random: np.random.Generator) -> np.ndarray:
    """Rotation vectors (F, J, 3) [rad] of strong poses, each drawn on its own.

    A frame draws one factor f, uniform in [2, 3]. Every component of every joint's vector is normal with
    standard deviation f times the joint's spread in ``random_poses.joint_spread`` (0.6 rad for arms and
    forearms, 0.5 for hips, thighs and shins, 0.35 for hands, 0.25 for fingers, feet and the head, 0.15 for
    spine, shoulders and toes, 0.12 for the neck, 0.08 for the jaw). Vectors beyond `limit` are cut to it.
    """
    names = layer.joint_names
    factor = random.uniform(*_FACTOR, (count, 1, 1))
    vectors = factor * joint_spread(names)[:, None] * random.standard_normal((count, len(names), 3))
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors * np.minimum(1.0, limit / np.maximum(length, 1e-12))


def named_poses(layer: SomaLayer, count: int, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Name -> rotation vectors (frames, J, 3) [rad]: single poses, and motions of `count` frames."""
    maker = _PoseMaker(layer.rig)
    motion = smooth_poses(layer, count, random)
    resting = smooth_poses(layer, 1, random)
    resting[:, maker.number("Hips")] = (0.0, 0.0, np.pi)
    return {
        "T-pose": maker.still({}),
        "left hand turned by 90 degrees": maker.about_bone("LeftHand", "LeftForeArm", 90),
        "left hand turned by 180 degrees": maker.about_bone("LeftHand", "LeftForeArm", 180),
        "right hand turned by 90 degrees": maker.about_bone("RightHand", "RightForeArm", 90),
        "right hand turned by 180 degrees": maker.about_bone("RightHand", "RightForeArm", 180),
        "left foot turned by 150 degrees": maker.about_bone("LeftFoot", "LeftShin", 150),
        "arms straight down": maker.still({"LeftArm": (0, 0, -90), "RightArm": (0, 0, 90)}),
        "upside down": resting,
        "curled fists": maker.still(_fists(layer.joint_names)),
        "elbows and knees as hinges": maker.hinges(count),
        "smooth random motion": motion,
    }


class _PoseMaker:
    """Poses of a rig by the names of its joints."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.names = rig, list(rig.user_joint_names)

    def number(self, name: str) -> int:
        return self.names.index(name)

    def still(self, degrees: Mapping[str, tuple[float, float, float]]) -> np.ndarray:
        """One frame, from rotation vectors in degrees."""
        vectors = np.zeros((1, len(self.names), 3))
        for name, vector in degrees.items():
            vectors[0, self.number(name)] = np.radians(vector)
        return vectors

    def about_bone(self, joint: str, bone: str, degrees: float) -> np.ndarray:
        """One frame: a joint turned about the bone that leads to it."""
        place = {name: self.rig.t_pose_world[self.number(name) + 1, :3, 3] for name in (joint, bone)}
        axis = place[joint] - place[bone]
        return self.still({joint: tuple(degrees * axis / np.linalg.norm(axis))})

    def hinges(self, count: int) -> np.ndarray:
        """Elbows forward and knees backward, from straight to bent and back."""
        angle = np.radians(_BENT) / 2 * (1 - np.cos(2 * np.pi * np.arange(count) / count))
        vectors = np.zeros((count, len(self.names), 3))
        for name, axis in HINGES.items():
            sign = -1.0 if name == "LeftForeArm" else 1.0
            vectors[:, self.number(name)] = sign * angle[:, None] * np.array(axis)
        return vectors


def _fists(names: tuple[str, ...]) -> dict[str, tuple[float, float, float]]:
    """Fingers curled about the axis across the palm; palms look down in the T-pose."""
    found: dict[str, tuple[float, float, float]] = {}
    for name in names:
        side = -1.0 if name.startswith("Left") else 1.0
        if "HandThumb" in name and name[-1] in "23":
            found[name] = (0.0, side * _THUMB, 0.0)
        elif "Hand" in name and "Thumb" not in name and name[-1] in "234":
            found[name] = (0.0, 0.0, side * _CURL)
    return found
