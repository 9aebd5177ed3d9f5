"""Paper, table 1: distance between the transferred mesh and the native surface it came from."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from omegaconf import DictConfig

from soma_core.backends.parameters import batch_parameters
from soma_core.evaluation.report import Figure, Report, distance_figures
from soma_core.geometry.barycentric import closest_point_on_triangle
from soma_core.layer import SomaLayer
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import BackendSpec
from soma_core.progress import progress
from soma_core.rig.mesh import CanonicalMesh
from soma_core.shape_space.sampling import sample_parameters
from soma_core.topology.closest import ClosestFaces
from soma_core.topology.correspondence import Correspondence, load_correspondence
from soma_core.topology.frames import METRES, native_to_canonical

__all__ = ["run"]

_MEAN_MM = _P95_MM = 0.010
"""The paper's figures for Anny."""


def _measured_vertices(mesh: CanonicalMesh) -> np.ndarray:
    """Ids of the vertices the paper measures: all but bags and between the toes."""
    excluded = np.concatenate([mesh.face_interior, mesh.segments["between_toes"]])
    return np.setdiff1d(np.arange(mesh.vertex_count), excluded)


def _surface_distances(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    face = ClosestFaces(vertices, triangles).query(points)
    closest = closest_point_on_triangle(points, vertices[triangles[face]])
    return np.linalg.norm(points - closest, axis=1)


def _native_in_metres(spec: BackendSpec, vertices: np.ndarray) -> np.ndarray:
    return METRES[spec.unit] * vertices @ native_to_canonical(spec.up, spec.forward).T


def _identities(spec: BackendSpec, count: int, seed: int) -> Iterable[dict[str, torch.Tensor]]:
    groups = {parameter.group for parameter in spec.params if parameter.group}
    drawn = sample_parameters(spec, count, np.random.default_rng(seed), skip_groups=groups)
    for index in range(count):
        yield {name: torch.as_tensor(value[index : index + 1]).float() for name, value in drawn.items()}


def _transfer_distances(
    layer: SomaLayer, correspondence: Correspondence, count: int, seed: int
) -> np.ndarray:
    generator = default_registry().generator(layer.backend, device=layer.device, dtype=layer.dtype)
    measured = _measured_vertices(layer.mesh)
    found = []
    for params in progress(_identities(layer.spec, count, seed), label="identity", total=count):
        points = layer.identity(params).fitted_rest[0].double().numpy()[measured]
        native = generator.rest(batch_parameters(layer.spec, params, device=layer.device, dtype=layer.dtype))
        surface = _native_in_metres(layer.spec, native[0].double().numpy())
        found.append(_surface_distances(points, surface, correspondence.native_triangles))
    return np.stack(found)


def _canonical_difference(layer: SomaLayer, count: int, seed: int) -> float:
    """Largest distance [m] between a canonical backend's vertices and those the layer gives."""
    generator = default_registry().generator(layer.backend, device=layer.device, dtype=layer.dtype)
    worst = 0.0
    for params in _identities(layer.spec, count, seed):
        native = generator.rest(batch_parameters(layer.spec, params, device=layer.device, dtype=layer.dtype))
        frame = METRES[layer.spec.unit] * native_to_canonical(layer.spec.up, layer.spec.forward)
        expected = native @ torch.as_tensor(frame, dtype=layer.dtype).T
        worst = max(worst, float((layer.identity(params).fitted_rest - expected).abs().max()))
    return worst


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Measure random identities (`config.experiment.count`) of a backend, and of the native one."""
    name, count, seed = config.experiment.backend, config.experiment.count, config.seed
    native = SomaLayer("soma", exact=True)
    figures = [
        Figure(name="soma, max", value=1e3 * _canonical_difference(native, 4, seed), unit="mm", bound=0.0)
    ]
    layer = SomaLayer(name)
    if layer.spec.wrap is not None:
        correspondence = load_correspondence(layer.spec.wrap, layer.mesh)
        scale = METRES[layer.spec.unit]
        wrap = scale * correspondence.distances[_measured_vertices(layer.mesh)]
        distances = _transfer_distances(layer, correspondence, count, seed)
        figures += distance_figures(name, distances, mean=_MEAN_MM, p95=_P95_MM)
        figures += distance_figures(f"{name} wrap", wrap)
    return Report(
        title=f"Topology abstraction: {count} random identities of {name}, closest point on the native mesh",
        figures=figures,
        notes=("Bags and between the toes are left out. The paper gives 0.01 mm (mean and P95) for Anny.",),
    )
