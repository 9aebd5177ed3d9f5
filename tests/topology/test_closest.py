"""The closest-face query: exact in float64, ties to the lowest id."""

import numpy as np
import pytest
import trimesh

from soma_core.geometry.barycentric import closest_point_on_triangle
from soma_core.topology.closest import ClosestFaces
from tests.bodies import native_body, randn

SAME_DISTANCE = 1e-12
"""Relative to the size of the mesh: float64 rounding of a distance."""


def brute_force(points, vertices, triangles):
    """Distance of every point to every face, (m, t), by trimesh in float64."""
    pairs = np.repeat(vertices[triangles][None], len(points), 0).reshape(-1, 3, 3)
    queries = np.repeat(points, len(triangles), 0)
    return np.linalg.norm(queries - trimesh.triangles.closest_point(pairs, queries), axis=1).reshape(
        len(points), -1
    )


def query_points(vertices, triangles, count=60):
    """On vertices, on edges, inside faces, close to the surface, and far away."""
    random = np.random.default_rng(0)
    corners = vertices[triangles[random.integers(len(triangles), size=count)]]
    mix = random.dirichlet(np.ones(3), size=count)[:, :, None]
    size = np.ptp(vertices, axis=0).max()
    inside = (mix * corners).sum(1)
    return np.concatenate(
        [
            vertices[random.integers(len(vertices), size=count)],
            corners[:, :2].mean(1),
            inside,
            inside + 1e-3 * size * randn(count, 3, seed=1).numpy(),
            size * randn(count, 3, seed=2).numpy(),
        ]
    )


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
def test_agrees_with_brute_force(scale):
    vertices, triangles = native_body()
    points = query_points(vertices, triangles)
    found = ClosestFaces(scale * vertices, triangles).query(scale * points)
    distance = brute_force(points, vertices, triangles)
    got = distance[np.arange(len(points)), found]
    slack = SAME_DISTANCE * np.ptp(vertices, axis=0).max()
    np.testing.assert_allclose(got, distance.min(1), atol=slack)


def test_ties_go_to_the_lowest_id():
    """At vertices and edges several faces are nearest; which one wins must not depend on the tree."""
    vertices, triangles = native_body()
    points = query_points(vertices, triangles)[:120]
    found = ClosestFaces(vertices, triangles).query(points)
    distance = brute_force(points, vertices, triangles)
    tied = distance <= distance.min(1, keepdims=True) + 1e-10 * np.ptp(vertices, axis=0).max()
    assert (tied.sum(1) > 1).all()
    np.testing.assert_array_equal(found, tied.argmax(1))


def test_ties_between_sheets_that_share_no_vertex():
    """A seam that was split: the same triangle again under new vertex ids, and once more reversed."""
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    vertices = np.concatenate([triangle + np.array([3, 0, 0]), triangle, triangle[::-1], triangle])
    faces = np.arange(12).reshape(4, 3)
    points = np.array([[0.2, 0.2, 0.0], [0.2, 0.2, 0.5], [0.0, 0.0, -1], [-1, -1, 0.3]])
    np.testing.assert_array_equal(ClosestFaces(vertices, faces).query(points), [1, 1, 1, 1])


def test_order_of_faces_changes_the_id_and_not_the_distance():
    vertices, triangles = native_body()
    points = query_points(vertices, triangles)
    order = np.random.default_rng(1).permutation(len(triangles))

    def distances(faces):
        found = ClosestFaces(vertices, faces).query(points)
        return np.linalg.norm(points - closest_point_on_triangle(points, vertices[faces[found]]), axis=1)

    np.testing.assert_allclose(distances(triangles[order]), distances(triangles), atol=1e-9)


def test_unused_vertices_are_no_targets():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5]])
    found = ClosestFaces(vertices, np.array([[0, 1, 2]])).query(np.array([[0.0, 0, 5]]))
    np.testing.assert_array_equal(found, [0])


def test_no_points():
    vertices, triangles = native_body()
    assert ClosestFaces(vertices, triangles).query(np.empty((0, 3))).shape == (0,)
