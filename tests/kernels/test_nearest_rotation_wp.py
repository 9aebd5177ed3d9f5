"""Nearest rotations in Warp: those of the torch reference, whatever the covariance."""

import pytest
import torch

from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.kernels import nearest_rotation_wp
from soma_core.kernels.nearest_rotation_wp import nearest_rotation
from tests.bodies import randn
from tests.kernels.parity import DEVICES, DTYPES

SINGULAR = {
    "solid": (1, 0.5, 0.2),
    "flat": (1, 0.5, 0),
    "mirrored": (1, 0.5, -0.2),
    "sphere": (1, 1, 1),
    "slender": (1, 1e-3, 1e-3),
    "huge": (1e6, 5e5, 2e5),
    "tiny": (1e-9, 5e-10, 2e-10),
}
SAME = {torch.float32: 3e-4, torch.float64: 1e-10}
"""Radians: a slender cloud's turn about itself is known to its rounding only."""


def covariances(singular, count, dtype):
    left, right = (torch.linalg.qr(randn(count, 3, 3, seed=seed))[0] for seed in (1, 2))
    left, right = (basis * torch.linalg.det(basis)[:, None, None] for basis in (left, right))
    return (left @ torch.diag(torch.tensor(singular, dtype=torch.float64)) @ right.mT).to(dtype)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [1, 15, 33])
@pytest.mark.parametrize("kind", SINGULAR)
def test_the_twin_agrees(kind, count, dtype, device):
    given = covariances(SINGULAR[kind], count, dtype).to(device)
    found = nearest_rotation(given)
    torch.testing.assert_close(found, rotation_from_covariance(given), atol=SAME[dtype], rtol=0)
    eye = torch.eye(3, dtype=dtype, device=device).expand_as(found)
    torch.testing.assert_close(found @ found.mT, eye, atol=20 * torch.finfo(dtype).eps, rtol=0)
    assert (torch.linalg.det(found) > 0).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_usual_clouds_agree_to_rounding(dtype):
    given = randn(4, 50, 3, 3, seed=3, dtype=dtype)
    difference = (nearest_rotation(given) - rotation_from_covariance(given)).abs()
    assert difference.median() < 2 * torch.finfo(dtype).eps


@pytest.mark.parametrize("dtype", DTYPES)
def test_nothing_and_no_number_give_the_identity_as_in_the_reference(dtype):
    given = torch.zeros(3, 3, 3, dtype=dtype)
    given[1] = torch.nan
    given[2] = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=dtype))
    found = nearest_rotation(given)
    assert torch.equal(found[:2], torch.eye(3, dtype=dtype).expand(2, 3, 3))
    assert torch.isfinite(found).all()


def test_a_matrix_is_alike_in_any_company():
    given = randn(100, 3, 3, seed=4, dtype=torch.float32)
    order = torch.randperm(100, generator=torch.Generator().manual_seed(1))[:21]
    assert torch.equal(nearest_rotation(given[order]), nearest_rotation(given)[order])


def test_the_layout_of_a_gpu_gives_the_same(monkeypatch):
    given = randn(5, 3, 3, seed=4)
    expected = nearest_rotation(given)
    monkeypatch.setattr(nearest_rotation_wp, "lane_count", lambda tensor: 1)
    torch.testing.assert_close(nearest_rotation(given), expected, atol=1e-14, rtol=0)


def test_shapes_are_kept_and_views_are_read():
    given = randn(6, 4, 3, 3, seed=5)
    found = nearest_rotation(given.transpose(0, 1).mT)
    torch.testing.assert_close(found, nearest_rotation(given).transpose(0, 1).mT, atol=1e-12, rtol=0)
    assert nearest_rotation(given[:0]).shape == (0, 4, 3, 3)
