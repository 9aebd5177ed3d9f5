"""Real frames of SAM 3D Body on the canonical rig: the wrap registered, the body unknown, and its pose."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from soma_core.errors import AssetError, InputError
from soma_core.evaluation.report import Figure, Report, ShownBody, Table
from soma_core.evaluation.shipped_layers import LAYERS, layer_label
from soma_core.files import refuse_unreadable
from soma_core.inversion import PoseInversion
from soma_core.inversion.report import InversionReport
from soma_core.inversion.result import IdentityFit, InversionResult
from soma_core.io.sam3d import read_sam3d
from soma_core.layer import SomaLayer
from soma_core.native.identity import fit_identity
from soma_core.paths import expanded
from soma_core.plugin.spec import BackendSpec
from soma_core.progress import progress
from soma_core.registration.native_mesh import read_native_mesh
from soma_core.registration.quality import measure
from soma_core.registration.register import FILLED, register
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh, Lod
from soma_core.topology.correspondence import Correspondence, build_correspondence
from soma_core.topology.transfer import make_transfer

__all__ = ["NEUTRAL", "Wrap", "make_wrap", "run"]

NEUTRAL = "mhr/mhr_neutral_lod1.ply"
"""The neutral body of MHR, in the folder of the data; beside it the frames."""

_FRAMES = "sam3d_*.npz"
_VARIABLE = "SOMA_TEST_DATA"
_LOD: Lod = "mid"

_WRAP_MM, _ERROR_MM, _PARAMETRIC_MM = 0.3, 1.0, 7.0
"""Promised: distance of the wrap from the surface, error of the fitted poses, and that before unposing."""

_REGIONS = ("all", "body", "hands", "feet", "head")
_COLUMNS = (
    "region", "layer", "mean, mm", "median, mm", "P95, mm", "max, mm", "before unposing, mean, mm",
    "converged, %", "seconds", "frames/s of the pose",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Wrap:
    """The canonical mesh on MHR.

    Attributes:
        correspondence: of the mid LOD.
        distance_mm: mean distance of the wrap from the surface.
        flipped_percent: share of its triangles that face the wrong way.
        seconds: how long it took.
    """

    correspondence: Correspondence
    distance_mm: float
    flipped_percent: float
    seconds: float


@dataclass(frozen=True, kw_only=True, eq=False)
class _Person:
    """One file, fitted: the target (frames, v, 3) [m], the fit, and that of the parametric body alone."""

    name: str
    vertices: Tensor
    found: IdentityFit
    parametric: InversionResult
    seconds: float
    pose_seconds: float


def run(config: DictConfig) -> Report:
    """Wrap the neutral body of MHR, then find body and pose of each person of SAM 3D Body, on both layers.

    Raises:
        InputError: no folder with the data is named.
        AssetError: a file is missing in it.
    """
    neutral, files = _find(config.experiment.data)
    wrap = make_wrap(neutral)
    figures = [
        Figure(name="wrap of MHR to its surface, mean", value=wrap.distance_mm, unit="mm", bound=_WRAP_MM),
        Figure(name="wrap of MHR, flipped triangles", value=wrap.flipped_percent, unit="%"),
        Figure(name="wrap of MHR, time", value=wrap.seconds, unit="s"),
    ]
    rows: dict[str, list[Sequence[str | float | None]]] = {file.stem: [] for file in files}
    bodies: list[ShownBody] = []
    for label, make in LAYERS.items():
        inversion = PoseInversion(make(config.experiment.backend, lod=_LOD, device=config.device))
        transfer = _transfer(wrap.correspondence, inversion.layer)
        for file in progress(files, label=f"person, {label}", total=len(files)):
            person = _fit(file, transfer, inversion)
            found = _rows(person, inversion.layer)
            rows[person.name] += found
            figures += _figures(label, person, found)
            bodies += _shown(person, inversion.layer) if label == next(iter(LAYERS)) else []
    return Report(
        title="Real frames of SAM 3D Body: wrap by soma wrap, unknown body, pose",
        figures=figures,
        tables=[
            Table(title=f"{name}: error of the fitted pose", columns=_COLUMNS, rows=some)
            for name, some in rows.items()
        ],
        bodies=bodies,
        notes=(
            "The default layer has twist joints and pose correctives, the plain one skins by the 78 public "
            "joints; bounds are those of the default. Errors against the transferred vertices, mouth and eye "
            "bags left out. The body is unposed from the frames of the person themselves: few frames leave "
            "it free to take up what skinning does not explain. Before unposing it is one of the shapes of "
            f"{config.experiment.backend}. True rotations are not known. In the picture, blue is the target.",
        ),
    )


def _figures(label: str, person: _Person, rows: Sequence[Sequence[str | float | None]]) -> list[Figure]:
    """Held to bounds on the shipped default alone."""
    of_region = {row[0]: row for row in rows}
    name, mean = f"{label}, {person.name}", float(of_region["all"][2] or 0)
    found = [
        Figure(name=f"{name}, mean", value=mean, unit="mm", bound=_ERROR_MM),
        Figure(
            name=f"{name}, before unposing, mean", value=float(of_region["all"][6] or 0), unit="mm",
            bound=_PARAMETRIC_MM,
        ),
        Figure(name=f"{name}, time", value=person.seconds, unit="s"),
    ]  # fmt: skip
    if "hands" in of_region:
        after, before = (float(of_region["hands"][column] or 0) for column in (2, 6))
        found.insert(
            2, Figure(name=f"{name}, hands, more than before it", value=after - before, unit="mm", bound=0.0)
        )
    if label == next(iter(LAYERS)):
        return found
    return [replace(figure, bound=None) for figure in found]


def _find(folder: str | None) -> tuple[Path, list[Path]]:
    """The neutral mesh and the frames."""
    named = folder or os.environ.get(_VARIABLE)
    if not named:
        raise InputError(
            "experiment.data",
            got="none",
            expected=f"a folder with {NEUTRAL} and mhr/{_FRAMES}, of the MHR repository",
            fix=f"Pass experiment.data=FOLDER, or set {_VARIABLE}.",
        )
    neutral = expanded(named) / NEUTRAL
    refuse_unreadable(neutral, fix="Name a folder that holds it by experiment.data.")
    files = sorted(neutral.parent.glob(_FRAMES))
    if not files:
        raise AssetError(
            neutral.parent, cause=f"holds no {_FRAMES}", fix="Put the outputs of SAM 3D Body there."
        )
    return neutral, files


def make_wrap(neutral: Path) -> Wrap:
    """Lay the canonical mesh on the neutral body, as ``soma wrap`` does."""
    begin = time.perf_counter()
    native = read_native_mesh(neutral)
    vertices, triangles = native.vertices, native.triangles
    found = register(vertices, triangles)
    seconds = time.perf_counter() - begin
    quality = measure(found, load_canonical("mid")[0]).as_dict()
    return Wrap(
        correspondence=build_correspondence(vertices, triangles, found.wrap),
        distance_mm=quality["surface_distance_mm"]["mean"],
        flipped_percent=quality["flipped_percent"],
        seconds=seconds,
    )


def _transfer(correspondence: Correspondence, layer: SomaLayer) -> torch.nn.Module:
    """Vertices of MHR in metres to the layer's mesh; coordinates on the wrap know no unit."""
    spec = BackendSpec(
        name="mhr", unit="m", up="+y", forward="+z", params=(), wrap=None, fill_segments=FILLED
    )
    return make_transfer(spec, layer.mesh, correspondence, dtype=layer.dtype, device=layer.device)


