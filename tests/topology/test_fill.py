"""Filled regions: exact for affine images, smooth at the seam, refused where they cannot be determined."""

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.topology.fill import FillOperator, build_fill
from tests.bodies import CPU, randn, tiny_canonical

EXACT_M = 1e-12
"""float64 rounding on a body of two metres."""
MESH, _ = tiny_canonical()
BAGS = MESH.face_interior.astype(np.int64)
JITTER_M = 1e-3
"""Large against rounding, small against an edge."""


@pytest.fixture(scope="module")
def regions():
    return build_fill(MESH.vertices, MESH.triangles, BAGS)


@pytest.fixture(scope="module")
def fill(regions):
    return FillOperator(regions, dtype=torch.float64, device=CPU)


def applied(fill, vertices):
    """Fill (v, 3) vertices whose free rows hold rubbish."""
    spoilt = torch.as_tensor(vertices).clone()
    spoilt[torch.as_tensor(BAGS)] = 1e6
    return fill(spoilt).numpy()


def test_one_region_for_each_bag(regions):
    assert len(regions) == 3
    free = np.concatenate([region.free for region in regions])
    np.testing.assert_array_equal(np.sort(free), BAGS)
    for region in regions:
        assert not np.isin(region.around, BAGS).any()
        assert np.isin(region.ring, region.around).all()


def test_ring_is_the_first_ring_of_neighbours(regions):
    edges = np.concatenate([MESH.triangles[:, [0, 1]], MESH.triangles[:, [1, 2]], MESH.triangles[:, [2, 0]]])
    for region in regions:
        touching = np.isin(edges, region.free)
        outside = edges[touching.any(1) & ~touching.all(1)]
        expected = np.setdiff1d(np.unique(outside), region.free)
        np.testing.assert_array_equal(np.sort(region.ring), expected)


def test_harmonic_weights_are_an_average(regions):
    for region in regions:
        np.testing.assert_allclose(region.harmonic.sum(1), 1, atol=1e-10)
        assert region.harmonic.min() > -1e-10  # clamped cotangents: the maximum principle holds


def test_the_template_fills_itself(fill):
    np.testing.assert_allclose(applied(fill, MESH.vertices), MESH.vertices, atol=EXACT_M)


@pytest.mark.parametrize("seed", range(3))
def test_affine_images_are_exact(fill, seed):
    linear, shift = randn(3, 3, seed=seed).numpy(), randn(3, seed=10 + seed).numpy()
    image = MESH.vertices @ linear.T + shift
    np.testing.assert_allclose(applied(fill, image), image, atol=10 * EXACT_M)


def test_depth_scales_with_the_head(fill):
    """The defect of differential coordinates: a head of half the size keeps an adult's bag."""
    small = applied(fill, 0.5 * MESH.vertices)
    np.testing.assert_allclose(small[BAGS], 0.5 * MESH.vertices[BAGS], atol=EXACT_M)


def test_linear_in_the_surroundings(fill):
    a, b = randn(MESH.vertex_count, 2, seed=1), randn(MESH.vertex_count, 2, seed=2)
    torch.testing.assert_close(fill(2 * a - 3 * b), 2 * fill(a) - 3 * fill(b), atol=1e-10, rtol=0)


def test_only_free_rows_change_and_free_rows_are_not_read(fill):
    given = randn(MESH.vertex_count, 4, seed=3)
    kept = given.clone()
    filled = fill(given)
    assert torch.equal(given, kept)
    covered = np.setdiff1d(np.arange(MESH.vertex_count), BAGS)
    assert torch.equal(filled[covered], given[covered])
    spoilt = given.clone()
    spoilt[torch.as_tensor(BAGS)] = torch.nan
    torch.testing.assert_close(fill(spoilt), filled)


def test_a_smooth_change_of_the_head_is_followed(fill):
    """Not affine: the bags follow a smooth warp to a fraction of how far it moves them."""
    x, y, z = MESH.vertices.T
    warp = np.stack([0.03 * np.sin(4 * y), 0.03 * z, 0.02 * np.cos(6 * x + 2 * y)], 1)
    filled = applied(fill, MESH.vertices + warp)
    miss = np.linalg.norm(filled - MESH.vertices - warp, axis=1)[BAGS]
    assert miss.max() < 0.5 * np.linalg.norm(warp, axis=1)[BAGS].max()


def test_gradcheck(fill):
    assert torch.autograd.gradcheck(
        lambda part: fill(part.repeat(1, 1))[BAGS].sum(1),
        randn(MESH.vertex_count, 1, seed=4).requires_grad_(),
    )


def test_nothing_to_fill():
    assert build_fill(MESH.vertices, MESH.triangles, np.empty(0, np.int64)) == ()
    fill = FillOperator((), dtype=torch.float64, device=CPU)
    given = randn(5, 2)
    assert torch.equal(fill(given), given)
    assert len(fill.free_vertices) == 0


def test_unit_and_frame_of_the_template_do_not_matter():
    """On a template in general position: where opposite right angles cancel, as they do on the plain one, the
    rounding of a processor decides whether an edge has a weight at all."""
    template = MESH.vertices + JITTER_M * randn(MESH.vertex_count, 3, seed=6).numpy()
    regions = build_fill(template, MESH.triangles, BAGS)
    moved = build_fill(100 * template[:, [2, 0, 1]] + 5, MESH.triangles, BAGS)
    for region, other in zip(regions, moved, strict=True):
        expected = region.lift @ region.fit
        np.testing.assert_allclose(other.lift @ other.fit, expected, atol=EXACT_M)
        np.testing.assert_allclose(other.harmonic, region.harmonic, atol=EXACT_M)


def test_a_region_without_neighbours_is_refused():
    text = rf"fill_segments: got a region of {MESH.vertex_count} vertices with no neighbour"
    with pytest.raises(InputError, match=text):
        build_fill(MESH.vertices, MESH.triangles, np.arange(MESH.vertex_count))


def test_flat_surroundings_are_refused():
    flat = MESH.vertices * [1, 1, 0.001]
    with pytest.raises(
        InputError, match=r"fill_segments: got flat surroundings \(\d+ vertices\).*at least 1%"
    ):
        build_fill(flat, MESH.triangles, BAGS)
