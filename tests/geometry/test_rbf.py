"""Affine radial basis weights: they carry a point along with any affine map of the cloud."""

import numpy as np
import pytest

from soma_core.geometry.rbf import affine_rbf_weights

EXACT = 1e-9
"""Rounding of a solve with a condition of about 1e6, on points of order one."""


def cloud(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3))


QUERIES = cloud(4, seed=99)


@pytest.mark.parametrize("count", [4, 5, 12, 150])
def test_weights_reproduce_the_queries_and_sum_to_one(count):
    weights = affine_rbf_weights(cloud(count), QUERIES)
    assert weights.shape == (4, count)
    np.testing.assert_allclose(weights.sum(1), 1, atol=EXACT)
    np.testing.assert_allclose(weights @ cloud(count), QUERIES, atol=EXACT)


@pytest.mark.parametrize("count", [4, 12, 150])
def test_exact_under_every_affine_map(count):
    points = cloud(count)
    weights = affine_rbf_weights(points, QUERIES)
    linear, shift = cloud(3, seed=1), cloud(1, seed=2)
    np.testing.assert_allclose(
        weights @ (points @ linear.T + shift), QUERIES @ linear.T + shift, atol=10 * EXACT
    )


@pytest.mark.parametrize("scale", [1e-3, 100.0])
def test_unit_and_place_of_the_cloud_do_not_matter(scale):
    weights = affine_rbf_weights(cloud(30), QUERIES)
    moved = affine_rbf_weights(scale * cloud(30) + 7 * scale, scale * QUERIES + 7 * scale)
    np.testing.assert_allclose(moved, weights, atol=EXACT)


def test_is_the_textbook_interpolant():
    """Any function's interpolant at the query equals weights times its values: checked by the dual solve."""
    points, query = cloud(20), QUERIES[:1]
    values = np.sin(points.sum(1))
    kernel = np.linalg.norm(points[:, None] - points[None], axis=-1)
    basis = np.hstack([np.ones((20, 1)), points])
    system = np.block([[kernel, basis], [basis.T, np.zeros((4, 4))]])
    solution = np.linalg.solve(system, np.concatenate([values, np.zeros(4)]))
    at_query = (
        np.linalg.norm(points - query, axis=1) @ solution[:20] + solution[20] + query[0] @ solution[21:]
    )
    np.testing.assert_allclose(affine_rbf_weights(points, query) @ values, at_query, atol=1e-9)


def test_interpolates_at_a_point_of_the_cloud():
    weights = affine_rbf_weights(cloud(15), cloud(15)[[3]])
    np.testing.assert_allclose(weights, np.eye(15)[[3]], atol=1e-8)


FLAT = np.array([1.0, 1.0, 0.0])


@pytest.mark.parametrize("count", [4, 20])
def test_flat_clouds_reproduce_queries_in_their_plane(count):
    points, inside = cloud(count) * FLAT, QUERIES * FLAT
    weights = affine_rbf_weights(points, inside)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-8)
    np.testing.assert_allclose(weights @ points, inside, atol=1e-8)


def test_flat_clouds_in_a_tilted_plane_and_nearly_flat_ones():
    turn = np.linalg.qr(cloud(3, seed=3))[0]
    for thickness in (0.0, 1e-9):
        points = (cloud(20) * [1, 1, thickness]) @ turn.T
        queries = (QUERIES * FLAT) @ turn.T
        weights = affine_rbf_weights(points, queries)
        assert np.abs(weights).max() < 10
        np.testing.assert_allclose(weights @ points, queries, atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_points_give_bounded_weights(count):
    """Queries that the cloud spans are reproduced; one point or two leave the least-squares answer."""
    points = cloud(count)
    mix = np.full((1, count), 1 / count)
    weights = affine_rbf_weights(points, mix @ points)
    np.testing.assert_allclose(weights @ points, mix @ points, atol=1e-8)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-8)
    assert np.isfinite(affine_rbf_weights(points, QUERIES)).all()


def test_coincident_points_do_not_break():
    points = np.repeat(cloud(1), 6, axis=0)
    weights = affine_rbf_weights(points, points[:1])
    np.testing.assert_allclose(weights @ points, points[:1], atol=1e-9)


def test_coincident_points_share_a_weight():
    doubled = np.concatenate([cloud(20), cloud(20)[:7], cloud(20)[:3]])
    weights = affine_rbf_weights(doubled, QUERIES)
    np.testing.assert_allclose(weights @ doubled, QUERIES, atol=EXACT)
    np.testing.assert_allclose(weights[:, :3], weights[:, 20:23], atol=EXACT)
    np.testing.assert_allclose(weights[:, :3], weights[:, 27:], atol=EXACT)


def test_points_that_coincide_but_for_rounding():
    points = np.concatenate([cloud(30), cloud(30) * (1 + 1e-16)])
    points[30:, 0] = np.nextafter(points[:30, 0], 2)
    weights = affine_rbf_weights(points, QUERIES)
    np.testing.assert_allclose(weights @ points, QUERIES, atol=EXACT)
    np.testing.assert_allclose(
        weights[:, :30] + weights[:, 30:], affine_rbf_weights(cloud(30), QUERIES), atol=EXACT
    )
