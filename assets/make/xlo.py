"""The extra-low level of detail: 612 vertices decimated from the low mesh, symmetric and closed.

The bags of mouth and eyes are drawn flat first, so that the surface stays closed without them. One half
of a caricature of the body is decimated (quadric error, pyvista), the result brought back from the
caricature to the bind shape by its coordinates on the faces there, and mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from assets.make.caricature import BoundSkin, draw_caricature
from assets.make.texture_transfer import transfer_texture
from soma_core.errors import SomaError
from soma_core.geometry.barycentric import closest_point_on_triangle, raised_normal, tetrahedral_coordinates
from soma_core.geometry.mesh import split_polygons, triangle_sides
from soma_core.topology.closest import ClosestFaces
from soma_core.topology.fill import build_fill

__all__ = ["XLO_VERTICES", "LowSkin", "XloSkin", "make_xlo"]

XLO_VERTICES = 612

_MIDLINE = 0.5  # cm; how far decimation may move a vertex of the midline before it is put back
_ROUNDED = 4  # decimals of a centimetre


@dataclass(frozen=True, kw_only=True, eq=False)
class LowSkin:
    """The low mesh at its bind pose [cm], +Y up, +X left, exactly symmetric in its topology.

    Attributes:
        points: (v, 3).
        face_vert_indices, face_vert_counts: polygon stream.
        uv, uv_indices: (u, 2) and one id for each corner.
        weights: (v, J) dense.
        joint_names, parents, joints: J names, (J,) parents and (J, 3) bind positions.
        mirror: (v,) left/right partner of each vertex.
        face_interior: ids of the mouth bag and the eye bags.
    """

    points: np.ndarray
    face_vert_indices: np.ndarray
    face_vert_counts: np.ndarray
    uv: np.ndarray
    uv_indices: np.ndarray
    weights: np.ndarray
    joint_names: tuple[str, ...]
    parents: np.ndarray
    joints: np.ndarray
    mirror: np.ndarray
    face_interior: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class XloSkin:
    """The extra-low mesh at its bind pose.

    Attributes:
        points: (612, 3) float32 [cm]: the midline, the left half, then its mirror image.
        triangles: (1220, 3) int32.
        uv, uv_indices: (u, 2) float32 and one id for each corner of `triangles`.
        weights: (612, J) dense, rows sum to 1.
    """

    points: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    uv_indices: np.ndarray
    weights: np.ndarray


def _flat_bags(low: LowSkin, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points with the bags drawn onto a membrane across their rims, exactly symmetric, and those rims."""
    points = low.points.astype(np.float64)
    regions = build_fill(points, triangles, low.face_interior.astype(np.int64), lod="low")
    for region in regions:
        points[region.free] = region.harmonic @ points[region.ring]
    points = (points + points[low.mirror] * [-1, 1, 1]) / 2
    return points, np.concatenate([region.ring for region in regions])


