"""Exact closest-face queries on a triangle mesh: a Warp BVH proposes, float64 decides."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

__all__ = ["ClosestFaces"]

_SAME = 1e-12
"""Difference of squared distances that counts as none, of the squared size of the mesh."""


class ClosestFaces:
    """A mesh prepared for queries.

    The BVH works in float32 and returns any one of the faces that share the closest point. All faces
    touching that face, also across vertices that merely coincide, are then measured in float64, and the
    lowest id among the nearest wins: the answer does not depend on the tree. Only a point exactly between
    two separate sheets may get either of them.
    """

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        self._vertices, self._triangles = vertices, triangles
        _, place = np.unique(vertices, axis=0, return_inverse=True)
        self._corner_place = place.ravel()[triangles]
        corners = self._corner_place.ravel()
        order = np.argsort(corners, kind="stable")
        self._face_of_corner = order // 3
        self._start = np.searchsorted(corners[order], np.arange(len(vertices) + 1))
        centre = vertices.mean(0)
        self._centre, self._scale = centre, float(np.abs(vertices - centre).max()) or 1.0

    def query(self, points: np.ndarray) -> np.ndarray:
        """Id of the closest face of each point; (m, 3) -> (m,) int64."""
        from soma_core.kernels.closest_point_wp import closest_faces  # Warp, needed for building only

        proposed = closest_faces(
            (points - self._centre) / self._scale,
            (self._vertices - self._centre) / self._scale,
            self._triangles,
        )
        return self.nearest_touching(points, proposed)

    def nearest_touching(self, points: np.ndarray, proposed: np.ndarray) -> np.ndarray:
        """Closest face of each point among those that touch the face proposed for it; (m,) int64."""
        from soma_core.kernels.closest_point_wp import nearest_touching

        return nearest_touching(points, proposed, self._faces, _SAME * self._scale**2)

    @functools.cached_property
    def _faces(self) -> Any:
        from soma_core.kernels.closest_point_wp import face_table

        around = self._vertices[self._triangles], self._corner_place, self._start, self._face_of_corner
        return face_table(*around)
