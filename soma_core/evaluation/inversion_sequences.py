"""Moving meshes whose pose is to be found: posed by our own layer, and by Anny's own rig and skinning."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from soma_core.evaluation.anny_rig import smooth_clip
from soma_core.evaluation.joint_turns import bone_turns, own_turns
from soma_core.evaluation.pose_angle_fits import posed_vertices
from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
from soma_core.evaluation.shipped_layers import LayerMaker
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.io import read_motion
from soma_core.layer import SomaLayer
from soma_core.rig.manifest import shipped_file

__all__ = ["ANNY_IDENTITIES", "MovingMesh", "anny_meshes", "own_meshes"]

ANNY_IDENTITIES: dict[str, dict[str, float]] = {
    "man": {"gender": 0.8, "age": 0.65, "muscle": 0.6, "weight": 0.45, "height": 0.6, "proportions": 0.6},
    "woman": {"gender": 0.2, "age": 0.7, "muscle": 0.45, "weight": 0.6, "height": 0.4, "proportions": 0.5},
    "child": {"gender": 0.6, "age": 0.35, "muscle": 0.5, "weight": 0.4, "height": 0.5, "proportions": 0.4},
}
"""Phenotypes of the bodies that move; what is not named keeps its default."""

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
        turns: body joint -> how far it truly turns in the world between frames, (frames - 1,) [degrees]; of
            another rig, how far the bone does that carries the same skin. Empty where nothing is known.
    """

    name: str
    backend: str
    params: Mapping[str, Any] = field(default_factory=dict)
    vertices: Tensor
    topology: Literal["canonical", "native"] = "canonical"
    rotations: Tensor | None = None
    turns: Mapping[str, np.ndarray] = field(default_factory=dict)


def own_meshes(count: int, seed: int, make: LayerMaker) -> Iterator[MovingMesh]:
    """Meshes that a layer posed itself, so that an exact solution exists: smooth and recorded motions.

    Motions are the project's own clip and those in the folder ``motions`` of SOMA_TEST_DATA, each cut to
    `count` frames spread over it.
    """
    anny, native = make("anny"), make("soma")
    yield from _smooth(anny, native, count, seed)
    for path in (shipped_file("motions/range_of_motion.npz"), *_recorded()):
        motion = read_motion(path)
        kept = np.unique(np.linspace(0, motion.frame_count - 1, count).astype(int))
        rotations, hips = torch.as_tensor(motion.rotations[kept]), torch.as_tensor(motion.translation[kept])
        yield _posed(anny, ANNY_IDENTITIES["man"], rotations, hips, f"anny, {path.stem.replace('_', ' ')}")


def _smooth(anny: SomaLayer, native: SomaLayer, count: int, seed: int) -> Iterator[MovingMesh]:
    """A man of Anny and a random native body, each in a smooth random motion."""
    random = np.random.default_rng([seed, 1])
    shape = {"shape": random.standard_normal(16)[: native.spec.params[0].shape[0]].tolist()}
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
    return MovingMesh(
        name=name, backend=layer.backend, params=params, rotations=rotations,
        vertices=posed_vertices(layer, layer.identity(params), rotations, hips),
        turns=own_turns(layer, rotations),
    )  # fmt: skip


def anny_meshes(count: int, seed: int) -> Iterator[MovingMesh]:
    """Meshes that the anny package posed with its own 104 bones and skinning, as native vertices."""
    for index, who in enumerate(("woman", "child")):
        clip = smooth_clip(ANNY_IDENTITIES[who], count, np.random.default_rng([seed, 2, index]))
        yield MovingMesh(
            name=f"anny's own rig, {who}",
            backend="anny",
            params=ANNY_IDENTITIES[who],
            vertices=clip.vertices,
            topology="native",
            turns=bone_turns(clip),
        )
