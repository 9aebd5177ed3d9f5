"""The canonical mesh (paper, section 3.1): one topology that every identity is brought to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from soma_core.geometry.mesh import polygon_sides, unique_edges

__all__ = ["CanonicalMesh", "Lod"]

Lod = Literal["mid", "low", "xlo"]


@dataclass(frozen=True, kw_only=True, eq=False)
class CanonicalMesh:
    """Topology, UVs and semantics of the canonical mesh at one level of detail.

    Attributes:
        vertices: bind shape [m], (v, 3) float64, +Y up, +Z forward.
        triangles: (t, 3) int32, the canonical triangulation.
        face_vert_indices, face_vert_counts: polygon stream (int32), USD style.
        uv: (u, 2) float32 texture coordinates; empty where the source has none.
        uv_indices: one UV id for each entry of ``face_vert_indices`` (int32).
        segments: name -> vertex ids of this LOD (int32, sorted).
        mirror: (v,) int32, the left/right partner of each vertex of this LOD.
        mid_ids: (v,) int32, id of each vertex in the mid LOD; empty for xlo, whose vertices are its own.
        lod: which level this is.
        revision: first 16 hex digits of the rig hash, with ``-low`` for a derived LOD.
        root: the assets folder that it is from, where its other levels are; None: the one in use.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    face_vert_indices: np.ndarray
    face_vert_counts: np.ndarray
    uv: np.ndarray
    uv_indices: np.ndarray
    segments: Mapping[str, np.ndarray]
    mirror: np.ndarray
    mid_ids: np.ndarray
    lod: Lod
    revision: str
    root: Path | None = None

    @property
    def vertex_count(self) -> int:
        """Number of vertices at this LOD."""
        return len(self.vertices)

    def edges(self) -> np.ndarray:
        """Edges of the polygons, each once, smaller id first, (e, 2) int64."""
        return unique_edges(polygon_sides(self.face_vert_indices, self.face_vert_counts))

    @property
    def face_interior(self) -> np.ndarray:
        """Sorted ids of the mouth bag and the two eye bags."""
        parts = [self.segments.get(name, np.empty(0, np.int32)) for name in ("mouth_bag", "eye_bags")]
        return np.unique(np.concatenate(parts)).astype(np.int32)
