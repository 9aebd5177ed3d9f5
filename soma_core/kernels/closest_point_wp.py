"""Closest-face query on Warp's bounding volume hierarchy, and among the faces around one, in float64."""

import numpy as np
import warp as wp

from soma_core.kernels._runtime import loaded, start

__all__ = ["closest", "closest_faces", "face_table", "nearest_touching"]


@wp.kernel(enable_backward=False)
def closest(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), face: wp.array(dtype=wp.int32)):
    """Kernel of :func:`closest_faces`."""
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
    wp.launch(loaded(closest, "cpu"), dim=len(points), inputs=[mesh.id, queries, found], device="cpu")
    return found.numpy().astype(np.int64)


@wp.struct
class _Faces:
    corners: wp.array(dtype=wp.vec3d, ndim=2)
    centres: wp.array(dtype=wp.vec3d)
    radii: wp.array(dtype=wp.float64)
    places: wp.array(dtype=wp.int32, ndim=2)
    begin: wp.array(dtype=wp.int32)
    around: wp.array(dtype=wp.int32)


@wp.func
def _to_segment(point: wp.vec3d, start: wp.vec3d, end: wp.vec3d):
    along = end - start
    squared = wp.dot(along, along)
    share = wp.float64(0.0)
    if squared > wp.float64(0.0):
        share = wp.clamp(wp.dot(point - start, along) / squared, wp.float64(0.0), wp.float64(1.0))
    offset = point - (start + share * along)
    return wp.dot(offset, offset)


@wp.func
def _to_face(point: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Squared distance, as that of soma_core.geometry.barycentric.closest_point_on_triangle."""
    first, second, offset = b - a, c - a, point - a
    normal = wp.cross(first, second)
    squared = wp.dot(normal, normal)
    if squared > wp.float64(0.0):
        u = wp.dot(wp.cross(offset, second), normal) / squared
        v = wp.dot(wp.cross(first, offset), normal) / squared
        if u >= wp.float64(0.0) and v >= wp.float64(0.0) and u + v <= wp.float64(1.0):
            off = offset - u * first - v * second
            return wp.dot(off, off)
    return wp.min(_to_segment(point, a, b), wp.min(_to_segment(point, b, c), _to_segment(point, c, a)))


@wp.func
def _squared(faces: _Faces, face: wp.int32, point: wp.vec3d, bound: wp.float64):
    """Squared distance, or something beyond the bound [length] where it is beyond that."""
    away = wp.length(point - faces.centres[face]) - faces.radii[face]
    if away > bound:
        return wp.float64(wp.inf)
    return _to_face(point, faces.corners[face, 0], faces.corners[face, 1], faces.corners[face, 2])


@wp.kernel(enable_backward=False)
def _touching(
    faces: _Faces,
    points: wp.array(dtype=wp.vec3d),
    proposed: wp.array(dtype=wp.int32),
    slack: wp.float64,
    found: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    point, face = points[i], proposed[i]
    margin = wp.sqrt(slack)
    nearest = _squared(faces, face, point, wp.float64(wp.inf))
    for corner in range(3):
        place = faces.places[face, corner]
        for at in range(faces.begin[place], faces.begin[place + 1]):
            bound = wp.sqrt(nearest) + margin
            nearest = wp.min(nearest, _squared(faces, faces.around[at], point, bound))
    best = face
    bound = wp.sqrt(nearest) + margin
    if _squared(faces, face, point, wp.float64(wp.inf)) > nearest + slack:
        best = wp.int32(2147483647)
    for corner in range(3):
        place = faces.places[face, corner]
        for at in range(faces.begin[place], faces.begin[place + 1]):
            other = faces.around[at]
            if other < best and _squared(faces, other, point, bound) <= nearest + slack:
                best = other
    found[i] = best


def face_table(corners: np.ndarray, places: np.ndarray, begin: np.ndarray, around: np.ndarray) -> _Faces:
    """Faces (t) and those around each place (p) of a mesh, where vertices may coincide.

    Args:
        corners: (t, 3, 3).
        places: (t, 3) integers, of the corners.
        begin: (p + 1,) integers, where a place begins in `around`.
        around: face ids, place by place.
    """
    start()
    centres = corners.mean(1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(1)
    faces = _Faces()
    faces.corners, faces.centres = _on_cpu(corners, wp.vec3d), _on_cpu(centres, wp.vec3d)
    faces.radii, faces.places = _on_cpu(radii, wp.float64), _on_cpu(places, wp.int32)
    faces.begin, faces.around = _on_cpu(begin, wp.int32), _on_cpu(around, wp.int32)
    return faces


def nearest_touching(points: np.ndarray, proposed: np.ndarray, faces: _Faces, slack: float) -> np.ndarray:
    """Nearest in float64 of the faces that touch the one proposed for a point, the lowest id among equals.

    Args:
        points: (m, 3).
        proposed: (m,) integers.
        faces: of :func:`face_table`.
        slack: squared length up to which squared distances are equal.
    """
    found = wp.empty(len(points), dtype=wp.int32, device="cpu")
    inputs = [faces, _on_cpu(points, wp.vec3d), _on_cpu(proposed, wp.int32), slack, found]
    wp.launch(loaded(_touching, "cpu"), dim=len(points), inputs=inputs, device="cpu")
    return found.numpy().astype(np.int64)


def _on_cpu(values: np.ndarray, dtype: type) -> wp.array:
    kind = np.int32 if dtype is wp.int32 else np.float64
    return wp.array(np.ascontiguousarray(values, kind), dtype=dtype, device="cpu")
