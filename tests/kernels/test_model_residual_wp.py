"""The whole forward model against targets: reference by the definition, Warp twin by the reference."""

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core.geometry.sparse import SparseRows
from soma_core.kernels import model_residual_wp
from soma_core.kernels.model_residual import ModelResidual
from tests.bodies import randn
from tests.kernels.parity import DEVICES, DTYPES, quick

VERTICES, JOINTS, ACTIVATIONS = 150, 9, 23
"""Two tiles and a part of one."""
BATCHES = quick(1, 17, slow=[7, 8, 15, 16, 33, 150])
SAME = {torch.float32: 1e-5, torch.float64: 1e-13}
"""Relative to the largest entry: both add some hundred terms in other orders."""


def matrices():
    random = np.random.default_rng(0)
    skin = random.random((VERTICES, JOINTS)) * (random.random((VERTICES, JOINTS)) < 0.4)
    skin[:, 0] += 0.1
    skin = scipy.sparse.csr_array(skin / skin.sum(1, keepdims=True))
    some = (random.random((VERTICES, 1, ACTIVATIONS)) < 0.3).repeat(3, 1)
    some[40:100] = False
    moves = 0.1 * random.standard_normal((VERTICES, 3, ACTIVATIONS)) * some
    return skin, scipy.sparse.csr_array(moves.reshape(3 * VERTICES, ACTIVATIONS))


def model(dtype, *, warp, correctives=True, device="cpu"):
    kind = {"dtype": dtype, "device": device}
    skin, moves = (SparseRows(one, **kind) for one in matrices())
    return ModelResidual(skin.csr, moves if correctives else None, warp=warp, **kind)


def inputs(
    count, dtype=torch.float64, *, bodies=1, weighted=1, correctives=True, clipped=False, device="cpu"
):
    weights = randn(weighted, VERTICES, seed=1, dtype=dtype).abs()
    weights[:, ::10] = 0
    targets = 0.3 * randn(count, VERTICES, 3, seed=5, dtype=dtype) + 5
    targets[:, ::20] = torch.inf
    targets[:, 10::20] = torch.nan
    given = {
        "rest": 0.3 * randn(bodies, VERTICES, 3, seed=2, dtype=dtype),
        "weights": weights,
        "transforms": 0.6 * randn(count, JOINTS, 3, 4, seed=3, dtype=dtype),
        "activations": randn(count, ACTIVATIONS, seed=4, dtype=dtype) if correctives else None,
        "scale": 1 + 0.1 * randn(count, seed=6, dtype=dtype) if correctives else None,
        "targets": targets,
        "origin": 5 + 0.1 * randn(count, 3, seed=7, dtype=dtype),
        "bound": 0.2 + 0.2 * randn(count, seed=8, dtype=dtype).abs() if clipped else None,
    }
    return {name: None if one is None else one.to(device) for name, one in given.items()}


def assert_near(found, expected, *, exact=False):
    for ours, theirs in zip(found, expected, strict=True):
        assert (ours is None) == (theirs is None)
        if theirs is None:
            continue
        known = theirs.isfinite()
        assert torch.equal(known, ours.isfinite())
        bound = 0.0 if exact else SAME[theirs.dtype] * float(theirs[known].abs().max())
        torch.testing.assert_close(ours[known], theirs[known], atol=bound, rtol=0)


def cases(batches):
    """Decorates a test of all kinds of inputs."""
    lists = {
        "device": DEVICES, "dtype": DTYPES, "batch": batches, "each": ["", "rest", "weights"],
        "correctives": [False, True], "clipped": [False, True],
    }  # fmt: skip

    def decorated(test):
        for name, values in lists.items():
            test = pytest.mark.parametrize(name, values)(test)
        return test

    return decorated


def check_twin(clipped, correctives, each, batch, dtype, device, *, exact):
    """The twin; it agrees with the reference, and with itself where less is asked, to the bit if `exact`."""
    given = inputs(
        batch, dtype, bodies=batch if each == "rest" else 1, weighted=batch if each == "weights" else 1,
        correctives=correctives, clipped=clipped, device=device,
    )  # fmt: skip
    one, other = (model(dtype, warp=warp, correctives=correctives, device=device) for warp in (False, True))
    expected, found = one(**given, distances=True), other(**given, distances=True)
    assert_near(found, expected)
    for distances in (False, True):
        less = other(**given, gradient=False, distances=distances)
        assert_near(less[:1], found[:1], exact=exact)
        assert less.forces is less.pull is None
        assert_near(less[3:], found[3:] if distances else [None])
    assert_near(other(**given)[:3], found[:3], exact=exact)
    return other


@cases(BATCHES)
def test_the_twin_agrees(clipped, correctives, each, batch, dtype, device):
    check_twin(clipped, correctives, each, batch, dtype, device, exact=True)


