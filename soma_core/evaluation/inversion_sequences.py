"""Moving meshes whose pose is to be found: posed by our own layer, and by Anny's own rig and skinning."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from soma_core.evaluation.anny_package import anny_package_model
from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.io import read_motion
from soma_core.layer import SomaLayer
from soma_core.paths import assets_dir

__all__ = ["ANNY_IDENTITIES", "MovingMesh", "anny_meshes", "anny_native_vertices", "own_meshes"]

ANNY_IDENTITIES: dict[str, dict[str, float]] = {
    "man": {"gender": 0.8, "age": 0.65, "muscle": 0.6, "weight": 0.45, "height": 0.6, "proportions": 0.6},
    "woman": {"gender": 0.2, "age": 0.7, "muscle": 0.45, "weight": 0.6, "height": 0.4, "proportions": 0.5},
    "child": {"gender": 0.6, "age": 0.35, "muscle": 0.5, "weight": 0.4, "height": 0.5, "proportions": 0.4},
}
"""Phenotypes of the bodies that move; what is not named keeps its default."""

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

_HIPS = (0.1, 0.95, 0.0)
_STEP = 0.01
"""Standard deviation of the body's drift from frame to frame [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingMesh:
    """Frames of one identity.

    Attributes:
        name: what moves, and how.
        backend, params: the identity.
        vertices: (frames, n, 3), as `topology` says.
        topology: ``canonical`` (metres, +Y up, mid LOD) or ``native`` (the backend's own).
        rotations: (frames, J - 1, 3, 3) true rotations; None where another rig posed the body.
    """

    name: str
    backend: str
    params: Mapping[str, Any] = field(default_factory=dict)
    vertices: Tensor
    topology: Literal["canonical", "native"] = "canonical"
    rotations: Tensor | None = None


def plain_layer(name: str, *, device: torch.device | str = "cpu") -> SomaLayer:
    """A layer that skins by the 78 public joints alone, as the paper's inversion and its peers do."""
    return SomaLayer(name, procedural=False, correctives=None, device=device)


def full_model_meshes(count: int, seed: int) -> Iterator[MovingMesh]:
    """Meshes that the full model posed, with twist joints and correctives: two bodies in smooth motion."""
    return _smooth(SomaLayer("anny"), SomaLayer("soma"), count, seed)


def own_meshes(count: int, seed: int) -> Iterator[MovingMesh]:
    """Meshes that plain skinning posed, so that an exact solution exists: smooth and recorded motions.

    Motions are the project's own clip and those in the folder ``motions`` of SOMA_TEST_DATA, each cut to
    `count` frames spread over it.
    """
    anny, native = plain_layer("anny"), plain_layer("soma")
    yield from _smooth(anny, native, count, seed)
    for path in (assets_dir() / "motions/range_of_motion.npz", *_recorded()):
        motion = read_motion(path)
        kept = np.unique(np.linspace(0, motion.frame_count - 1, count).astype(int))
        rotations, hips = torch.as_tensor(motion.rotations[kept]), torch.as_tensor(motion.translation[kept])
        yield _posed(anny, ANNY_IDENTITIES["man"], rotations, hips, f"anny, {path.stem.replace('_', ' ')}")


def _smooth(anny: SomaLayer, native: SomaLayer, count: int, seed: int) -> Iterator[MovingMesh]:
    """A man of Anny and a random native body, each in a smooth random motion."""
    random = np.random.default_rng([seed, 1])
    shape = {"shape": random.standard_normal(16).tolist()}
    for layer, params in ((anny, ANNY_IDENTITIES["man"]), (native, shape)):
        turns = smooth_axis_angles(joint_spread(layer.joint_names), count, random)
        drift = np.cumsum(_STEP * random.standard_normal((count, 3)), axis=0) + _HIPS
        rotations = axis_angle_to_matrix(torch.as_tensor(turns)).float()
        name = f"{layer.backend}, smooth random motion"
        yield _posed(layer, params, rotations, torch.as_tensor(drift).float(), name)


def _recorded() -> Sequence[Path]:
    folder = os.environ.get("SOMA_TEST_DATA")
    return sorted(Path(folder, "motions").glob("kimodo_*.npz")) if folder else []


@torch.no_grad()
def _posed(
    layer: SomaLayer, params: Mapping[str, Any], rotations: Tensor, hips: Tensor, name: str
) -> MovingMesh:
    vertices = layer.pose(layer.identity(params), rotations, hips).vertices
    return MovingMesh(name=name, backend=layer.backend, params=params, vertices=vertices, rotations=rotations)


def anny_meshes(count: int, seed: int) -> Iterator[MovingMesh]:
    """Meshes that the anny package posed with its own 104 bones and skinning, as native vertices."""
    for index, who in enumerate(("woman", "child")):
        random = np.random.default_rng([seed, 2, index])
        vertices = anny_native_vertices(ANNY_IDENTITIES[who], count, random)
        yield MovingMesh(
            name=f"anny's own rig, {who}",
            backend="anny",
            params=ANNY_IDENTITIES[who],
            vertices=vertices,
            topology="native",
        )


@torch.no_grad()
def anny_native_vertices(params: Mapping[str, float], count: int, random: np.random.Generator) -> Tensor:
    """Posed vertices (count, n, 3) [m], +Z up, of a smooth motion of Anny's own rig.

    Raises:
        InputError: the anny package is not installed.
    """
    model = anny_package_model(rig="anny", topology="anny", dtype=torch.float32)
    turns = smooth_axis_angles(_bone_spread(model.bone_labels), count, random)
    deltas = torch.eye(4).repeat(count, len(model.bone_labels), 1, 1)
    deltas[..., :3, :3] = axis_angle_to_matrix(torch.as_tensor(turns)).float()
    drift = np.cumsum(_STEP * random.standard_normal((count, 3)), axis=0)
    deltas[:, 0, :3, 3] = torch.as_tensor(drift).float()
    phenotypes = {name: torch.full((count,), value) for name, value in params.items()}
    return model(pose_parameters=deltas, phenotype_kwargs=phenotypes)["vertices"]


def _bone_spread(names: Sequence[str]) -> np.ndarray:
    found = [
        next((spread for pattern, spread in _BONE_SPREAD if re.fullmatch(pattern, name)), 0.0)
        for name in names
    ]
    return np.array(found)
