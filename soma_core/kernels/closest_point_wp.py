"""Closest-face query on Warp's bounding volume hierarchy."""

import numpy as np
import warp as wp

from soma_core.kernels._runtime import start

__all__ = ["closest_faces"]


@wp.kernel
def _closest(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), face: wp.array(dtype=wp.int32)):
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], wp.float32(1.0e6))
    face[i] = query.face


def closest_faces(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A closest face of each point in float32; coordinates should be of order one.

    Args:
        points: (m, 3).
        vertices: (n, 3).
        triangles: (t, 3) integers.

    Returns:
        Face ids (m,) int64. Among faces at equal distance any one may be returned.
    """
    start()
    mesh = wp.Mesh(
        points=wp.array(vertices.astype(np.float32), dtype=wp.vec3, device="cpu"),
        indices=wp.array(triangles.astype(np.int32).ravel(), dtype=wp.int32, device="cpu"),
    )
    found = wp.empty(len(points), dtype=wp.int32, device="cpu")
    queries = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(_closest, dim=len(points), inputs=[mesh.id, queries, found], device="cpu")
    return found.numpy().astype(np.int64)
