"""Every ordered pair of backends: a body and its motion brought from one to the other, and back again."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from soma_core.errors import SomaError
from soma_core.evaluation.joint_turns import angles_between
from soma_core.evaluation.pose_angle_fits import visible_joints
from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
from soma_core.evaluation.report import Figure, Report, ShownBody, Table
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion
from soma_core.inversion.result import IdentityFit
from soma_core.layer import SomaLayer
from soma_core.native.identity import fit_identity
from soma_core.plugin.registry import default_registry
from soma_core.progress import progress
from soma_core.rig.mesh import Lod
from soma_core.shape_space.sampling import sample_parameters
from soma_core.skeleton.identity import Identity

__all__ = ["run"]

_FRAMES = 8
"""Posed meshes of each body."""

_LOD: Lod = "low"

_OWN_MM, _OWN_DEGREES = 0.1, 1.0
"""Bounds where an exact solution exists: a backend's body read back by the same backend."""

_COLUMNS = (
    "from", "to", "vertices, mean, mm", "max, mm", "joints, mean, degrees", "max", "back, mean, mm",
    "max, mm", "parameters back, of their range", "seconds to find the body", "frames/s, body known",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class _Body:
    """A body of a backend in a motion: vertices (frames, v, 3) [m] and rotations (frames, J, 3, 3)."""

    fit: PoseInversion
    identity: Identity
    rotations: Tensor
    vertices: Tensor

    @property
    def backend(self) -> str:
        return self.fit.layer.backend


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Bring `config.experiment.count` bodies of each backend to each, the others' and its own.

    `config.experiment.methods` names backends; by default all that are installed with their files. A body is
    posed by its backend's layer, found again in the parameters of the other, and that one's meshes in those
    of the first: two conversions, by meshes on the canonical mesh alone.

    Raises:
        SomaError: a backend that was named cannot be used.
    """
    fits, notes = _fits(config)
    rows: list[list[str | float | None]] = []
    figures: list[Figure] = []
    shown: list[ShownBody] = []
    pairs = [
        (index, source, goal) for index in range(config.experiment.count) for source in fits for goal in fits
    ]
    for index, source, goal in progress(pairs, label="pairs", total=len(pairs)):
        body = _posed(source, np.random.default_rng([config.seed, index]))
        there, seconds = _found(goal, body.vertices)
        missed = _distances(there.pose.vertex_error, goal)
        seen = visible_joints(source.layer)
        turns = angles_between(there.pose.rotations[:, seen], body.rotations[:, seen])
        back: IdentityFit | None = None
        if goal is not source:
            carried = goal.layer.pose(there.identity, there.pose.rotations, there.pose.translation)
            back, _ = _found(source, carried.vertices)
            shown.append(_shown(body, there, goal))
        own = there if back is None else back
        again = source.layer.pose(own.identity, own.pose.rotations, own.pose.translation).vertices
        returned = _distances((again - body.vertices).norm(dim=-1), source)
        rows.append([
            body.backend, goal.layer.backend, float(missed.mean()), float(missed.max()), float(turns.mean()),
            float(turns.max()), float(returned.mean()), float(returned.max()), _parameters(body, own),
            seconds, _FRAMES / _timed(goal, body.vertices, there.identity),
        ])  # fmt: skip
        figures += _figures(body.backend, rows[-1], bounded=goal is source)
    return Report(
        title=f"Conversion matrix: {_FRAMES} posed meshes of each body, {_LOD} level of detail",
        tables=(Table(title="from -> to, and back", columns=_COLUMNS, rows=rows),),
        figures=figures,
        bodies=shown,
        notes=(
            "Bodies and smooth motions are random; each layer is the shipped default. Joints are those that "
            "move at least 50 vertices. Another backend cannot describe every body of the first: its column "
            "of millimetres is what its shapes lack, that of degrees what the motion loses.",
            *notes,
        ),
    )  # fmt: skip


def _fits(config: DictConfig) -> tuple[list[PoseInversion], list[str]]:
    """The pose fits of all backends, and why some have none."""
    named = list(config.experiment.methods)
    fits, notes = [], []
    for name in named or default_registry().names():
        try:
            fits.append(PoseInversion(SomaLayer(name, lod=_LOD, device=config.device)))
        except SomaError as error:
            if named:
                raise
            notes.append(f"{name} was left out: {error}")
    return fits, notes


def _posed(fit: PoseInversion, random: np.random.Generator) -> _Body:
    layer = fit.layer
    params = sample_parameters(layer.spec, 1, random, skip_groups={"local_changes"})
    identity = layer.identity(params)
    turns = smooth_axis_angles(joint_spread(layer.joint_names), _FRAMES, random)
    rotations = axis_angle_to_matrix(torch.as_tensor(turns)).to(identity.rest)
    return _Body(
        fit=fit, identity=identity, rotations=rotations, vertices=layer.pose(identity, rotations).vertices
    )


def _found(fit: PoseInversion, vertices: Tensor) -> tuple[IdentityFit, float]:
    begin = time.perf_counter()
    found = fit_identity(fit.layer, vertices, inversion=fit)
    return found, time.perf_counter() - begin


def _timed(fit: PoseInversion, vertices: Tensor, identity: Identity) -> float:
    """Seconds of a fit of the poses alone."""
    begin = time.perf_counter()
    fit(vertices, identity)
    return time.perf_counter() - begin


def _distances(errors: Tensor, fit: PoseInversion) -> Tensor:
    """Those of vertices (frames, v) [m] that take part, in mm: mouth and eye bags do not."""
    return 1e3 * errors[:, torch.as_tensor(fit.default_weights) > 0]


def _parameters(body: _Body, found: IdentityFit) -> float:
    """Mean distance of the parameters that were found from the true ones, of their range."""
    ranges = {each.name: each.range[1] - each.range[0] for each in body.fit.layer.spec.params}
    gaps = [
        (found.params[name] - body.identity.params[name]).abs().flatten() / ranges[name]
        for name in found.params
        if name in body.identity.params
    ]
    return float(torch.cat(gaps).mean())


def _figures(backend: str, row: list[str | float | None], *, bounded: bool) -> Iterator[Figure]:
    """The same backend reads its own bodies back to what a float32 mesh tells."""
    if not bounded:
        return
    for name, value, unit, bound in (
        ("vertices, mean", row[2], "mm", _OWN_MM),
        ("joints, mean", row[4], "degrees", _OWN_DEGREES),
    ):
        yield Figure(name=f"{backend}, its own body, {name}", value=float(value or 0), unit=unit, bound=bound)


def _shown(body: _Body, found: IdentityFit, goal: PoseInversion) -> ShownBody:
    """The first frame of what was carried over, and how far it is off."""
    layer = goal.layer
    pose = layer.pose(found.identity, found.pose.rotations[:1], found.pose.translation[:1])
    errors = 1e3 * found.pose.vertex_error[0]
    errors[torch.as_tensor(goal.default_weights) == 0] = np.nan
    return ShownBody(
        caption=f"{body.backend} as {layer.backend}", vertices=pose.vertices[0].cpu().numpy(),
        triangles=layer.mesh.triangles, errors_mm=errors.cpu().numpy(),
    )  # fmt: skip
