"""Moments of targets in Warp: those of the torch reference, for one identity and for one a frame."""

import pytest
import torch

from soma_core.inversion.moments import SkinMoments
from soma_core.kernels import frame_moments_wp, skin_moments_wp
from tests.bodies import randn
from tests.inversion.small_problem import synthetic
from tests.kernels.parity import DEVICES, DTYPES, quick

BATCHES = quick(1, 17, slow=[7, 8, 15, 16, 33])
SAME = {torch.float32: 1e-5, torch.float64: 1e-12}
"""Relative to the largest entry: some hundred terms a sum; the reference adds in float64."""
BODY = synthetic()


def moments(dtype, *, warp, device="cpu"):
    return SkinMoments(BODY.structure, BODY.rig, dtype=dtype, device=device, warp=warp)


def inputs(count, *, who=1, weighted=1, dtype=torch.float64, device="cpu"):
    identity, weights = BODY.identities(who, dtype=dtype), BODY.vertex_weights(weighted, dtype=dtype)
    offsets = BODY.animation(dtype).kinematics.local_offsets(identity.bind_world)
    vertices = BODY.posed(BODY.identities(1, dtype=dtype), *BODY.poses(count, dtype=dtype))
    identity = type(identity)(
        **{
            name: getattr(identity, name).to(device)
            for name in ("rest", "bind_world", "fitted_rest", "fitted_world")
        }
    )
    return vertices.to(device), identity, weights.to(device), offsets.to(device)


def assert_near(found, expected):
    bound = SAME[expected.dtype] * float(expected.abs().max())
    torch.testing.assert_close(found, expected, atol=bound, rtol=0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
def test_targets_of_one_identity(batch, dtype, device):
    vertices, identity, weights, offsets = inputs(batch, dtype=dtype, device=device)
    rest = moments(dtype, warp=False, device=device).rest(identity, weights, offsets)
    expected, origin = moments(dtype, warp=False, device=device).target(vertices, rest)
    found, its = moments(dtype, warp=True, device=device).target(vertices, rest)
    assert_near(found, expected)
    assert torch.equal(its, origin)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("each", ["identity", "weights", "both"])
def test_moments_of_frames_that_differ(each, batch, dtype, device):
    counts = {
        "who": 1 if each == "weights" else batch,
        "weighted": 1 if each == "identity" else batch,
    }
    given = inputs(batch, dtype=dtype, device=device, **counts)
    rest, target, origin = moments(dtype, warp=False, device=device).each(*given)
    found, its_target, its_origin = moments(dtype, warp=True, device=device).each(*given)
    assert_near(found.second, rest.second.expand_as(found.second))
    assert_near(found.own, rest.own.expand_as(found.own))
    assert_near(its_target, target)
    assert torch.equal(its_origin, origin)


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_targets_may_be_any_view(warp):
    vertices, identity, weights, offsets = inputs(5)
    run = moments(torch.float64, warp=warp)
    rest = run.rest(identity, weights, offsets)
    expected, _ = run.target(vertices, rest)
    strided = vertices.transpose(1, 2).contiguous().transpose(1, 2)
    found, _ = run.target(strided, rest)
    assert torch.equal(found, expected)
    found, _ = run.target(vertices.repeat_interleave(2, 0)[::2], rest)
    assert torch.equal(found, expected)


def test_the_layout_of_a_gpu_gives_the_same(monkeypatch):
    """One frame a group, as on CUDA, here on the CPU."""
    vertices, identity, weights, offsets = inputs(5, weighted=5)
    run = moments(torch.float64, warp=True)
    rest = run.rest(identity, weights[:1], offsets)
    expected = run.target(vertices, rest)
    each = run.each(vertices, identity, weights, offsets)
    for module in (skin_moments_wp, frame_moments_wp):
        monkeypatch.setattr(module, "lane_count", lambda tensor: 1)
    for found, one in zip(run.target(vertices, rest), expected, strict=True):
        assert_near(found, one)
    found = run.each(vertices, identity, weights, offsets)
    assert_near(found[0].second, each[0].second)
    assert_near(found[1], each[1])


def check_no_frame_at_all():
    vertices, identity, weights, offsets = inputs(1)
    run = moments(torch.float64, warp=True)
    target, origin = run.target(vertices[:0], run.rest(identity, weights, offsets))
    assert target.shape == (0, len(BODY.structure.joints), 3, 4)
    assert origin.shape == (0, 3)


def check_a_frame_of_nan_stays_alone(count):
    vertices, identity, weights, offsets = inputs(count)
    run = moments(torch.float64, warp=True)
    rest = run.rest(identity, weights, offsets)
    expected, _ = run.target(vertices, rest)
    vertices[2] = float("nan")
    found, _ = run.target(vertices, rest)
    others = [frame for frame in range(count) if frame != 2]
    assert torch.equal(found[others], expected[others])
    assert found[2].isnan().any()


def test_no_frame_at_all():
    check_no_frame_at_all()


def test_a_frame_of_nan_stays_alone():
    check_a_frame_of_nan_stays_alone(5)


def test_numbers_do_not_depend_on_the_seat_in_a_group():
    vertices, identity, weights, offsets = inputs(11)
    run = moments(torch.float64, warp=True)
    rest = run.rest(identity, weights, offsets)
    expected, _ = run.target(vertices, rest)
    order = torch.randperm(11, generator=torch.Generator().manual_seed(1))
    found, _ = run.target(vertices[order], rest)
    assert torch.equal(found, expected[order])
    noise = randn(11, seed=2)[:, None, None]
    moved, _ = run.target(vertices + 0 * noise, rest)
    assert torch.equal(moved, expected)
