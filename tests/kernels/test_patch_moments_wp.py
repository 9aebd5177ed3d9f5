"""Moments of targets by patches of the mesh: by the reference, on the CPU too."""

import pytest
import torch

from soma_core import PoseInversion, SomaLayer
from soma_core.inversion import moments as moments_module
from soma_core.kernels import patch_moments_wp
from tests.bodies import randn
from tests.kernels.parity import DEVICES, DTYPES
from tests.kernels.test_skin_moments_wp import (
    assert_near,
    check_a_frame_of_nan_stays_alone,
    check_no_frame_at_all,
    inputs,
    moments,
)


@pytest.fixture(autouse=True)
def _patched(monkeypatch):
    monkeypatch.setattr(moments_module, "in_patches", lambda tensor: True)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", [1, 7, 9, 33])
def test_it_agrees(batch, dtype, device):
    vertices, identity, weights, offsets = inputs(batch, dtype=dtype, device=device)
    rest = moments(dtype, warp=False, device=device).rest(identity, weights, offsets)
    expected, origin = moments(dtype, warp=False, device=device).target(vertices, rest)
    run = moments(dtype, warp=True, device=device)
    found, its = run.target(vertices, rest)
    assert_near(found, expected)
    assert torch.equal(its, origin)
    again, _ = run.target(vertices, rest)
    assert torch.equal(again, found)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_real_mesh(dtype, device):
    layer = SomaLayer("soma", lod="low", dtype=dtype, device=device)
    identity = layer.identity()
    vertices = layer.pose(identity, 0.3 * randn(9, 77, 3, seed=1, dtype=dtype).to(device)).vertices + 3
    found = []
    for kernels in ("torch", "warp"):
        model = PoseInversion(layer, kernels=kernels).model
        weights = torch.as_tensor(model.fitted, device=device).to(dtype)[None]
        found.append(model.moments.target(vertices, model.rest(identity, weights)))
    assert model.moments._patches.count > 10
    assert_near(found[1][0], found[0][0])
    assert torch.equal(found[1][1], found[0][1])


def test_parts_of_a_batch_give_the_same_bits(monkeypatch):
    vertices, identity, weights, offsets = inputs(43, dtype=torch.float32)
    run = moments(torch.float32, warp=True)
    rest = run.rest(identity, weights, offsets)
    expected, _ = run.target(vertices, rest)
    launches, launch = [], patch_moments_wp._launch
    monkeypatch.setattr(patch_moments_wp, "_launch", lambda *a: launches.append(len(a[3])) or launch(*a))
    monkeypatch.setattr(patch_moments_wp, "_SCRATCH", 4 * 12 * 18 * run._patches.list_count)
    found, _ = run.target(vertices, rest)
    assert torch.equal(found, expected)
    assert launches == [16, 16, 11]


def test_a_frame_of_nan_stays_alone():
    check_a_frame_of_nan_stays_alone(12)


def test_no_frame_at_all():
    check_no_frame_at_all()
