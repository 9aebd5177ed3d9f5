"""Paper, table 5: how much of people that no model has seen the linear shape space of each model holds."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from soma_core.backends.rest_shape import ComposedRestShape
from soma_core.errors import InputError, SomaError
from soma_core.evaluation.report import Figure, Report, ShownBody, Table
from soma_core.evaluation.sam3d_frames import NEUTRAL, make_wrap
from soma_core.inversion import PoseInversion
from soma_core.inversion.unposing import blended_turns, posed_turns
from soma_core.io.mesh_vertices import read_mesh_vertices
from soma_core.io.vertex_folder import MESH_SUFFIXES, natural
from soma_core.layer import SomaLayer
from soma_core.native.identity import fit_identity
from soma_core.paths import expanded
from soma_core.plugin.registry import default_registry
from soma_core.progress import progress
from soma_core.rig import load_canonical
from soma_core.rig.mesh import Lod
from soma_core.shape_space.sampling import HELD_OUT, IdentityStream
from soma_core.skeleton.identity import Identity
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.transfer import make_transfer

__all__ = ["LinearSpace", "run"]

_log = logging.getLogger(__name__)

_LOD: Lod = "mid"

_PEOPLE = "anny"
"""Backend of the people that are measured where no meshes are named."""

_SOMA_MM = 1.0
"""Promised of the shipped space on them: its own report of held-out bodies gives 0.6 mm."""

_ROUNDS, _RESTING, _STARTS = 12, 0.01, 2
"""A search ends after so many fits of the pose, or with one that lowers the error by less, relatively; it
begins with so many rounds in which poses are those of the bodies' own skeletons."""

_CHUNK = 8
"""Bodies fitted together."""

_DEPENDENT = 1e-9
"""Directions of a basis that add less than this, of the largest, are none of their own."""

_SMALLEST, _UNITS = 0.3, (0, 2, 3)
"""Largest extent [m] of the smallest body: others are less than ten times as long, so that the size tells the
unit, by the powers of ten in a metre."""