def _decimate(points: np.ndarray, triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadric decimation of an open half to `count` triangles: points and triangles."""
    try:
        import pyvista
    except ImportError as error:
        raise SomaError(
            "making the extra-low mesh needs pyvista, which is not installed. "
            "Run: pip install 'soma-body-core[render]'"
        ) from error
    # Metres: VTK weighs an edge of the boundary by its length, a face by its area, so the unit matters.
    mesh = pyvista.PolyData.from_regular_faces(points / 100, triangles)
    # It stops at the first count that is not above the wanted one.
    reduced = mesh.decimate(1 - (count + 0.001) / len(triangles), boundary_constraints=True)
    return 100 * np.array(reduced.points, np.float64), reduced.regular_faces.astype(np.int32)


def _midline_first(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Order the vertices of an open half: first those of its boundary, of which it returns the number."""
    edges = {tuple(edge) for edge in triangle_sides(triangles).tolist()}
    boundary = np.unique([edge for edge in edges if edge[::-1] not in edges])
    order = np.concatenate([boundary, np.setdiff1d(np.arange(len(points)), boundary)])
    return points[order], np.argsort(order)[triangles].astype(np.int32), len(boundary)


def _without_chords(triangles: np.ndarray, midline: int) -> np.ndarray:
    """Flip every inner edge between two vertices of the midline: its mirror image would be the same edge."""
    triangles = triangles.copy()
    edges = triangle_sides(triangles)
    face_at = {edge: index % len(triangles) for index, edge in enumerate(map(tuple, edges.tolist()))}
    for start, end in [edge for edge in face_at if edge[0] < edge[1] < midline and edge[::-1] in face_at]:
        pair = [face_at[start, end], face_at[end, start]]
        left, right = (np.setdiff1d(triangles[face], (start, end))[0] for face in pair)
        triangles[pair] = [[start, right, left], [end, left, right]]
    return triangles


def _refuse_broken(triangles: np.ndarray, count: int, off_midline: float) -> None:
    """Refuse a mesh that is no sphere of 612 vertices, or whose halves met away from the midline."""
    edges = triangle_sides(triangles)
    undirected, uses = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    closed = (uses == 2).all() and len(np.unique(edges, axis=0)) == len(edges)
    sphere = closed and count - len(undirected) + len(triangles) == 2
    if count != XLO_VERTICES or not sphere or off_midline > _MIDLINE:
        raise SomaError(
            f"decimation gave a surface of {count} vertices, {'' if sphere else 'not '}closed, whose midline "
            f"was {off_midline:.2g} cm off; expected a closed one of {XLO_VERTICES} within {_MIDLINE} cm. "
            "Install the versions of pyvista and vtk that constraints.txt names."
        )


def _mirrored(triangles: np.ndarray, midline: int, count: int) -> np.ndarray:
    """A half's triangles and their mirror images, which share the vertices of the midline."""
    partner = np.arange(count)
    partner[midline:] += count - midline
    return np.concatenate([triangles, partner[triangles][:, ::-1]]).astype(np.int32)


def _half(low: LowSkin, triangles: np.ndarray) -> np.ndarray:
    """Triangles of the left half; the midline bounds it."""
    left = (low.points[:, 0] > 0) | (low.mirror == np.arange(len(low.points)))
    return triangles[left[triangles].all(axis=1)]


def _decimated_half(drawn: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Vertices of the decimated left half, all triangles of both halves, and the length of the midline."""
    used, local = np.unique(half, return_inverse=True)
    found, faces = _decimate(drawn[used], local.reshape(-1, 3), XLO_VERTICES - 2)
    found, faces, midline = _midline_first(found, faces)
    both = _mirrored(_without_chords(faces, midline), midline, len(found))
    _refuse_broken(both, 2 * len(found) - midline, float(np.abs(found[:midline, 0]).max()))
    found[:midline, 0] = 0
    return found, both, midline


def _carried(points: np.ndarray, corners: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Where `points` (n, 3) come to lie when the faces with `corners` (n, 3, 3) move to `ends`."""
    import torch

    c = tetrahedral_coordinates(points, corners)
    raised = raised_normal(torch.as_tensor(ends)).numpy()
    return np.einsum("nk,nkc->nc", _shares(c), ends) + c[:, 2:] * raised


def _weights_at(points: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Skin weights (n, J) of the closest points on faces, from those of their corners (n, 3, J)."""
    closest = closest_point_on_triangle(points, corners)
    shares = _shares(tetrahedral_coordinates(closest, corners)).clip(0, 1)
    mixed = np.einsum("nk,nkj->nj", shares, weights)
    return mixed / mixed.sum(axis=1, keepdims=True)


def _shares(coordinates: np.ndarray) -> np.ndarray:
    """Weights (n, 3) of the three corners of a face, from tetrahedral coordinates."""
    first, second = coordinates[:, 0], coordinates[:, 1]
    return np.stack([1 - first - second, first, second], 1)


def make_xlo(low: LowSkin) -> XloSkin:
    """Decimate the low mesh to 612 vertices.

    Positions and topology are exactly symmetric; weights and texture coordinates are those of the low mesh
    at the same place, on either side.

    Raises:
        SomaError: pyvista is not installed, or decimates to another mesh than a closed one of 612 vertices.
    """
    # Triangles of polygon corners: a corner knows both its vertex and its texture coordinate.
    indices, counts = low.face_vert_indices, low.face_vert_counts
    corner_ids = split_polygons(np.arange(len(indices)), counts, low.points[indices])
    triangles = indices[corner_ids].astype(np.int64)
    points, rims = _flat_bags(low, triangles)
    skin = BoundSkin(
        points=points, weights=low.weights, joint_names=low.joint_names, parents=low.parents,
        joints=low.joints, mirror=low.mirror, lips_and_lids=rims,
    )  # fmt: skip
    drawn, half = draw_caricature(skin), _half(low, triangles)
    found, both, midline = _decimated_half(drawn, half)
    on = half[ClosestFaces(drawn, half).query(found)]
    shape = _carried(found, drawn[on], points[on])
    shape[:midline, 0] = 0
    weights, right = (_weights_at(found, drawn[on], low.weights[ids]) for ids in (on, low.mirror[on]))
    weights[:midline] = (weights[:midline] + right[:midline]) / 2
    corners = _with_mirror(found, midline)[both]
    uv, uv_indices = transfer_texture(corners, drawn[triangles], low.uv, low.uv_indices[corner_ids])
    return XloSkin(
        points=np.round(_with_mirror(shape, midline), _ROUNDED).astype(np.float32),
        triangles=both,
        uv=uv,
        uv_indices=uv_indices,
        weights=np.concatenate([weights, right[midline:]]),
    )


def _with_mirror(points: np.ndarray, midline: int) -> np.ndarray:
    """Vertices of a half and the mirror images of those off the midline."""
    return np.concatenate([points, points[midline:] * [-1, 1, 1]])
