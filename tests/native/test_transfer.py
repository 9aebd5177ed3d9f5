"""Canonical vertices on a native topology: exact where the wrap lies on the mesh, whatever unit and axes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from soma_core import load_canonical
from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.native import NativeTransfer
from soma_core.obj import read_obj
from soma_core.plugin.errors import BackendError
from soma_core.plugin.registry import Registry

ROUNDING = 1e-9
"""Relative to the body: float64."""
OFF_THE_WRAP = 1.5
"""Millimetres: the toy's capsules are coarser than the canonical mesh that is laid on them."""
THERE_AND_BACK = 0.5
"""Millimetres on average, posed: two correspondences of a coarse stand-in mesh."""


@pytest.fixture(scope="module")
def toy():
    return NativeTransfer("toy", dtype=torch.float64)


@pytest.fixture(scope="module")
def toy_wrap(toy):
    """The toy's wrap as canonical vertices in metres."""
    wrap, _ = read_obj(toy.spec.wrap.wrap)
    x, y, z = 0.01 * wrap.T  # centimetres, +Z up, facing -Y
    return torch.as_tensor(np.stack((x, z, -y), 1))[None]


def test_the_wrap_itself_gives_the_native_mesh(toy, toy_wrap):
    native, triangles = read_obj(toy.spec.wrap.native)
    found = toy(toy_wrap)[0].numpy()
    distance = 10 * np.linalg.norm(found - native, axis=1)  # centimetres to millimetres
    assert distance[toy.covered.numpy()].max() < OFF_THE_WRAP
    assert toy.count == len(native)
    np.testing.assert_array_equal(toy.triangles.numpy(), triangles)


def test_it_commutes_with_similarities(toy, toy_wrap):
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())[0]
    turn = turn * torch.linalg.det(turn)
    shift = torch.tensor([3.0, -1.0, 2.0]).double()
    frame = 0.01 * toy.frame  # canonical to native axes
    moved = toy(0.6 * toy_wrap @ turn.T + shift)
    expected = 0.6 * toy(toy_wrap) @ frame @ turn.T @ frame.T + 100 * shift @ frame.T
    torch.testing.assert_close(moved, expected, atol=100 * ROUNDING, rtol=0)


def test_it_is_differentiable(toy, toy_wrap):
    wave = torch.sin(5 * toy_wrap.roll(1, -1))
    vertices = toy_wrap.clone().requires_grad_()
    (slope,) = torch.autograd.grad(toy(vertices).square().mean(), vertices)
    ends = [toy(toy_wrap + sign * 1e-6 * wave).square().mean() for sign in (1, -1)]
    torch.testing.assert_close((slope * wave).sum(), (ends[0] - ends[1]) / 2e-6, rtol=1e-6, atol=0)


def test_low_lod_is_taken(toy, toy_wrap):
    low = NativeTransfer("toy", lod="low", dtype=torch.float64)
    ids = torch.tensor(load_canonical("low")[0].mid_ids)
    both = toy.covered & low.covered
    distance = 10 * (low(toy_wrap[:, ids]) - toy(toy_wrap)).norm(dim=-1)[0]
    assert float(distance[both].mean()) < OFF_THE_WRAP


def test_native_and_back_is_close(fit, layer, vertices):
    back = PoseInversion(layer).canonical(fit.transfer(vertices), "native")
    outside = np.setdiff1d(np.arange(layer.mesh.vertex_count), layer.mesh.face_interior)
    distance = 1e3 * (back - vertices).norm(dim=-1)[:, outside]
    assert float(distance.mean()) < THERE_AND_BACK


def test_what_the_wrap_does_not_reach_is_said(fit):
    covered = fit.transfer.covered
    # The stand-in has its own mouth and eye bags, where the canonical mesh is filled.
    assert 0.9 < float(covered.float().mean()) < 1


def test_shares_are_the_canonical_vertices_that_each_stands_for(fit, layer):
    shares, covered = fit.transfer.shares, fit.transfer.covered
    assert bool((shares[covered] > 0).all())
    assert not shares[~covered].any()
    seen = layer.mesh.vertex_count - len(layer.mesh.face_interior)
    assert 0.9 < float(shares.sum()) / seen < 1.05


def test_refusals(toy, toy_wrap, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="backend: got soma, expected a backend with a topology of its own"):
        NativeTransfer("soma")
    with pytest.raises(InputError, match="lod: got 'xlo'"):
        NativeTransfer("toy", lod="xlo")
    with pytest.raises(InputError, match=r"vertices: got \(1, 7, 3\), expected \(frames, 18056, 3\)"):
        toy(toy_wrap[:, :7])
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    with pytest.raises(BackendError, match="garment"):
        NativeTransfer("garment", registry=Registry())
