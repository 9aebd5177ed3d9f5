"""The residual by patches of the mesh: by the reference, on the CPU too, where its blocks are one thread."""

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core import PoseInversion, SomaLayer
from soma_core.geometry.sparse import SparseRows
from soma_core.kernels import model_residual, patch_residual_wp
from soma_core.kernels._patch_text import PATCH_VERTICES
from soma_core.kernels.model_residual import ModelResidual
from soma_core.kernels.residual_patches import ResidualPatches
from tests.bodies import randn
from tests.kernels.parity import DEVICES, DTYPES, quick
from tests.kernels.test_model_residual_wp import (
    ACTIVATIONS,
    JOINTS,
    VERTICES,
    assert_near,
    cases,
    check_twin,
    inputs,
    matrices,
    model,
)

BATCHES = quick(1, 9, slow=[7, 33])
"""Frames by themselves, and in groups of which the last is not full."""


@pytest.fixture(autouse=True)
def _patched(monkeypatch):
    monkeypatch.setattr(model_residual, "in_patches", lambda tensor: True)


def by_patches(run) -> bool:
    return run._patches is not None and run._patches.fits


@cases(BATCHES)
def test_it_agrees(clipped, correctives, each, batch, dtype, device):
    assert by_patches(check_twin(clipped, correctives, each, batch, dtype, device, exact=False))


def random_mesh(seed, vertices, joints, activations, *, dtype, device):
    """Vertices on a few transforms and activations each; some of these have none."""
    random = np.random.default_rng(seed)

    def few(rows, columns, share, near):
        at = np.arange(rows)[:, None] * columns / rows
        known = np.abs(np.arange(columns) - at) < near
        return random.standard_normal((rows, columns)) * known * (random.random((rows, columns)) < share)

    skin = np.abs(few(vertices, joints, 0.5, 6))
    skin[:, 0] += 0.1
    moves = few(vertices, activations, 0.2, 60).repeat(3, 0) * random.standard_normal((3 * vertices, 1))
    kind = {"dtype": dtype, "device": device}
    skin = SparseRows(scipy.sparse.csr_array(skin / skin.sum(1, keepdims=True)), **kind)
    moves = SparseRows(scipy.sparse.csr_array(0.01 * moves), **kind)
    return [ModelResidual(skin.csr, moves, warp=warp, **kind) for warp in (False, True)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_many_patches(dtype, device):
    vertices, joints, activations, count = 1300, 30, 300, 11
    one, other = random_mesh(3, vertices, joints, activations, dtype=dtype, device=device)
    given = {
        "rest": randn(1, vertices, 3, seed=2),
        "weights": randn(1, vertices, seed=1).abs() * (torch.arange(vertices) % 200 < 120),
        "transforms": 0.6 * randn(count, joints + 2, 3, 4, seed=3),  # two more than the skin hangs on
        "activations": randn(count, activations, seed=4),
        "scale": 1 + 0.1 * randn(count, seed=6),
        "targets": 0.3 * randn(count, vertices, 3, seed=5),
        "origin": 0.1 * randn(count, 3, seed=7),
        "bound": 0.5 + randn(count, seed=8).abs(),
    }
    given = {name: one.to(device, dtype) for name, one in given.items()}
    expected, found = one(**given, distances=True), other(**given, distances=True)
    assert other._patches.patches.count > 10
    assert_near(found, expected)
    assert not found.forces[:, joints:].any()
    assert_near(other(**given, distances=True), found, exact=True)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("lod", ["low", pytest.param("mid", marks=pytest.mark.slow)])
def test_the_real_mesh(lod, dtype, device):
    """Poses of a layer and targets beside them, what an inversion asks for."""
    layer = SomaLayer("soma", lod=lod, dtype=dtype, device=device)
    identity = layer.identity()
    count = 9
    rotations = 0.3 * randn(count, 77, 3, seed=1, dtype=dtype).to(device)
    asked, calls = [], ModelResidual.forward

    def forward(self, *given, **keywords):
        asked.append((self, given))
        return calls(self, *given, **keywords)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ModelResidual, "forward", forward)
        PoseInversion(layer, iterations=1)(layer.pose(identity, rotations).vertices, identity)
    run, given = next(one for one in asked if one[0].dtype == dtype)
    given = list(given)  # targets a hand away, so that float32 has digits to compare
    given[5] = given[5] + 0.1 * randn(*given[5].shape, seed=2, dtype=dtype).to(device)
    assert by_patches(run)
    skin, moves = (SparseRows(one, dtype=dtype, device=device) for one in run._matrices)
    other = ModelResidual(skin.csr, moves, dtype=dtype, device=device)
    assert_near(run(*given, distances=True), other(*given, distances=True))


def test_forces_and_pull_are_half_the_slope():
    given = inputs(9, bodies=9, clipped=True)
    run = model(torch.float64, warp=True)
    found = run(**given)
    for name, slope in (("transforms", found.forces), ("activations", found.pull)):
        step = 1e-6 * randn(*given[name].shape, seed=9)
        up, down = (run(**given | {name: given[name] + sign * step}).energy for sign in (1, -1))
        torch.testing.assert_close((up - down) / 4, (step * slope).flatten(1).sum(1), rtol=1e-6, atol=0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [5, 40])
