"""Twist joints: what they save of a twisted limb, and what they must leave as it is."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from soma_core.evaluation.report import Figure, Report, ShownBody, Table
from soma_core.geometry.mesh import enclosed_volume
from soma_core.layer import SomaLayer
from soma_core.rig.procedural import fold_weights

__all__ = ["run"]

_TWIST_DEG = 150.0

_LIMBS = (
    ("forearm", "LeftHand", "LeftForeArm", "LeftHand"),
    ("thigh", "LeftLeg", "LeftLeg", "LeftShin"),
)
"""What is twisted: the turned joint, and the two ends of the segment it turns about."""

_MODELS = ("plain skinning", "twist joints")

_WRIST_M = 0.03
"""The wrist section reaches so far to either side of the joint [m]."""

_WRIST_LOSS = 1 / 3
"""Largest part of the volume that the wrist loses by plain skinning which may still be lost."""

_SAME = 1e-6
"""Metres or weights that count as none: float32 in the files."""

_CM3 = 1e6


def section_areas(
    vertices: np.ndarray, triangles: np.ndarray, origin: np.ndarray, normal: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """Areas [m2] of sections of a closed mesh by the planes across `normal`, `places` [m] from `origin`."""
    height = (vertices - origin) @ normal
    areas = []
    for place in places:
        above = (height > place)[triangles]
        cut = above.any(1) & ~above.all(1)
        corners, levels, side = vertices[triangles[cut]], height[triangles[cut]] - place, above[cut]
        ends = np.zeros((2, len(corners), 3))
        for a, b in itertools.pairwise((0, 1, 2, 0)):
            crosses = side[:, a] != side[:, b]
            drop = np.where(crosses, levels[:, a] - levels[:, b], 1.0)
            point = corners[:, a] + (levels[:, a] / drop)[:, None] * (corners[:, b] - corners[:, a])
            for end, chosen in enumerate((crosses & side[:, a], crosses & side[:, b])):
                ends[end, chosen] = point[chosen]
        areas.append(0.5 * abs((np.cross(ends[0] - origin, ends[1] - origin) @ normal).sum()))
    return np.array(areas)


def _twisted(layer: SomaLayer, turned: str, start: str, end: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Vertices in the T-pose, then with a joint turned about a segment by each model; the segment's ends."""
    names = layer.joint_names
    identity = layer.identity({})
    still = torch.zeros(1, len(names), 3, dtype=layer.dtype)
    rest = layer.pose(identity, still)
    ends = rest.joints[0, [names.index(start), names.index(end)]].numpy()
    bone = ends[1] - ends[0]
    twisted = still.clone()
    twisted[0, names.index(turned)] = torch.as_tensor(np.radians(_TWIST_DEG) * bone / np.linalg.norm(bone))
    poses = (rest, layer.pose_plain(identity, twisted), layer.pose(identity, twisted))
    return {key: pose.vertices[0].numpy() for key, pose in zip(("rest", *_MODELS), poses, strict=True)}, ends


def _bodies(layer: SomaLayer, name: str, vertices: dict[str, np.ndarray]) -> list[ShownBody]:
    """The twisted body by both models, coloured by how far they lie apart."""
    apart = 1e3 * np.linalg.norm(vertices[_MODELS[0]] - vertices[_MODELS[1]], axis=1)
    return [
        ShownBody(
            caption=f"{name} by {_TWIST_DEG:.0f} degrees\n{model}",
            vertices=vertices[model],
            triangles=layer.mesh.triangles,
            errors_mm=apart,
        )
        for model in _MODELS
    ]


def _forearm(layer: SomaLayer, vertices: dict[str, np.ndarray], ends: np.ndarray) -> list[Figure]:
    """Share of the volume around the wrist that each model loses, and of its area at the thinnest section."""
    length = float(np.linalg.norm(ends[1] - ends[0]))
    wrist, whole = np.linspace(-_WRIST_M, _WRIST_M, 25), np.linspace(-length, _WRIST_M, 60)
    areas = {
        key: [
            section_areas(points, layer.mesh.triangles, ends[1], (ends[1] - ends[0]) / length, places)
            for places in (wrist, whole)
        ]
        for key, points in vertices.items()
    }
    plain, helped = (100 * (1 - areas[model][0].sum() / areas["rest"][0].sum()) for model in _MODELS)
    thinnest = [100 * (1 - (areas[model][1] / areas["rest"][1]).min()) for model in _MODELS]
    return [
        *(
            Figure(name=f"area lost by the thinnest section of the forearm, {model}", value=value, unit="%")
            for model, value in zip(_MODELS, thinnest, strict=True)
        ),
        Figure(name=f"volume lost by the wrist, {_MODELS[0]}", value=plain, unit="%"),
        Figure(
            name=f"volume lost by the wrist, {_MODELS[1]}", value=helped, unit="%", bound=_WRIST_LOSS * plain
        ),
    ]


def _unchanged(layer: SomaLayer) -> list[Figure]:
    """Figures that hold by construction: weights, the bind pose."""
    rig, identity = layer.rig, layer.identity({})
    procedural = rig.procedural
    assert procedural is not None
    target = np.concatenate([np.arange(rig.joint_count), procedural.start_joints])
    folded = fold_weights(procedural.weights, target, rig.joint_count)
    world = identity.bind_world
    parents = rig.parents[1:].tolist()
    local: Tensor = world[:, parents, :3, :3].mT @ world[:, 1:, :3, :3]
    bound = layer.pose(identity, local, world[:, 1, :3, 3], absolute=True)
    moved = float((bound.vertices - identity.rest).abs().max())
    return [
        Figure(
            name="weights summed onto the public joints", value=abs(folded - rig.weights).max(), bound=_SAME
        ),
        Figure(name="skin moved in the bind pose", value=1e3 * moved, unit="mm", bound=1e3 * _SAME),
    ]


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Twist a forearm and a thigh of `config.experiment.backend` by 150 degrees, in float64."""
    layer = SomaLayer(config.experiment.backend, dtype=torch.float64, correctives=None)
    figures, bodies = [], []
    rows: list[list[str | float | None]] = []
    for name, *joints in _LIMBS:
        vertices, ends = _twisted(layer, *joints)
        volume = {key: enclosed_volume(points, layer.mesh.triangles) for key, points in vertices.items()}
        rows.append([name, *(_CM3 * (volume["rest"] - volume[model]) for model in _MODELS)])
        bodies += _bodies(layer, name, vertices)
        figures += _forearm(layer, vertices, ends) if name == "forearm" else []
    return Report(
        title=f"Twist joints on the default body of {layer.backend}",
        figures=[*figures, *_unchanged(layer)],
        tables=[
            Table(
                title=f"Volume that a body loses by a limb twisted by {_TWIST_DEG:.0f} degrees, cm3",
                columns=("limb", *_MODELS),
                rows=rows,
            )
        ],
        notes=[f"The wrist is {100 * _WRIST_M:.0f} cm to either side of the joint."],
        bodies=bodies,
    )
