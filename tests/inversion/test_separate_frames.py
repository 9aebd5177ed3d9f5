"""The layer as shipped: a fit is the same to the bit, whatever frames are beside it or threads run it."""

from dataclasses import fields

import pytest
import torch

from soma_core.inversion import PoseInversion, fit
from soma_core.inversion.problem import part_of
from soma_core.layer import SomaLayer
from tests.bodies import randn

FRAMES = 11
"""More than one group of SIMD lanes, and no multiple of one."""


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low")


@pytest.fixture(scope="module")
def identity(layer):
    return layer.identity({"shape": randn(1, 16, seed=1, dtype=torch.float32)})


@pytest.fixture(scope="module")
def targets(layer, identity):
    """Frames at rest, near, far, with a straight twisted arm, noisy, and one that cannot be used."""
    vectors = (torch.linspace(0, 0.6, FRAMES)[:, None, None] * randn(FRAMES, 77, 3, seed=2)).float()
    vectors[3] = 0
    vectors[3, layer.joint_names.index("LeftHand"), 0] = 2.8
    hips = (0.3 * randn(FRAMES, 3, seed=3)).float()
    with torch.no_grad():
        vertices = layer.pose(identity, vectors, hips).vertices
    vertices[7:] += 0.005 * randn(*vertices[7:].shape, seed=4).float()
    vertices[5] = torch.nan
    return vertices


@pytest.fixture(scope="module")
def inversion(layer):
    return PoseInversion(layer)


@pytest.fixture(scope="module")
def whole(inversion, targets, identity):
    return inversion(targets, identity)


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def assert_same(found, expected):
    """Bit for bit, all of the result."""
    for field in fields(found):
        mine, theirs = getattr(found, field.name), getattr(expected, field.name)
        assert (mine is None) == (theirs is None)
        assert mine is None or torch.equal(mine.nan_to_num(-1), theirs.nan_to_num(-1)), field.name


def test_frames_take_different_ways(whole):
    """Else the rest shows little."""
    assert whole.valid.tolist() == [frame != 5 for frame in range(FRAMES)]
    assert len(whole.iterations.unique()) > 2


def test_one_frame_at_a_time(inversion, targets, identity, whole):
    for frame in range(FRAMES):
        if frame != 5:  # alone it is a sequence without a usable frame
            assert_same(inversion(targets[frame : frame + 1], identity), whole.part(slice(frame, frame + 1)))


def test_in_another_order(inversion, targets, identity, whole):
    order = torch.tensor([8, 3, 10, 0, 6, 1, 5, 9, 2, 7, 4])
    assert_same(inversion(targets[order], identity), whole.part(order))
    assert_same(inversion(targets[order[:4]], identity), whole.part(order[:4]))


def test_in_chunks(inversion, targets, identity, whole, monkeypatch):
    monkeypatch.setattr(fit, "_CHUNK", 4)
    assert_same(inversion(targets, identity), whole)


def test_beside_many_others(inversion, targets, identity, whole):
    found = inversion(torch.cat((targets, targets, targets)), identity)
    for first in (0, FRAMES, 2 * FRAMES):
        assert_same(found.part(slice(first, first + FRAMES)), whole)


@pytest.mark.parametrize("count", [1, 2])
def test_by_one_thread_or_two(inversion, targets, identity, whole, threads, count):
    """So many that each thread has frames of its own."""
    threads(count)
    found = inversion(targets.repeat(12, 1, 1), identity)
    for first in range(0, 12 * FRAMES, FRAMES):
        assert_same(found.part(slice(first, first + FRAMES)), whole)


def test_identities_of_their_own(inversion, layer):
    """Frames that each have an identity do not depend on one another either."""
    identities = layer.identity({"shape": randn(4, 16, seed=6, dtype=torch.float32)})
    with torch.no_grad():
        vertices = layer.pose(identities, 0.3 * randn(4, 77, 3, seed=7).float()).vertices
    expected = inversion(vertices, identities)
    order = torch.tensor([2, 0, 3])
    assert_same(inversion(vertices[order], part_of(identities, order)), expected.part(order))
