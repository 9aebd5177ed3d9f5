"""How closely a wrap pair's two meshes lie on each other, for people who judge one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from soma_core.geometry.barycentric import raised_normal
from soma_core.plugin.spec import BackendSpec
from soma_core.rig.mesh import CanonicalMesh
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.frames import METRES
from soma_core.topology.transfer import filled_vertices

__all__ = ["WrapStatistics", "wrap_statistics"]


@dataclass(frozen=True, kw_only=True)
class WrapStatistics:
    """Counts of vertices, and distances of the wrap from the native surface in millimetres.

    Attributes:
        native_count, wrap_count: vertices of the two meshes.
        filled_count: vertices of the wrap in the segments that the backend declares as having no counterpart;
            the figures below leave them out.
        mean_mm, p95_mm, max_mm: distance of a wrap vertex to the nearest point of the native surface.
        lowest_mm, highest_mm: offset along the normal of the nearest face; negative lies inside the body.
    """

    native_count: int
    wrap_count: int
    filled_count: int
    mean_mm: float
    p95_mm: float
    max_mm: float
    lowest_mm: float
    highest_mm: float


def wrap_statistics(spec: BackendSpec, mesh: CanonicalMesh) -> WrapStatistics:
    """Measure the wrap pair of a backend, which must have one, against the mid-LOD canonical mesh.

    Raises:
        AssetError: a file of the pair cannot be read.
        InputError: the pair is refused; see :func:`soma_core.topology.correspondence.load_correspondence`.
    """
    assert spec.wrap is not None
    pair = load_correspondence(spec.wrap, mesh)
    filled = filled_vertices(spec, mesh)
    kept = np.setdiff1d(np.arange(len(pair.wrap_vertices)), filled)
    to_mm = 1000 * METRES[spec.unit]
    distances = to_mm * pair.distances[kept]
    faces = torch.from_numpy(pair.native_vertices[pair.corners[kept]])
    offsets = to_mm * pair.coordinates[kept, 2] * raised_normal(faces).norm(dim=-1).numpy()
    return WrapStatistics(
        native_count=pair.native_count,
        wrap_count=len(pair.wrap_vertices),
        filled_count=len(filled),
        mean_mm=float(distances.mean()),
        p95_mm=float(np.percentile(distances, 95)),
        max_mm=float(distances.max()),
        lowest_mm=float(offsets.min()),
        highest_mm=float(offsets.max()),
    )
