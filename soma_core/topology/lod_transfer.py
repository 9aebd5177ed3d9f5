"""Vertices of one level of detail on the surface of another: how bodies reach the extra-low mesh.

The extra-low vertices are none of the low ones, so they are carried by the same operator as a native
topology (paper, section 3.3): barycentric coordinates on the nearest face, and a height.
"""

from __future__ import annotations

import functools
import hashlib

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.cache import cached_arrays, content_key
from soma_core.geometry.barycentric import raised_normal, raised_normal_jacobian
from soma_core.geometry.constants import constant
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh
from soma_core.topology.correspondence import Correspondence, build_correspondence

__all__ = ["LodTransfer", "lod_correspondence", "offset_rows"]

_CODE_VERSION = "1"


def lod_correspondence(source: CanonicalMesh, target: CanonicalMesh) -> Correspondence:
    """Where the vertices of `target` lie on `source` at the bind shape; cached.

    Faces of the bags in mouth and eyes carry nothing: they lie just under the lips and the lids.
    """
    shape = hashlib.sha256(np.ascontiguousarray(target.vertices).tobytes()).hexdigest()
    key = content_key("lod", _CODE_VERSION, source.revision, shape)
    outside = source.triangles[~np.isin(source.triangles, source.face_interior).any(axis=1)]

    def build() -> dict[str, np.ndarray]:
        made = build_correspondence(source.vertices, outside, target.vertices)
        return {"corners": made.corners, "coordinates": made.coordinates, "distances": made.distances}

    arrays = cached_arrays("lod", key, build)
    return Correspondence(
        **arrays,
        native_count=source.vertex_count,
        native_vertices=source.vertices,
        native_triangles=outside,
        wrap_vertices=target.vertices,
        key=key,
    )


class LodTransfer(torch.nn.Module):
    """Carries bodies from one level of detail to another; commutes with every similarity.

    Args:
        source: the mesh that bodies are given on.
        target: the mesh that they are wanted on.

    Attributes:
        source_ids: ids of the source vertices that any target vertex depends on, sorted, (s,).
    """

    def __init__(
        self, source: CanonicalMesh, target: CanonicalMesh, *, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        super().__init__()
        found = lod_correspondence(source, target)
        self.source_count = source.vertex_count
        source_ids, corners = np.unique(found.corners, return_inverse=True)
        first, second, height = found.coordinates.T

        keep = functools.partial(constant, device=device, dtype=dtype)
        self.source_ids = keep(source_ids)
        self.corners = keep(corners.reshape(-1, 3))
        self.shares = keep(np.stack([1 - first - second, first, second], 1))
        self.height = keep(height)

    def forward(self, vertices: Tensor) -> Tensor:
        """Target vertices (B, t, 3) from source vertices (B, v, 3), any unit. Differentiable."""
        return self.from_needed(vertices[:, self.source_ids])

    def from_needed(self, needed: Tensor) -> Tensor:
        """The same, from the vertices of `source_ids` alone, (B, s, 3)."""
        corners = needed[:, self.corners]
        plane = torch.einsum("nk,bnkc->bnc", self.shares, corners)
        return plane + self.height[:, None] * raised_normal(corners)


def offset_rows(mesh: CanonicalMesh) -> scipy.sparse.csr_array:
    """Matrix (3 v, 3 m) that takes small offsets of mid vertices to those of a level of detail.

    Rows and columns are ``3 * vertex + axis``, up to the last mid vertex that counts. For mid and low it
    selects rows; for xlo it is the derivative of :class:`LodTransfer` at the bind shape.
    """
    axes = np.arange(3)
    if mesh.lod != "xlo":
        columns = (3 * mesh.mid_ids.astype(np.int64)[:, None] + axes).ravel()
        entries = (np.ones(len(columns)), (np.arange(len(columns)), columns))
        return scipy.sparse.csr_array(entries)
    low = load_canonical("low", mesh.root)[0]
    found = lod_correspondence(low, mesh)
    first, second, height = found.coordinates.T
    shares = np.stack([1 - first - second, first, second], 1)
    slope = height[:, None, None, None] * raised_normal_jacobian(low.vertices[found.corners])
    slope += np.einsum("nk,ij->nikj", shares, np.eye(3))
    rows = np.broadcast_to(np.arange(3 * len(height)).reshape(-1, 3, 1, 1), slope.shape)
    corners = low.mid_ids[found.corners].astype(np.int64)
    columns = np.broadcast_to((3 * corners[:, :, None] + axes)[:, None], slope.shape)
    entries = (slope.ravel(), (rows.ravel(), columns.ravel()))
    return scipy.sparse.csr_array(entries)
