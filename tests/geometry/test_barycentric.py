"""Tetrahedral coordinates, the raised normal and its derivative, and closest points on triangles."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from soma_core.geometry.barycentric import (
    closest_point_on_triangle,
    raised_normal,
    raised_normal_jacobian,
    tetrahedral_coordinates,
)
from tests.bodies import randn

REPRODUCTION = 1e-12
"""float64 rounding of well-shaped triangles of size one."""
EQUIVARIANCE = {torch.float32: 2e-6, torch.float64: 1e-12}
DTYPES = [torch.float32, torch.float64]


def triangles(count=60, seed=0):
    return randn(count, 3, 3, seed=seed)


def reconstruct(coordinates, corners):
    origin = corners[:, 0]
    raised = raised_normal(torch.as_tensor(corners)).numpy()
    c1, c2, c3 = coordinates.T[..., None]
    return origin + c1 * (corners[:, 1] - origin) + c2 * (corners[:, 2] - origin) + c3 * raised


def test_coordinates_reproduce_their_points():
    corners, points = triangles().numpy(), randn(60, 3, seed=1).numpy()
    coordinates = tetrahedral_coordinates(points, corners)
    np.testing.assert_allclose(reconstruct(coordinates, corners), points, atol=REPRODUCTION)


def test_coordinates_of_needles_reproduce_their_points():
    """Triangles a thousand times longer than wide: the Gram determinant would lose six digits."""
    corners = triangles().numpy()
    corners[:, 2] = (
        corners[:, 0] + 0.5 * (corners[:, 1] - corners[:, 0]) + 1e-3 * (corners[:, 2] - corners[:, 1])
    )
    points = corners.mean(1) + 1e-3 * randn(60, 3, seed=2).numpy()
    coordinates = tetrahedral_coordinates(points, corners)
    np.testing.assert_allclose(reconstruct(coordinates, corners), points, atol=1e-10)


def test_corners_have_unit_coordinates():
    corners = triangles().numpy()
    for corner, expected in ((0, [0, 0, 0]), (1, [1, 0, 0]), (2, [0, 1, 0])):
        found = tetrahedral_coordinates(corners[:, corner], corners)
        np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-11)


@pytest.mark.parametrize("scale", [0.01, 0.6, 100.0])
def test_coordinates_do_not_change_under_similarities(scale):
    corners, points = triangles().numpy(), randn(60, 3, seed=3).numpy()
    turn = Rotation.random(random_state=1).as_matrix()
    moved = tetrahedral_coordinates(scale * points @ turn.T + 2, scale * corners @ turn.T + 2)
    np.testing.assert_allclose(moved, tetrahedral_coordinates(points, corners), atol=1e-9, rtol=1e-9)


def test_raised_normal_is_the_mean_edge_along_the_unit_normal():
    corners = torch.tensor([[[0, 0, 0], [3, 0, 0], [0, 4, 0]]], dtype=torch.float64)
    torch.testing.assert_close(raised_normal(corners), torch.tensor([[0, 0, 4.0]], dtype=torch.float64))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scale", [1e-3, 0.6, 1.0, 100.0])
def test_raised_normal_is_equivariant_under_similarities(scale, dtype):
    corners = triangles()
    turn = torch.from_numpy(Rotation.random(random_state=2).as_matrix())
    moved = raised_normal((scale * corners @ turn.T + scale).to(dtype)).double()
    expected = scale * raised_normal(corners) @ turn.T
    slack = 100 * EQUIVARIANCE[dtype] * scale  # corners a unit apart carry the rounding of the offset
    torch.testing.assert_close(moved, expected, atol=slack, rtol=0)


def test_raised_normal_flips_under_mirroring():
    corners, mirror = triangles(), torch.diag(torch.tensor([-1.0, 1, 1], dtype=torch.float64))
    torch.testing.assert_close(raised_normal(corners @ mirror), -raised_normal(corners) @ mirror)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["point", "line", "two corners"])
def test_collapsed_triangles_give_short_finite_vectors_and_gradients(kind, dtype):
    corners = randn(8, 1, 3, seed=4, dtype=dtype).repeat(1, 3, 1)
    if kind != "point":
        corners[:, 2] += 0.1
    if kind == "line":
        corners[:, 1] += 0.04
    corners.requires_grad_()
    raised = raised_normal(corners)
    assert raised.norm(dim=-1).max() < 0.2
    (grad,) = torch.autograd.grad(raised.sum(), corners)
    assert raised.isfinite().all()
    assert grad.isfinite().all()


def test_raised_normal_gradcheck():
    assert torch.autograd.gradcheck(raised_normal, triangles(4).requires_grad_())


def test_jacobian_is_the_autograd_one():
    corners = triangles(20)
    expected = torch.stack([torch.autograd.functional.jacobian(raised_normal, c) for c in corners])
    found = torch.from_numpy(raised_normal_jacobian(corners.numpy()))
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=1e-9)


def test_jacobian_annihilates_translations_and_reproduces_growth():
    corners = triangles(20, seed=5).numpy()
    jacobian = raised_normal_jacobian(corners)
    np.testing.assert_allclose(jacobian.sum(2), 0, atol=1e-10)
    grown = np.einsum("nikj,nkj->ni", jacobian, corners)  # Euler: homogeneous of degree one
    np.testing.assert_allclose(grown, raised_normal(torch.as_tensor(corners)).numpy(), atol=1e-10)


def test_closest_points_agree_with_trimesh():
    corners, points = triangles(400, seed=6).numpy(), 2 * randn(400, 3, seed=7).numpy()
    expected = trimesh.triangles.closest_point(corners, points)
    np.testing.assert_allclose(closest_point_on_triangle(points, corners), expected, atol=1e-10)


def test_no_point_of_the_triangle_is_closer():
    corners, points = triangles(100, seed=8).numpy(), 2 * randn(100, 3, seed=9).numpy()
    found = np.linalg.norm(points - closest_point_on_triangle(points, corners), axis=1)
    mix = np.random.default_rng(0).dirichlet(np.ones(3), size=200)
    others = np.einsum("sk,nkc->snc", mix, corners)
    assert (np.linalg.norm(points - others, axis=-1) >= found - 1e-12).all()


def test_points_of_the_triangle_are_their_own_closest_points():
    corners = triangles(50, seed=10).numpy()
    mix = np.random.default_rng(1).dirichlet(np.ones(3), size=50)
    points = np.einsum("nk,nkc->nc", mix, corners)
    np.testing.assert_allclose(closest_point_on_triangle(points, corners), points, atol=1e-12)


def test_closest_point_of_a_collapsed_triangle_lies_on_what_is_left():
    line = np.array([[[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0]], [[1.0, 1, 1], [1, 1, 1], [1, 1, 1]]])
    found = closest_point_on_triangle(np.array([[0.25, 2, 0], [5.0, 5, 5]]), line)
    np.testing.assert_allclose(found, [[0.25, 0, 0], [1, 1, 1]])
