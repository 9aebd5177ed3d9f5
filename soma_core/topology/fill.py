"""Filling regions that have no counterpart on the native surface (paper, section 3.3).

Mouth and eye bags are carried along by an affine map fitted to their surroundings plus a harmonic
correction that closes the seam. The map is linear in the surrounding vertices and exact for every affine
image of the template, so a bag scales with its head and keeps its depth; a Laplacian with the template's
own differential coordinates would keep an adult's bag in a child's head.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from torch import Tensor

from soma_core.errors import InputError
from soma_core.geometry.laplacian import cotangent_laplacian

__all__ = ["FillOperator", "RegionFill", "build_fill"]

_RINGS = {"mid": 24, "low": 12}
"""Edge rings around a region that its affine map is fitted to; wide enough to see its depth."""

_FLATTEST = 0.01
"""Smallest ratio of singular values of the centred surroundings that still fixes an affine map."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionFill:
    """The operator of one connected region: ``x_U = lift (fit x_A) + harmonic x_G``.

    Attributes:
        free: ids of the filled vertices U, (u,).
        around: ids of the surroundings A, (a,).
        ring: ids of the boundary ring G, a subset of A, (g,).
        fit: (4, a) pseudo-inverse of the affine basis on A.
        lift: (u, 4) affine basis on U less its harmonic image.
        harmonic: (u, g) harmonic weights, rows sum to one.
    """

    free: np.ndarray
    around: np.ndarray
    ring: np.ndarray
    fit: np.ndarray
    lift: np.ndarray
    harmonic: np.ndarray


def build_fill(
    vertices: np.ndarray, triangles: np.ndarray, free: np.ndarray, *, lod: str = "mid"
) -> tuple[RegionFill, ...]:
    """Factor the fill of each connected component of `free`, once, in float64.

    Args:
        vertices: (v, 3) wrap in canonical order, any unit and axes.
        triangles: (t, 3) canonical triangles.
        free: sorted ids of the vertices to fill.
        lod: sets how far the surroundings reach.

    Raises:
        InputError: a region without boundary, or whose surroundings are flat.
    """
    if not len(free):
        return ()
    laplacian = cotangent_laplacian(vertices, triangles)
    adjacency = (laplacian != 0).astype(np.int8).tocsr()
    count, label = connected_components(adjacency[free][:, free], directed=False)
    is_free = np.zeros(len(vertices), bool)
    is_free[free] = True
    parts = [free[label == component] for component in range(count)]
    return tuple(_build_region(vertices, laplacian, adjacency, part, is_free, _RINGS[lod]) for part in parts)


def _build_region(
    vertices: np.ndarray,
    laplacian: scipy.sparse.csr_array,
    adjacency: scipy.sparse.csr_array,
    free: np.ndarray,
    is_free: np.ndarray,
    rings: int,
) -> RegionFill:
    reached = np.zeros(len(vertices), bool)
    reached[free] = True
    ring = np.empty(0, np.int64)
    for step in range(rings):
        reached |= adjacency @ reached.astype(np.int8) > 0
        if step == 0:
            ring = np.flatnonzero(reached & ~is_free)
    around = np.flatnonzero(reached & ~is_free)
    if not len(ring):
        raise InputError(
            "fill_segments",
            got=f"a region of {len(free)} vertices with no neighbour outside it",
            expected="a region bounded by vertices that the wrap covers",
            fix="Leave covered vertices around every filled segment.",
        )
    inner = laplacian[free][:, free].tocsc()
    harmonic = -splu(inner).solve(laplacian[free][:, ring].toarray())
    centre = vertices[around].mean(0)
    scale = np.abs(vertices[around] - centre).max() or 1.0

    def basis(ids: np.ndarray) -> np.ndarray:
        return np.hstack([np.ones((len(ids), 1)), (vertices[ids] - centre) / scale])

    singular = np.linalg.svd(basis(around)[:, 1:], compute_uv=False)
    if len(singular) < 3 or singular[-1] < _FLATTEST * singular[0]:
        raise InputError(
            "fill_segments",
            got=f"flat surroundings ({len(around)} vertices) of a region of {len(free)} vertices",
            expected=f"surroundings with a depth of at least {_FLATTEST:.0%} of their extent",
            fix="Fill fewer vertices, so that more of the surface around them is covered.",
        )
    return RegionFill(
        free=free,
        around=around,
        ring=ring,
        fit=np.linalg.pinv(basis(around)),
        lift=basis(free) - harmonic @ basis(ring),
        harmonic=harmonic,
    )


class FillOperator(torch.nn.Module):
    """Applies the fills of all regions to vertices laid out as (v, f): any number of columns."""

    free_vertices: Tensor

    def __init__(
        self, regions: tuple[RegionFill, ...], *, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        super().__init__()
        self.region_count = len(regions)
        for index, region in enumerate(regions):
            for name in ("free", "around", "ring", "fit", "lift", "harmonic"):
                array = torch.as_tensor(np.ascontiguousarray(getattr(region, name)), device=device)
                array = array.to(dtype if array.is_floating_point() else torch.int64)
                self.register_buffer(f"{name}_{index}", array, persistent=False)

        every = [region.free for region in regions] or [np.empty(0, np.int64)]
        ids = torch.as_tensor(np.concatenate(every), dtype=torch.int64, device=device)
        self.register_buffer("free_vertices", ids, persistent=False)

    def forward(self, flat: Tensor) -> Tensor:
        """Replace the filled rows of (v, f); the rest passes through."""
        for index in range(self.region_count):
            free, around, ring, fit, lift, harmonic = (
                getattr(self, f"{name}_{index}")
                for name in ("free", "around", "ring", "fit", "lift", "harmonic")
            )
            filled = lift @ (fit @ flat[around]) + harmonic @ flat[ring]
            flat = flat.index_copy(0, free, filled)
        return flat
