"""The cotangent Laplacian: symmetric, zero row sums, positive semi-definite, and a Laplacian."""

import numpy as np
import pytest

from soma_core.geometry.laplacian import cotangent_laplacian, random_walk, vertex_areas
from tests.bodies import cube_sphere, tiny_canonical

ROUNDING = 1e-11
CLAMP = 1e-6
"""Relative to the mean weight: where two right angles cancel, rounding decides whether the clamp acts."""


def flat_grid(cells=6):
    steps = np.linspace(0, 1, cells + 1)
    points = np.stack([*np.meshgrid(steps, steps, indexing="ij"), np.zeros((cells + 1,) * 2)], -1).reshape(
        -1, 3
    )
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    a, b, c, d = (
        corner[:-1, :-1].ravel(),
        corner[1:, :-1].ravel(),
        corner[1:, 1:].ravel(),
        corner[:-1, 1:].ravel(),
    )
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def body():
    mesh, _ = tiny_canonical()
    return mesh.vertices, mesh.triangles


def sphere():
    points, quads = cube_sphere(5)
    return points, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


@pytest.mark.parametrize("shape", [flat_grid, body, sphere])
def test_symmetric_zero_row_sums_positive_semidefinite(shape):
    laplacian = cotangent_laplacian(*shape()).toarray()
    np.testing.assert_allclose(laplacian, laplacian.T, atol=ROUNDING)
    np.testing.assert_allclose(laplacian.sum(1), 0, atol=ROUNDING)
    eigenvalues = np.linalg.eigvalsh(laplacian)
    assert eigenvalues[0] > -ROUNDING
    assert eigenvalues[1] > 1e-6  # one component: constants are the whole kernel
    off = laplacian - np.diag(np.diag(laplacian))
    assert (off <= 0).all()


def test_known_weights_of_a_square():
    """A unit square cut along one diagonal: sides 1/2, the diagonal opposite two right angles about 0."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    laplacian = cotangent_laplacian(points, np.array([[0, 1, 2], [0, 2, 3]])).toarray()
    np.testing.assert_allclose([laplacian[0, 1], laplacian[1, 2], laplacian[2, 3]], -0.5, atol=1e-12)
    assert -1e-5 < laplacian[0, 2] <= 0
    assert laplacian[1, 3] == 0


def test_linear_functions_on_a_plane_are_harmonic():
    points, triangles = flat_grid()
    inside = (np.abs(points[:, :2] - 0.5) < 0.49).all(1)
    linear = points @ [2.0, -3.0, 0.0]
    # Diagonals of squares have cotangent zero and get the clamp, which linear functions still satisfy.
    np.testing.assert_allclose((cotangent_laplacian(points, triangles) @ linear)[inside], 0, atol=1e-9)


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_unit_does_not_matter(scale):
    vertices, triangles = body()
    moved = cotangent_laplacian(scale * vertices + scale, triangles)
    np.testing.assert_allclose(
        moved.toarray(), cotangent_laplacian(vertices, triangles).toarray(), rtol=1e-6, atol=CLAMP
    )


def test_degenerate_triangles_contribute_nothing():
    points, triangles = flat_grid()
    collapsed = np.array([[0, 0, 1], [3, 3, 3]])
    with_them = cotangent_laplacian(points, np.concatenate([triangles, collapsed])).toarray()
    np.testing.assert_allclose(with_them, cotangent_laplacian(points, triangles).toarray(), atol=1e-6)


def test_obtuse_pairs_are_clamped():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.05, 0], [0.5, -0.05, 0]])
    laplacian = cotangent_laplacian(points, np.array([[0, 1, 2], [1, 0, 3]])).toarray()
    assert laplacian[0, 1] < 0  # the plain cotangent sum is about -5
    assert np.linalg.eigvalsh(laplacian)[0] > -ROUNDING


def test_areas_of_vertices():
    points, triangles = flat_grid()
    areas = vertex_areas(points, triangles)
    np.testing.assert_allclose(areas.sum(), 1.0, atol=ROUNDING)
    inside = (points[:, :2] > 0).all(1) & (points[:, :2] < 1).all(1)
    np.testing.assert_allclose(areas[inside], 1 / 36, atol=ROUNDING)  # six half cells, a third of each
    np.testing.assert_allclose(areas.min(), 1 / 36 / 6, atol=ROUNDING)  # a corner with one triangle


def test_random_walk_takes_the_mean_of_the_neighbours_away():
    laplacian = random_walk(np.array([[0, 1], [0, 2], [1, 2], [2, 3]]), 5)
    np.testing.assert_allclose(laplacian @ np.array([0.0, 3, 6, 9, 7]), [-4.5, 0, 2, 3, 7])  # 4 stands alone
