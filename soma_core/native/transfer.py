"""Canonical vertices to a native topology: the correspondence of a wrap pair, read the other way."""

from __future__ import annotations

import functools

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from soma_core.cache import cached_arrays, content_key
from soma_core.errors import InputError
from soma_core.geometry.barycentric import raised_normal
from soma_core.geometry.constants import constant
from soma_core.geometry.sparse import SparseRows
from soma_core.plugin.registry import Registry, default_registry
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh, Lod
from soma_core.topology.correspondence import (
    Correspondence,
    affine_matrix,
    build_correspondence,
    load_correspondence,
)
from soma_core.topology.frames import METRES, native_to_canonical
from soma_core.topology.transfer import filled_vertices

__all__ = ["NativeTransfer"]

_CODE_VERSION = "1"

_NEAR = 0.003
"""Distance to the wrap, relative to the native bounding diagonal, above which a vertex lies elsewhere."""

_LEAST_SHARE = 0.01
"""Of a vertex between canonical ones, whose error is to be told too."""

_COUNTERPART = 0.5
"""A separate piece of which less has a counterpart, such as an eyeball behind its lids, has none."""


class NativeTransfer(torch.nn.Module):
    """Gathers canonical vertices into a backend's topology, and converts axes and unit.

    The correspondence is that of :mod:`soma_core.topology` with the wrap as source and the native mesh as
    queries: it commutes with every similarity. Vertices that the wrap does not cover, such as eyeballs and
    the inside of a mouth, go along with the face next to them.

    Args:
        backend: name of an installed backend.
        lod: of the canonical vertices that come in; ``mid`` is the most exact.
        device, dtype: of constants and results.
        registry: where backends are looked up.

    Attributes:
        count: number n of native vertices.
        triangles: native vertex ids (t, 3), int64.
        covered: (n,) bool, native vertices with a counterpart on the wrap.
        shares: (n,) how many canonical vertices each of these stands for: errors weighed by it are those of
            the canonical mesh.

    Raises:
        BackendError: the backend is not installed, or its wrap pair is missing or unusable.
        InputError: the backend has no topology of its own, or `lod` is xlo.
    """

    def __init__(
        self,
        backend: str,
        *,
        lod: Lod = "mid",
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        registry: Registry | None = None,
    ) -> None:
        super().__init__()
        if lod == "xlo":
            raise InputError(
                "lod", got="'xlo'", expected="'mid' or 'low'", fix="Pose the body at lod='low' or 'mid'."
            )
        registry = registry or default_registry()
        self.spec = spec = registry.spec(backend)
        pair = registry.wrap(backend)
        if pair is None:
            raise InputError(
                "backend",
                got=backend,
                expected="a backend with a topology of its own",
                fix="Its vertices are the canonical ones: take them as they are.",
            )
        mid = load_canonical("mid")[0]
        with registry.isolated(backend, "wrap"):
            forward = load_correspondence(pair, mid)
        mesh = mid if lod == "mid" else load_canonical(lod)[0]
        back = _reverse(forward, mesh)
        self.canonical_count, self.count = mesh.vertex_count, forward.native_count
        self.affine = SparseRows(affine_matrix(back), dtype=dtype, device=device)
        frame = native_to_canonical(spec.up, spec.forward).T / METRES[spec.unit]

        keep = functools.partial(constant, device=device, dtype=dtype)
        self.corners = keep(back.corners)
        self.height = keep(back.coordinates[:, 2])
        self.triangles = keep(forward.native_triangles)
        apart = np.union1d(filled_vertices(spec, mesh), mesh.face_interior)
        covered = _covered(back, forward.native_triangles, apart)
        self.covered, self.shares = keep(covered), keep(_shares(forward, covered, apart, mesh))
        self.frame = keep(frame)

    def forward(self, vertices: Tensor) -> Tensor:
        """Native vertices (F, n, 3) in the backend's unit and axes from canonical ones (F, v, 3) [m].

        Differentiable.

        Raises:
            InputError: another number of vertices than the canonical mesh has at this LOD.
        """
        if vertices.ndim != 3 or tuple(vertices.shape[1:]) != (self.canonical_count, 3):
            raise InputError(
                "vertices",
                got=tuple(vertices.shape),
                expected=f"(frames, {self.canonical_count}, 3)",
                fix="Pass canonical vertices of the LOD that this transfer was made for.",
            )
        batch = len(vertices)
        flat = vertices.permute(1, 2, 0).reshape(self.canonical_count, 3 * batch)
        plane = self.affine(flat).view(self.count, 3, batch).permute(2, 0, 1)
        points = plane + self.height[:, None] * raised_normal(vertices[:, self.corners])
        return points @ self.frame.T


def _reverse(forward: Correspondence, mesh: CanonicalMesh) -> Correspondence:
    """Where every native vertex of a pair lies on its wrap at the LOD of `mesh`; from the cache if built."""
    wrap = forward.wrap_vertices[mesh.mid_ids]

    def build() -> dict[str, np.ndarray]:
        made = build_correspondence(wrap, mesh.triangles, forward.native_vertices)
        return {"corners": made.corners, "coordinates": made.coordinates, "distances": made.distances}

    key = content_key("reverse", _CODE_VERSION, forward.key, mesh.lod)
    arrays = cached_arrays("reverse_correspondence", key, build)
    return Correspondence(
        **arrays,
        native_count=len(wrap),
        native_vertices=wrap,
        native_triangles=mesh.triangles.astype(np.int64),
        wrap_vertices=forward.native_vertices,
        key=key,
    )


def _shares(
    forward: Correspondence, covered: np.ndarray, apart: np.ndarray, mesh: CanonicalMesh
) -> np.ndarray:
    """(n,) canonical vertices outside `apart` that each native vertex carries; zero without a counterpart."""
    counted = np.ones(mesh.vertex_count)
    counted[apart] = 0
    carried = affine_matrix(forward)[mesh.mid_ids].T @ counted
    return np.where(covered, np.maximum(carried, _LEAST_SHARE), 0)


def _covered(back: Correspondence, triangles: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """(n,) native vertices that lie on the wrap, outside `apart`, what is filled and the face interior."""
    diagonal = np.linalg.norm(np.ptp(back.wrap_vertices, axis=0))
    inner = np.isin(back.corners, apart).all(1)
    covered = (back.distances < _NEAR * diagonal) & ~inner
    count = len(covered)
    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    edges = coo_array((np.ones(len(ends), bool), tuple(ends.T)), shape=(count, count))
    _, piece = connected_components(edges, directed=False)
    share = np.bincount(piece, covered) / np.bincount(piece)
    return covered & (share[piece] > _COUNTERPART)
