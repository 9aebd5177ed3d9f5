"""Identity and poses from posed meshes alone: how far the rest shape is from the truth, and what it costs."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from soma_core.evaluation.inversion_sequences import anny_native_vertices
from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
from soma_core.evaluation.report import Figure, Report, Table
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion
from soma_core.inversion.identity import IdentityFit, IdentityMethod, fit_identity
from soma_core.layer import SomaLayer
from soma_core.progress import progress
from soma_core.shape_space.sampling import sample_parameters
from soma_core.skeleton.identity import Identity

__all__ = ["run"]

_FRAMES = 20
"""Posed meshes of each body."""

_ADULT = (0.6, 1.0)
"""Anny's phenotype `age`, from young to old."""

_REST_MM, _POSE_RATIO = 3.0, 1.2
"""Promised on meshes of another rig: rest shape, and pose error over that with the identity known."""

_OWN_MM = 0.1
"""Bound where an exact solution exists."""

_COLUMNS = (
    "body", "fit", "rest shape, mean, mm", "P95, mm", "max, mm", "posed, mean, mm",
    "identity known, mm", "seconds",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class _Case:
    """Posed meshes of one body, (frames, v, 3) [m] on the canonical mesh, and how to recover it."""

    name: str
    vertices: Tensor
    truth: Identity
    posed_by: SomaLayer
    fitted_by: PoseInversion
    method: IdentityMethod = "backend"


def run(config: DictConfig) -> Report:
    """Recover `config.experiment.count` random adults of Anny's own rig, and bodies that our layer posed."""
    anny, native = (PoseInversion(SomaLayer(name, device=config.device)) for name in ("anny", "soma"))
    adults = [_measured(case) for case in _adults(anny, config.experiment.count, config.seed)]
    own = [_measured(case) for case in _own(anny, native, config.seed)]
    rest = max(row[2] for row in adults)
    ratio = max(row[5] / row[6] for row in adults)
    figures = [
        Figure(name="anny's own rig, rest shape, worst adult", value=rest, unit="mm", bound=_REST_MM),
        Figure(name="anny's own rig, posed, over identity known, worst", value=ratio, bound=_POSE_RATIO),
        *(Figure(name=f"{row[0]}, rest shape", value=row[2], unit="mm", bound=_OWN_MM) for row in own[:2]),
    ]
    return Report(
        title=f"Unknown identity: {_FRAMES} posed meshes of each body",
        tables=(
            Table(title="adults posed by anny's own rig and skinning", columns=_COLUMNS, rows=adults),
            Table(title="bodies posed by our layer", columns=_COLUMNS, rows=own),
        ),
        figures=figures,
        notes=(
            "Rest shapes are compared in the bind pose after rigid alignment, mouth and eye bags left out. "
            "Every fit begins at the backend's default body.",
        ),
    )


def _adults(inversion: PoseInversion, count: int, seed: int) -> Iterator[_Case]:
    """Random in every phenotype, but adult."""
    layer = inversion.layer
    random = np.random.default_rng([seed, 3])
    drawn = sample_parameters(layer.spec, count, random, skip_groups={"local_changes"})
    drawn["age"] = random.uniform(*_ADULT, count)
    for index in progress(range(count), label="adult", total=count):
        params = {name: float(values[index]) for name, values in drawn.items()}
        vertices = anny_native_vertices(params, _FRAMES, random)
        yield _Case(
            name=f"adult {index + 1}",
            vertices=inversion.canonical(vertices, "native"),
            truth=layer.identity(params),
            posed_by=layer,
            fitted_by=inversion,
        )


@torch.no_grad()
def _own(anny: PoseInversion, native: PoseInversion, seed: int) -> Iterator[_Case]:
    """Each backend on its own meshes, then each on those of the other, unposed."""
    random = np.random.default_rng([seed, 4])
    (count,) = native.layer.spec.params[0].shape
    shape = {"shape": random.standard_normal(count)}
    drawn = sample_parameters(anny.layer.spec, 1, random, skip_groups={"local_changes"})
    bodies = [(native, shape, anny), (anny, drawn | {"age": random.uniform(*_ADULT, 1)}, native)]
    posed = [(mine, other, *_posed(mine.layer, params, random)) for mine, params, other in bodies]
    for mine, _, truth, vertices in posed:
        yield _Case(
            name=mine.layer.backend, vertices=vertices, truth=truth, posed_by=mine.layer, fitted_by=mine
        )
    for mine, other, truth, vertices in posed:
        yield _Case(
            name=mine.layer.backend, vertices=vertices, truth=truth, posed_by=mine.layer, fitted_by=other,
            method="unpose",
        )  # fmt: skip


def _posed(layer: SomaLayer, params: dict[str, Any], random: np.random.Generator) -> tuple[Identity, Tensor]:
    turns = smooth_axis_angles(joint_spread(layer.joint_names), _FRAMES, random)
    identity = layer.identity(params)
    rotations = axis_angle_to_matrix(torch.as_tensor(turns)).to(identity.rest)
    return identity, layer.pose(identity, rotations).vertices


def _measured(case: _Case) -> Sequence[Any]:
    """A row of the table."""
    inversion = case.fitted_by
    taking_part = inversion.default_weights > 0
    known_by = inversion if case.posed_by is inversion.layer else PoseInversion(case.posed_by)
    known = known_by(case.vertices, case.truth)
    begin = time.perf_counter()
    found: IdentityFit = fit_identity(inversion.layer, case.vertices, method=case.method, inversion=inversion)
    seconds = time.perf_counter() - begin
    rest = _aligned_distance(found.identity.rest[0][taking_part], case.truth.rest[0][taking_part]) * 1e3
    fit = f"{inversion.layer.backend}, {case.method}"
    errors = [float(pose.vertex_error[:, taking_part].mean()) * 1e3 for pose in (found.pose, known)]
    figures = float(rest.mean()), float(rest.quantile(0.95)), float(rest.max())
    return case.name, fit, *figures, *errors, seconds


def _aligned_distance(points: Tensor, goal: Tensor) -> Tensor:
    """Distances (n,) of points (n, 3) from others, once turned and moved onto them."""
    points, goal = (one.double() - one.double().mean(0) for one in (points, goal))
    return (points @ rotation_from_covariance(goal.T @ points).T - goal).norm(dim=-1)
