"""A surface that is asked for its closest points of the same orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from soma_core.geometry.barycentric import closest_point_on_triangle
from soma_core.geometry.mesh import vertex_normals
from soma_core.topology.closest import ClosestFaces

__all__ = ["Contact", "Surface"]

_TURN = 0.04
"""Length [m] that a unit difference of normals counts for: between the sides of a gap, the right one wins."""

_OTHER = 0.1
"""Length [m] that belonging to another finger or toe counts for."""

_ON_RIM = 1e-9
"""Share of the corners off the rim below which a point lies on it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Contact:
    """Where points touch a surface.

    Attributes:
        points: (m, 3) closest points.
        normals: (m, 3) unit normals there, interpolated between vertices.
        faces: (m,) face ids.
        shares: (m, 3) barycentric coordinates in the face.
        open: (m,) whether that is the rim of a hole: the point belongs to what is missing.
    """

    points: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    shares: np.ndarray
    open: np.ndarray


class Surface:
    """A triangle mesh prepared for closest points.

    Args:
        vertices: (n, 3) [m].
        triangles: (t, 3), counter-clockwise seen from outside.
        rim: (n,) whether a vertex lies on the rim of a hole; default none.
        labels: (n, 5) how far a vertex belongs to the fingers or toes of its limb; default not at all.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        triangles: np.ndarray,
        rim: np.ndarray | None = None,
        labels: np.ndarray | None = None,
    ) -> None:
        self.vertices, self.triangles = vertices, triangles
        self._rim = np.zeros(len(vertices), bool) if rim is None else rim
        self.normals = vertex_normals(vertices, triangles)
        corners = vertices[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.face_normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        self.labels = labels
        keys = [corners.mean(1), _TURN * self.face_normals]
        if labels is not None:
            keys.append(_OTHER * labels[triangles].mean(1))
        self._tree = cKDTree(np.hstack(keys))
        self._exact = ClosestFaces(vertices, triangles)

    def facing(self, points: np.ndarray, normals: np.ndarray, labels: np.ndarray | None = None) -> Contact:
        """Closest points (m) among faces turned like `normals`, and of the finger or toe in `labels` (m, 5).

        A surface without labels takes no notice of theirs; one that has them needs them.
        """
        keys = [points, _TURN * normals]
        if self.labels is not None:
            assert labels is not None
            keys.append(_OTHER * labels)
        _, proposed = self._tree.query(np.hstack(keys))
        faces = self._exact.nearest_touching(points, proposed)
        moved = np.flatnonzero(faces != proposed)
        faces[moved] = self._exact.nearest_touching(points[moved], faces[moved])
        return self._contact(points, faces)

    def labelled(self, labels: np.ndarray | None) -> Surface:
        """The same surface with other labels (n, 5), or none."""
        return Surface(self.vertices, self.triangles, self._rim, labels)

    def closest(self, points: np.ndarray) -> Contact:
        """Closest points (m) whatever the orientation."""
        return self._contact(points, self._exact.query(points))

    def _contact(self, points: np.ndarray, faces: np.ndarray) -> Contact:
        corners = self.vertices[self.triangles[faces]]
        touched = closest_point_on_triangle(points, corners)
        shares = _shares(touched, corners)
        normals = np.einsum("mk,mkc->mc", shares, self.normals[self.triangles[faces]])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        kept = ~self._rim[self.triangles[faces]]
        cut = (shares * kept).sum(1) < _ON_RIM
        return Contact(points=touched, normals=normals, faces=faces, shares=shares, open=cut)


def _shares(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (m, 3) of points in the planes of triangles."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - corners[:, 0]
    normal = np.cross(first, second)
    squared = np.maximum((normal * normal).sum(1), 1e-300)
    u = (np.cross(offset, second) * normal).sum(1) / squared
    v = (np.cross(first, offset) * normal).sum(1) / squared
    return np.clip(np.stack([1 - u - v, u, v], 1), 0, 1)