_COLUMNS = ("space", "bodies", "K", "mean, mm", "median, mm", "P95, mm", "max, mm", "worst body, mean, mm")


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Project bodies onto the linear space of each backend in `config.experiment.methods`, or of all.

    Bodies are the meshes of the folder `config.experiment.data`, or `config.experiment.count` people of Anny
    that the shipped space was not trained on, and the neutral body of MHR where SOMA_TEST_DATA has it.

    Raises:
        InputError: a mesh of no known topology, a backend that is named and not linear.
        SomaError: a backend that is named cannot be used.
    """
    folder = config.experiment.data
    bodies = _read(expanded(folder), config) if folder else _people(config)
    spaces, notes = _spaces(config)
    rows: list[list[str | float | None]] = []
    figures: list[Figure] = []
    shown: list[ShownBody] = []
    for space in spaces:
        for name, some in bodies.items():
            errors, fitted = space.project(some)
            rows.append([space.name, f"{len(some)} {name}", float(space.rank), *_summary(errors)])
            bound = _SOMA_MM if not folder and (space.name, name) == ("soma", f"{_PEOPLE} people") else None
            label = f"{space.name}, {name}, mean"
            figures.append(Figure(name=label, value=float(errors.mean()), unit="mm", bound=bound))
            shown.append(_shown(space, name, errors, fitted))
    return Report(
        title="Linear shape spaces on bodies that were not trained on (paper, table 5)",
        tables=(Table(title="distance of vertices, unposed", columns=_COLUMNS, rows=rows),),
        figures=figures,
        bodies=shown,
        notes=(
            "Each body is brought to the pose of the model's own rest shapes and projected on all K "
            "directions, by turns until neither changes much. All models are measured on the same vertices, "
            f"those of the canonical mesh at its {_LOD} level of detail without the bags of mouth and eyes; "
            "the paper measures each on its own mesh. Coefficients have no limits.",
            *notes,
        ),
    )  # fmt: skip


def _summary(errors: np.ndarray) -> list[float]:
    """Mean, median, P95 and maximum of distances (bodies, v) [mm], and the mean of the worst body."""
    quantiles = np.quantile(errors, (0.5, 0.95, 1.0)).tolist()
    return [float(errors.mean()), *quantiles, float(errors.mean(1).max())]


class LinearSpace:
    """What a linear backend can show: ``template + coefficients @ basis`` on canonical vertices.

    Normal offsets of the few vertices that lie off the native surface are those of the default body.

    Args:
        layer: in float64: bases may be nearly dependent.

    Raises:
        InputError: the backend is not linear in any coefficients.

    Attributes:
        rank: number of independent directions.
        kept: (v,) bool, vertices that are measured: all but the bags of mouth and eyes.
    """

    def __init__(self, layer: SomaLayer) -> None:
        shape = layer.rest_shape
        if not isinstance(shape, ComposedRestShape):
            raise InputError(
                "experiment.methods", got=f"{layer.backend}, whose bodies are not linear in any coefficients",
                expected="backends with linear_basis()", fix="Leave it out.",
            )  # fmt: skip
        self.layer, self.name, count = layer, layer.backend, layer.mesh.vertex_count
        self.kept = torch.ones(count, dtype=torch.bool, device=layer.device)
        self.kept[torch.as_tensor(layer.mesh.face_interior)] = False
        self._base = layer.identity()
        basis = shape.basis[: 3 * count].view(3, count, -1).transpose(0, 1).flatten(0, 1)
        default = basis @ shape.coefficients(self._base.params)[0]
        self._template = self._base.fitted_rest[0].flatten() - default
        standing = torch.eye(3).to(basis).repeat(count, 1)  # where a body stands is no shape
        moved = torch.cat([basis, standing], 1)
        self._rows = self.kept.repeat_interleave(3)
        directions, sizes, turn = torch.linalg.svd(moved[self._rows], full_matrices=False)
        independent = sizes > _DEPENDENT * sizes[0]
        self.rank = int(independent.sum()) - 3
        self._directions = directions[:, independent]
        self._hidden = moved[~self._rows] @ (turn[independent] / sizes[independent, None]).T
        self._fit = PoseInversion(layer, skinning="plain")

    def project(self, bodies: Tensor) -> tuple[np.ndarray, Tensor]:
        """Bring bodies to the pose of the space's own, and project them.

        Args:
            bodies: (b, v, 3) [m] in the bind pose.

        Returns:
            Distances (b, kept) [mm] between each body and its projection; the projections (b, v, 3) [m].
        """
        chunks = progress(bodies.to(self._template).split(_CHUNK), label=f"bodies in {self.name}",
                          total=-(-len(bodies) // _CHUNK))  # fmt: skip
        found = [self._projected(chunk) for chunk in chunks]
        return np.concatenate([errors for errors, _ in found]), torch.cat([shapes for _, shapes in found])

    def _projected(self, bodies: Tensor) -> tuple[np.ndarray, Tensor]:
        identity = self.layer.identity_from_rest(bodies)
        shapes = self._base.fitted_rest.expand(len(bodies), -1, 3)
        for _ in range(_STARTS):
            shapes = self._nearest(self._in_pose_of(identity, shapes))
        best, errors, best_shapes = np.inf, np.empty(0), shapes
        for _ in range(_ROUNDS):
            away = self._away(identity.rest, shapes)
            distances = 1e3 * away[:, self.kept].norm(dim=-1)
            mean = float(distances.mean())
            if mean < best:
                errors, best_shapes = distances.cpu().numpy(), shapes
            if mean > (1 - _RESTING) * best or mean < 1e-6:
                break
            best = mean
            shapes = self._nearest(shapes + away)
        return errors, best_shapes

    def _nearest(self, shapes: Tensor) -> Tensor:
        """The bodies of the space that are nearest to some, (b, v, 3) [m]."""
        coefficients = (shapes.flatten(1) - self._template)[:, self._rows] @ self._directions
        found = self._template.repeat(len(shapes), 1)
        found[:, self._rows] += coefficients @ self._directions.T
        found[:, ~self._rows] += coefficients @ self._hidden.T
        return found.view(shapes.shape)

    def _in_pose_of(self, identity: Identity, shapes: Tensor) -> Tensor:
        """Bodies posed as `shapes` (b, v, 3) [m] are, by the skeletons of both."""
        world = self.layer.rest_shape.fit(shapes)[..., :3, :3]
        parents = torch.as_tensor(self.layer.rig.parents[1:].astype(np.int64), device=world.device)
        local = world[:, parents].mT @ world[:, 1:]
        return self.layer.pose_plain(identity, local, absolute=True).vertices

    def _away(self, bodies: Tensor, shapes: Tensor) -> Tensor:
        """How far each vertex of the bodies, in their best pose, is from `shapes`, (b, v, 3) [m]."""
        identity = self.layer.identity_from_rest(shapes)
        pose = self._fit(bodies, identity)
        to_bind, _ = self.layer.animation.to_bind_pose(identity.fitted_world)
        turns = posed_turns(self.layer, identity, pose) @ blended_turns(self.layer, to_bind)
        gap = (bodies - pose.posed(self.layer, identity)).transpose(0, 1)
        return torch.linalg.solve(turns, gap[..., None]).squeeze(-1).transpose(0, 1)


def _spaces(config: DictConfig) -> tuple[Iterator[LinearSpace], list[str]]:
    """The spaces, made one after the other, and why some backends have none."""
    named, notes = list(config.experiment.methods), list[str]()

    def made() -> Iterator[LinearSpace]:
        for name in named or default_registry().names():
            try:
                yield LinearSpace(SomaLayer(
                    name, lod=_LOD, device=config.device, dtype=torch.float64, correctives=None,
                    options=_options(config, name),
                ))  # fmt: skip
            except SomaError as error:
                if named:
                    raise
                notes.append(f"{name} was left out: {error}")

    return made(), notes


def _people(config: DictConfig) -> dict[str, Tensor]:
    """People of Anny that ``soma train-shape`` keeps for its report, and MHR's neutral where it is."""
    layer = SomaLayer(_PEOPLE, lod=_LOD, device=config.device, options=_options(config, _PEOPLE))
    stream = IdentityStream({_PEOPLE: layer}, {_PEOPLE: 1.0}, seed=config.seed)
    shapes = torch.as_tensor(stream.shapes(HELD_OUT, 0, config.experiment.count)) / 100
    neutral = expanded(os.environ.get("SOMA_TEST_DATA") or ".") / NEUTRAL
    found = {f"{_PEOPLE} people": shapes}
    if neutral.is_file():
        wrap = make_wrap(neutral).correspondence.wrap_vertices
        vertices = torch.as_tensor(_in_metres(wrap, neutral)[load_canonical(_LOD)[0].mid_ids])
        found["neutral of MHR"] = _unposed([vertices], config)
    return found


