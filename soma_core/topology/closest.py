"""Exact closest-face queries on a triangle mesh: a Warp BVH proposes, float64 decides."""

from __future__ import annotations

import numpy as np

from soma_core.geometry.barycentric import closest_point_on_triangle

__all__ = ["ClosestFaces"]


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
        points = vertices[triangles]
        self._centres = points.mean(1)
        self._radii = np.linalg.norm(points - self._centres[:, None], axis=2).max(1)

    def query(self, points: np.ndarray) -> np.ndarray:
        """Id of the closest face of each point; (m, 3) -> (m,) int64."""
        from soma_core.kernels.closest_point_wp import closest_faces  # Warp, needed for building only

        centre = self._vertices.mean(0)
        scale = float(np.abs(self._vertices - centre).max()) or 1.0
        proposed = closest_faces(
            (points - centre) / scale, (self._vertices - centre) / scale, self._triangles
        )
        return self.nearest_touching(points, proposed)

    def nearest_touching(self, points: np.ndarray, proposed: np.ndarray) -> np.ndarray:
        """Closest face of each point among those that touch the face proposed for it; (m,) int64."""
        centre = self._vertices.mean(0)
        scale = float(np.abs(self._vertices - centre).max()) or 1.0
        slack = 1e-12 * scale * scale
        nearest = self._squared(points, proposed)
        query, face = self._touching(proposed)
        away = np.linalg.norm(points[query] - self._centres[face], axis=1) - self._radii[face]
        near = away <= np.sqrt(nearest + slack)[query] + 1e-9 * scale  # the others cannot be nearer
        query, face = query[near], face[near]
        squared = self._squared(points[query], face)
        np.minimum.at(nearest, query, squared)
        tied = squared <= nearest[query] + slack
        best = np.full(len(points), np.iinfo(np.int64).max)
        np.minimum.at(best, query[tied], face[tied])
        return best

    def _squared(self, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Squared distance of each point to the face given for it; (m,)."""
        offset = points - closest_point_on_triangle(points, self._vertices[self._triangles[faces]])
        return np.einsum("nc,nc->n", offset, offset)

    def _touching(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pairs (query, face): every face that shares a corner with the query's proposed face."""
        places = self._corner_place[faces]
        begin, end = self._start[places], self._start[places + 1]
        counts = (end - begin).ravel()
        query = np.repeat(np.repeat(np.arange(len(faces)), 3), counts)
        first = np.repeat(begin.ravel() - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
        return query, self._face_of_corner[first + np.arange(counts.sum())]
