"""Texture coordinates of one mesh from another in the same place, one side of each seam at a time."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from soma_core.geometry.barycentric import closest_point_on_triangle, tetrahedral_coordinates

__all__ = ["transfer_texture"]

_REACH = 1.5  # faces with their centre within this many radii of a triangle may lend it their texture
_DECIMALS = 6  # one place of the texture, found from two triangles, shall be one entry


def transfer_texture(
    targets: np.ndarray, sources: np.ndarray, uv: np.ndarray, uv_faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find texture coordinates for every corner of `targets`, all three from one side of each seam.

    A triangle that lies across a seam belongs to the side of its centre; its corners beyond the seam get
    the nearest place on that side.

    Args:
        targets, sources: (t, 3, 3) and (s, 3, 3) corners of triangles; no source without area.
        uv: (u, 2) coordinates.
        uv_faces: (s, 3) their ids at the corners of `sources`; neighbours across a seam share no pair.

    Returns:
        (n, 2) float32 coordinates and (3 t,) int32 ids, one a corner.
    """
    target, source = _nearby(targets, sources)
    starts = np.searchsorted(target, np.arange(len(targets)))
    _, label = connected_components(_seamless(target, source, uv_faces), directed=False)

    def nearest(points: np.ndarray, allowed: np.ndarray) -> np.ndarray:
        """The pair whose source is closest to the target's point, among those allowed."""
        offsets = points[target] - closest_point_on_triangle(points[target], sources[source])
        distances = np.where(allowed, np.einsum("nc,nc->n", offsets, offsets), np.inf)
        return np.lexsort((distances, target))[starts]

    centre = nearest(targets.mean(axis=1), np.ones(len(target), bool))
    same_side = label == label[centre][target]
    found = np.empty((len(targets), 3, 2))
    for corner in range(3):
        points = targets[:, corner]
        face = source[nearest(points, same_side)]
        on = closest_point_on_triangle(points, sources[face])
        c = tetrahedral_coordinates(on, sources[face])
        shares = np.stack([1 - c[:, 0] - c[:, 1], c[:, 0], c[:, 1]], 1)
        found[:, corner] = np.einsum("nk,nkc->nc", shares, uv[uv_faces[face]])
    rounded = np.round(found.reshape(-1, 2), _DECIMALS).astype(np.float32)
    unique, ids = np.unique(rounded, axis=0, return_inverse=True)
    return unique, ids.ravel().astype(np.int32)


def _nearby(targets: np.ndarray, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (target, source) in ascending order: the sources around each target that face its way.

    Without the rest of a limb, the two sides of a seam along it are not joined around its back.
    """
    middles, centres = targets.mean(axis=1), cKDTree(sources.mean(axis=1))
    radius = np.linalg.norm(targets - middles[:, None], axis=2).max(axis=1)
    distance, nearest = centres.query(middles)
    found = centres.query_ball_point(middles, np.maximum(_REACH * radius, distance * (1 + 1e-9)))
    target = np.repeat(np.arange(len(targets)), [len(ids) for ids in found])
    source = np.concatenate([np.sort(ids) for ids in found]).astype(np.int64)
    facing = np.einsum("nc,nc->n", _normals(targets)[target], _normals(sources)[source]) > 0
    kept = facing | (source == nearest[target])
    return target[kept], source[kept]


def _normals(triangles: np.ndarray) -> np.ndarray:
    """Normals (t, 3) of any length."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _seamless(target: np.ndarray, source: np.ndarray, uv_faces: np.ndarray) -> scipy.sparse.csr_array:
    """Graph of the pairs: joined where they have the target in common and their sources an edge in `uv`."""
    count = len(uv_faces)
    key = target * count + source
    rows, columns = [], []
    for neighbour in _neighbours(uv_faces).T:
        other = neighbour[source]
        wanted = target * count + other
        place = np.searchsorted(key, wanted).clip(max=len(key) - 1)
        joined = (other >= 0) & (key[place] == wanted)
        rows.append(np.flatnonzero(joined))
        columns.append(place[joined])
    row, column = np.concatenate(rows), np.concatenate(columns)
    return scipy.sparse.csr_array((np.ones(len(row)), (row, column)), shape=(len(key), len(key)))


def _neighbours(uv_faces: np.ndarray) -> np.ndarray:
    """Face across each of the three edges in texture space, -1 at a seam: (s, 3)."""
    edges = np.stack([uv_faces, np.roll(uv_faces, -1, axis=1)], axis=2).reshape(-1, 2)
    _, edge, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.ravel(), kind="stable")
    first = np.cumsum(uses) - uses
    pairs = order[first[uses == 2][:, None] + [0, 1]]
    found = np.full(len(edges), -1)
    found[pairs] = pairs[:, ::-1] // 3
    return found.reshape(-1, 3)