def _options(config: DictConfig, name: str) -> dict[str, Any] | None:
    """Of a backend."""
    options: dict[str, Any] = OmegaConf.to_container(config.experiment.options, resolve=True)  # type: ignore[assignment]
    return options.get(name)


def _read(folder: Path, config: DictConfig) -> dict[str, Tensor]:
    """The meshes of a folder, unposed."""
    found = sorted(folder.iterdir(), key=natural) if folder.is_dir() else []
    files = [file for file in found if file.suffix.lower() in MESH_SUFFIXES]
    if not files:
        raise InputError(
            "experiment.data", got=f"{folder}, without a mesh", expected="a folder with .obj or .ply files",
            fix="Name the folder that holds them.",
        )  # fmt: skip
    transfers = _transfers()
    return {f"of {folder.name}": _unposed([_canonical(file, transfers) for file in files], config)}


def _transfers() -> dict[int, tuple[str, torch.nn.Module]]:
    """How meshes with some number of vertices become canonical, and whose they are."""
    mesh, registry = load_canonical(_LOD)[0], default_registry()
    mid = load_canonical("mid")[0]
    found: dict[int, tuple[str, torch.nn.Module]] = {}
    kind: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}
    for name in registry.names():
        try:
            spec, pair = replace(registry.spec(name), unit="m"), registry.wrap(name)
            correspondence = None if pair is None else load_correspondence(pair, mid)
            transfer = make_transfer(spec, mesh, correspondence, **kind)
        except SomaError as error:
            _log.info("meshes of %s are not read: %s", name, error)
            continue
        count = mid.vertex_count if correspondence is None else correspondence.native_count
        found.setdefault(count, (name, transfer))
    return found


def _canonical(file: Path, transfers: Mapping[int, tuple[str, torch.nn.Module]]) -> Tensor:
    """Canonical vertices (v, 3) [m] of a mesh."""
    vertices = read_mesh_vertices(file)
    if len(vertices) not in transfers:
        known = ", ".join(f"{count} ({name})" for count, (name, _) in sorted(transfers.items()))
        raise InputError(
            str(file), got=f"{len(vertices)} vertices", expected=f"those of a known topology: {known}",
            fix=f"Lay the canonical mesh on it, soma wrap native={file.name}, and put its wrap here instead.",
        )  # fmt: skip
    _, transfer = transfers[len(vertices)]
    canonical: Tensor = transfer(torch.as_tensor(_in_metres(vertices, file))[None])[0]
    return canonical


def _in_metres(vertices: np.ndarray, file: Path) -> np.ndarray:
    """Vertices in metres, by the size that people have: no mesh file tells its unit."""
    size = float(np.ptp(vertices, axis=0).max())
    steps = math.floor(math.log10(size / _SMALLEST)) if np.isfinite(size) and size > 0 else None
    if steps not in _UNITS:
        raise InputError(
            str(file), got=f"a body {size:g} long", expected="one in metres, centimetres or millimetres",
            fix="Export it in one of these units.",
        )  # fmt: skip
    return vertices / 10**steps


def _unposed(bodies: Sequence[Tensor], config: DictConfig) -> Tensor:
    """Bodies (b, v, 3) [m] in the bind pose, of canonical meshes (v, 3) [m] in any."""
    inversion = PoseInversion(SomaLayer("soma", lod=_LOD, device=config.device))
    layer = inversion.layer
    found = []
    for body in progress(bodies, label="unposing, body", total=len(bodies)):
        shown = body.to(layer.device, layer.dtype)[None]
        found.append(fit_identity(layer, shown, method="unpose", inversion=inversion).identity.rest)
    return torch.cat(found)


def _shown(space: LinearSpace, name: str, errors: np.ndarray, fitted: Tensor) -> ShownBody:
    """The projection of the first body, coloured by what it lacks."""
    vertices = fitted[0].cpu().numpy()
    vertices = vertices - [0.0, vertices[:, 1].min(), 0.0]  # bodies of any height, on one floor
    colours = np.full(len(space.kept), np.nan)
    colours[space.kept.cpu().numpy()] = errors[0]
    return ShownBody(
        caption=f"{space.name}, {name}\nmean {errors[0].mean():.3g} mm",
        vertices=vertices, triangles=space.layer.mesh.triangles, errors_mm=colours,
    )  # fmt: skip