def test_repeated_calls_give_the_same_bits(count, device):
    given = inputs(count, torch.float32, weighted=count, clipped=True, device=device)
    run = model(torch.float32, warp=True, device=device)
    expected = run(**given, distances=True)
    for _ in range(5):
        assert_near(run(**given, distances=True), expected, exact=True)


@pytest.mark.parametrize("device", DEVICES)
def test_parts_of_a_batch_give_the_same_bits(device, monkeypatch):
    given = inputs(43, torch.float32, bodies=43, clipped=True, device=device)
    run = model(torch.float32, warp=True, device=device)
    expected = run(**given, distances=True)
    launches, launch = [], patch_residual_wp._launch
    monkeypatch.setattr(patch_residual_wp, "_launch", lambda *a: launches.append(len(a[1][5])) or launch(*a))
    monkeypatch.setattr(patch_residual_wp, "_SCRATCH", 4 * 18 * run._patches.cell_count)
    assert_near(run(**given, distances=True), expected, exact=True)
    assert launches == [16, 16, 11]


def test_a_frame_is_alike_in_any_company():
    given = inputs(50, torch.float32, bodies=50, clipped=True)
    run = model(torch.float32, warp=True)
    expected = run(**given, distances=True)
    order = torch.randperm(50, generator=torch.Generator().manual_seed(1))
    for count in (3, 13):
        few = order[:count]
        some = {name: one if len(one) == 1 else one[few] for name, one in given.items()}
        assert_near(run(**some, distances=True), [one[few] for one in expected])


def test_a_frame_of_nan_stays_alone():
    given = inputs(12)
    run = model(torch.float64, warp=True)
    expected = run(**given)
    given["targets"] = given["targets"].clone()
    given["targets"][2] = torch.nan
    found = run(**given)
    others = [frame for frame in range(12) if frame != 2]
    assert_near([one if one is None else one[others] for one in found],
                [one if one is None else one[others] for one in expected], exact=True)  # fmt: skip
    assert found.energy[2].isnan()


def test_arguments_may_be_any_view():
    given = inputs(12)
    run = model(torch.float64, warp=True)
    given["scale"] = given["scale"][:1].expand(12)
    expected = run(**given | {"scale": given["scale"].contiguous()})
    given["targets"] = given["targets"].transpose(1, 2).contiguous().transpose(1, 2)
    given["transforms"] = given["transforms"].repeat_interleave(2, 0)[::2]
    assert_near(run(**given), expected, exact=True)


def test_no_frame_at_all():
    given = {
        name: one if name in ("rest", "weights") or one is None else one[:0]
        for name, one in inputs(1).items()
    }
    energy, forces, pull, distances = model(torch.float64, warp=True)(**given, distances=True)
    assert energy.shape == (0,)
    assert forces.shape == (0, JOINTS, 3, 4)
    assert pull.shape == (0, ACTIVATIONS)
    assert distances.shape == (0, VERTICES)


def test_a_mesh_that_fits_no_patch_goes_the_other_way():
    random = np.random.default_rng(0)
    skin = SparseRows(scipy.sparse.csr_array(random.random((30, 60))), dtype=torch.float64, device="cpu")
    one, other = (
        ModelResidual(skin.csr, None, warp=warp, dtype=torch.float64, device="cpu") for warp in (False, True)
    )
    given = randn(1, 30, 3, seed=1), randn(1, 30, seed=2).abs(), randn(3, 60, 3, 4, seed=3)
    given = *given, None, None, randn(3, 30, 3, seed=4), randn(3, 3, seed=5)
    assert_near(other(*given), one(*given))
    assert not by_patches(other)


def test_tables_hold_the_whole_mesh():
    """Each entry of both matrices once, in a list of its patch; each cell in one item's list."""
    skin, moves = matrices()
    tables = ResidualPatches(skin, moves, dtype=torch.float64, device="cpu")
    assert tables.patches.bounds.tolist() == [0, PATCH_VERTICES, VERTICES]
    starts, items = tables.starts.numpy(), tables.items.numpy()
    assert len(items) == 2 + JOINTS + ACTIVATIONS
    runs = starts[3 : 4 + starts[2]]
    assert np.diff(runs).max() <= 32
    assert runs[-1] == skin.nnz
    values = tables.values.numpy()
    np.testing.assert_allclose(np.sort(values[: skin.nnz]), np.sort(skin.data))
    moved = values[skin.nnz :]
    np.testing.assert_allclose(np.sort(moved[moved != 0]), np.sort(moves.data))
    cells = tables.cells.numpy()
    wide = (items[1] <= np.arange(len(cells))) & (np.arange(len(cells)) < items[1 + JOINTS])
    covered = np.concatenate([cells[~wide], (cells[wide][:, None] + np.arange(12)).ravel()])
    assert np.sort(covered).tolist() == list(range(tables.cell_count))


def test_an_inversion_finds_the_same_poses(monkeypatch):
    layer = SomaLayer("soma", lod="low")
    identity = layer.identity()
    vertices = layer.pose(identity, 0.3 * randn(5, 77, 3, seed=1, dtype=torch.float32)).vertices
    found = PoseInversion(layer)(vertices, identity)
    monkeypatch.setattr(model_residual, "in_patches", lambda tensor: False)
    expected = PoseInversion(layer)(vertices, identity)
    errors = [
        (layer.pose(identity, one.rotations, one.translation).vertices - vertices).norm(dim=-1)
        for one in (found, expected)
    ]
    assert float((errors[0] - errors[1]).abs().max()) < 5e-6