@pytest.mark.parametrize("clipped", [False, True], ids=["squares", "clipped"])
def test_forces_and_pull_are_half_the_slope(clipped):
    given = inputs(3, bodies=3, clipped=clipped)
    run = model(torch.float64, warp=True)
    found = run(**given)
    for name, slope in (("transforms", found.forces), ("activations", found.pull)):
        step = 1e-6 * randn(*given[name].shape, seed=9)
        up, down = (run(**given | {name: given[name] + sign * step}).energy for sign in (1, -1))
        torch.testing.assert_close((up - down) / 4, (step * slope).flatten(1).sum(1), rtol=1e-6, atol=0)


def test_the_definition():
    given = inputs(4)
    skin, moves = (torch.tensor(one.toarray()) for one in matrices())
    x = given["rest"] + (given["scale"][:, None] * (given["activations"] @ moves.T)).view(4, VERTICES, 3)
    posed = torch.einsum(
        "vt,ftij,fvj->fvi", skin, given["transforms"], torch.nn.functional.pad(x, (0, 1), value=1)
    )
    distance = (posed + given["origin"][:, None] - given["targets"]).norm(dim=-1)
    found = model(torch.float64, warp=False)(**given, distances=True)
    known = distance.isfinite()
    torch.testing.assert_close(found.distances[known], distance[known], rtol=1e-12, atol=1e-12)
    energy = (torch.where(known, distance, 0.0).square() * given["weights"]).sum(1)
    torch.testing.assert_close(found.energy, energy)


def test_a_frame_is_alike_in_any_company_and_any_number_of_threads():
    given = inputs(150, torch.float32, bodies=150, clipped=True)
    run = model(torch.float32, warp=True)
    expected = run(**given, distances=True)
    order = torch.randperm(150, generator=torch.Generator().manual_seed(1))[:37]
    few = {name: one if len(one) == 1 else one[order] for name, one in given.items()}
    assert_near(run(**few, distances=True), [one[order] for one in expected], exact=True)
    threads = torch.get_num_threads()
    torch.set_num_threads(1 if threads > 1 else 2)
    try:
        assert_near(run(**given, distances=True), expected, exact=True)
    finally:
        torch.set_num_threads(threads)


def test_a_frame_of_nan_stays_alone():
    given = inputs(5)
    run = model(torch.float64, warp=True)
    expected = run(**given)
    given["targets"] = given["targets"].clone()
    given["targets"][2] = torch.nan
    found = run(**given)
    others = [0, 1, 3, 4]
    assert_near([one if one is None else one[others] for one in found],
                [one if one is None else one[others] for one in expected], exact=True)  # fmt: skip
    assert found.energy[2].isnan()


@pytest.mark.parametrize("lanes", [1, 4, 32])
def test_other_layouts_give_the_same(lanes, monkeypatch):
    """One frame a group as on a GPU, vectors of half a register and of two."""
    given = inputs(35, clipped=True)
    run = model(torch.float64, warp=True)
    expected = run(**given, distances=True)
    monkeypatch.setattr(model_residual_wp, "lane_count", lambda tensor: lanes)
    assert_near(run(**given, distances=True), expected)


def test_arguments_may_be_any_view():
    given = inputs(5)
    run = model(torch.float64, warp=True)
    expected = run(**given)
    given["targets"] = given["targets"].transpose(1, 2).contiguous().transpose(1, 2)
    given["transforms"] = given["transforms"].repeat_interleave(2, 0)[::2]
    given["scale"] = given["scale"][:1].expand(5)
    expected = run(**given | {"scale": given["scale"].contiguous()})
    assert_near(run(**given), expected, exact=True)


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_no_frame_at_all(warp):
    given = {
        name: one if name in ("rest", "weights") or one is None else one[:0]
        for name, one in inputs(1).items()
    }
    energy, forces, pull, distances = model(torch.float64, warp=warp)(**given, distances=True)
    assert energy.shape == (0,)
    assert forces.shape == (0, JOINTS, 3, 4)
    assert pull.shape == (0, ACTIVATIONS)
    assert distances.shape == (0, VERTICES)


def test_sums_of_many_vertices_lose_nothing():
    """In float32, an energy of 18,056 vertices to a part in a million."""
    count = 18056
    skin = scipy.sparse.csr_array(np.ones((count, 1)))
    kind = {"dtype": torch.float32, "device": "cpu"}
    run = ModelResidual(SparseRows(skin, **kind).csr, None, warp=True, **kind)
    rest, targets = (randn(1, count, 3, seed=seed, dtype=torch.float32) for seed in (1, 2))
    eye = torch.eye(3, 4)[None, None]
    found = run(rest, torch.ones(1, count), eye, None, None, targets, torch.zeros(1, 3)).energy
    expected = (rest.double() - targets.double()).square().sum()
    assert abs(float(found) / float(expected) - 1) < 1e-6
