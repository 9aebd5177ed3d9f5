"""The Warp solver takes the steps of the torch reference, frame by frame, in any layout."""

import pytest
import torch

from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.problem import Pose
from soma_core.kernels import gauss_newton_wp
from tests.bodies import randn
from tests.inversion.small_problem import pose_about, real
from tests.kernels.parity import DEVICES, DTYPES

BATCHES = [1, 15, 16, 17, 33]
"""Below, at and above the lanes of one group in float32, and of two and four in float64."""
AWAY = {torch.float32: 0.03, torch.float64: 0.2}
"""How far starts are from the targets [rad]; float32 steps carry a hundredth of their length as rounding."""
VERTICES_M = {torch.float32: 1e-3, torch.float64: 1e-9}
"""Where both twins are under way: rounding times the condition of fingers, not that of the fit's minimum."""


def targets(count, *, who=1, dtype=torch.float64, device="cpu"):
    """`R`, moments, origin and identity of noisy bodies, and poses to start from."""
    body = real()
    identity, weights = body.identities(who), body.vertex_weights(1)
    rotations, hips = body.poses(count)
    vertices = body.posed(identity, rotations, hips)
    vertices = vertices + 0.005 * randn(*vertices.shape, seed=30)
    rest = body.rest(identity, weights)
    target, origin = body.moments().target(vertices, rest)
    away, _ = body.poses(count, spread=AWAY[dtype], seed=60)
    start = pose_about(away @ rotations, hips + AWAY[dtype], origin)

    def cast(value):
        moved = {
            name: part.to(device, dtype if part.is_floating_point() else None)
            for name, part in vars(value).items()
        }
        return type(value)(**moved)

    return target.to(device, dtype), cast(rest), cast(start), (identity, origin)


def both(given, count, *, device="cpu", **options):
    """Poses after `count` steps, by the reference and by the twin."""
    target, rest, start, _ = given
    kind = {"dtype": target.dtype, "device": device}
    solvers = (GaussNewton(real().structure, warp=warp, **kind) for warp in (False, True))
    return [solver(target, rest, start, iterations=count, **options) for solver in solvers]


def reached(given, pose):
    identity, origin = given[3]
    rotations = pose.relative[:, 1:].double().cpu()
    return real().posed(identity, rotations, pose.translation.double().cpu() + origin)


def assert_same(given, expected, found):
    dtype = given[0].dtype
    assert found.relative.dtype == found.translation.dtype == dtype
    assert found.relative.shape == expected.relative.shape
    off = reached(given, found) - reached(given, expected)
    assert off.abs().max() < VERTICES_M[dtype]
    # In float32 a step at the limit of the numbers may look better to one and worse to the other.
    assert (found.accepted - expected.accepted).abs().max() <= (dtype == torch.float32)
    bound = {torch.float32: 1e-3, torch.float64: 1e-8}[dtype]
    torch.testing.assert_close(found.last_change, expected.last_change, rtol=bound, atol=bound * 1e-2)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shared", [True, False], ids=["one identity", "one a frame"])
def test_every_step_is_that_of_the_reference(shared, dtype, device):
    given = targets(3, who=1 if shared else 3, dtype=dtype, device=device)
    for count in range(7):
        assert_same(given, *both(given, count, device=device))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("shared", [True, False], ids=["one identity", "one a frame"])
def test_every_batch_size(shared, batch, dtype, device):
    given = targets(batch, who=1 if shared else batch, dtype=dtype, device=device)
    assert_same(given, *both(given, 2, device=device))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_tolerance_stops_the_same_frames_at_the_same_steps(dtype):
    given = targets(9, dtype=dtype)
    expected, found = both(given, 12, tolerance=1e-4)
    assert len(expected.accepted.unique()) > 1
    assert_same(given, expected, found)


@pytest.mark.parametrize(("shared", "batch"), [(True, 5), (False, 3)], ids=["one identity", "one a frame"])
def test_the_layout_of_a_gpu_takes_the_same_steps(shared, batch, monkeypatch):
    """One frame a group, as on CUDA, here on the CPU."""
    given = targets(batch, who=1 if shared else batch)
    _, expected = both(given, 5)
    monkeypatch.setattr(gauss_newton_wp, "lane_count", lambda tensor: 1)
    _, found = both(given, 5)
    assert_same(given, expected, found)


def test_no_frame_at_all():
    given = targets(2)
    target, rest, start, _ = given
    none = Pose(**{name: part[:0] for name, part in vars(start).items()})
    solver = GaussNewton(real().structure, dtype=torch.float64, device="cpu", warp=True)
    found = solver(target[:0], rest, none, iterations=3)
    assert found.relative.shape == (0, *start.relative.shape[1:])
    assert found.accepted.shape == (0,)


def test_what_is_given_stays_as_it_was():
    given = targets(3)
    before = [part.clone() for part in (given[0], given[2].relative, given[2].translation)]
    both(given, 3)
    after = given[0], given[2].relative, given[2].translation
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))


def test_the_same_call_twice_gives_the_same_bits():
    """Working memory is fresh for every call."""
    given = targets(17)
    _, first = both(given, 4)
    _, second = both(given, 4)
    assert torch.equal(first.relative, second.relative)
    assert torch.equal(first.last_change, second.last_change)