@torch.no_grad()
def _fit(file: Path, transfer: torch.nn.Module, inversion: PoseInversion) -> _Person:
    layer = inversion.layer
    vertices = transfer(torch.as_tensor(read_sam3d(file).vertices).to(layer.device, layer.dtype))
    begin = time.perf_counter()
    found = fit_identity(layer, vertices, method="unpose", inversion=inversion)
    seconds = time.perf_counter() - begin
    begin = time.perf_counter()
    parametric = inversion(vertices, layer.identity(found.params))
    return _Person(
        name=file.stem, vertices=vertices, found=found, parametric=parametric, seconds=seconds,
        pose_seconds=time.perf_counter() - begin,
    )  # fmt: skip


def _rows(person: _Person, layer: SomaLayer) -> list[Sequence[str | float | None]]:
    """The region table of :class:`InversionReport`, and the means of the parametric body beside it."""
    found, parametric = (_errors(result, layer) for result in (person.found.pose, person.parametric))
    converged = 100 * float(person.found.pose.converged.double().mean())
    speed = len(person.vertices) / person.pose_seconds
    label = layer_label(layer)
    rows: list[Sequence[str | float | None]] = []
    for name in [region for region in _REGIONS if region in found]:
        whole = (converged, person.seconds, speed) if name == "all" else (None, None, None)
        rows.append((name, label, *found[name].values(), parametric[name]["mean"], *whole))
    return rows


def _errors(result: InversionResult, layer: SomaLayer) -> dict[str, dict[str, float | None]]:
    report = InversionReport(layer.mesh, layer.rig)
    report.add(result)
    return report.as_dict()["error_mm"]


@torch.no_grad()
def _shown(person: _Person, layer: SomaLayer) -> list[ShownBody]:
    """The first frame: the target, and the fit with its errors."""
    pose, mesh = person.found.pose, layer.mesh
    posed = layer.pose(person.found.identity, pose.rotations[:1], pose.translation[:1]).vertices
    errors = 1e3 * pose.vertex_error[0].cpu().double().numpy()
    mean = float(errors[_skin(mesh)].mean())
    errors = np.where(_skin(mesh), errors, np.nan)
    return [
        _body(f"{person.name}, target", person.vertices, mesh, np.full_like(errors, np.nan)),
        _body(f"fitted\nmean {mean:.3g} mm", posed, mesh, errors),
    ]


def _skin(mesh: CanonicalMesh) -> np.ndarray:
    """(v,) bool: all but the bags of mouth and eyes."""
    skin = np.ones(mesh.vertex_count, bool)
    skin[mesh.face_interior] = False
    return skin


def _body(caption: str, vertices: Tensor, mesh: CanonicalMesh, errors: np.ndarray) -> ShownBody:
    return ShownBody(
        caption=caption,
        vertices=vertices[0].cpu().double().numpy(),
        triangles=mesh.triangles,
        errors_mm=errors,
    )
