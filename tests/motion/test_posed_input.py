"""Posed vertices reach the fit in the right mesh, unit and axes, or are refused with the fix."""

from pathlib import Path

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.io import VertexSequence
from soma_core.layer import SomaLayer
from soma_core.motion.posed_input import PosedInput, world_axes
from soma_core.rig import load_canonical

LENGTH_TOLERANCE = 1e-6
"""Relative: float32."""

Z_UP_TO_CANONICAL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""+Z up, facing -Y, to +Y up, facing +Z."""


class Stored(VertexSequence):
    """Frames in memory."""

    def __init__(self, frames, **told):
        super().__init__(Path("body.npz"), *frames.shape[:2], **told)
        self.frames = np.asarray(frames, np.float32)

    def _read(self, start, stop):
        return self.frames[start:stop]


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low")


@pytest.fixture(scope="module")
def toy():
    pytest.importorskip("soma_backend_toy")
    return SomaLayer("toy", lod="low")


@pytest.fixture(scope="module")
def mid():
    return load_canonical("mid")[0].vertices.astype(np.float32)[None]


def native(toy):
    """The toy's own vertices [cm], +Z up."""
    from soma_core.plugin.registry import default_registry

    params = {parameter.name: 1.0 for parameter in toy.spec.params}
    generator = default_registry().generator("toy", device=toy.device, dtype=toy.dtype)
    tensors = toy.identity(params).params
    return generator.rest(tensors).numpy()


def test_canonical_vertices_of_mid_serve_a_low_fit(layer, mid):
    posed = PosedInput(Stored(mid, metres=1.0), layer, topology="auto")
    assert posed.topology == "canonical"
    np.testing.assert_array_equal(posed.read(0, 1), mid[:, layer.mesh.mid_ids])
    low = mid[:, layer.mesh.mid_ids]
    np.testing.assert_array_equal(PosedInput(Stored(low, metres=1.0), layer, topology="auto").read(0, 1), low)


@pytest.mark.parametrize(("metres", "up"), [(1.0, "+y"), (0.01, None), (0.001, "+z")])
def test_canonical_vertices_become_metres_and_y_up(layer, mid, metres, up):
    axes = Z_UP_TO_CANONICAL if up == "+z" else np.eye(3)
    stored = Stored(mid @ axes / metres, metres=metres, up=up)
    found = PosedInput(stored, layer, topology="canonical").read(0, 1)
    np.testing.assert_allclose(found, mid[:, layer.mesh.mid_ids], atol=2 * LENGTH_TOLERANCE)


def test_canonical_vertices_need_a_unit(layer, mid):
    with pytest.raises(InputError, match=r"unit: got none in body\.npz, expected m, cm or mm"):
        PosedInput(Stored(mid), layer, topology="canonical")


def test_low_vertices_do_not_serve_a_mid_fit(layer, mid):
    low = Stored(mid[:, layer.mesh.mid_ids], metres=1.0)
    with pytest.raises(
        InputError, match=r"got 4505 vertices, the low .* expected 18056 for lod=mid\. Pass lod=low"
    ):
        PosedInput(low, SomaLayer("soma"), topology="canonical")


def test_a_count_that_says_nothing_is_refused(layer, mid):
    with pytest.raises(
        InputError, match=r"got 17 vertices, expected one of 18056 \(native\), 18056 \(mid\), 4505"
    ):
        PosedInput(Stored(mid[:, :17], metres=1.0), layer, topology="auto")


def test_vertices_of_a_canonical_backend_without_a_unit_are_ambiguous(layer, mid):
    with pytest.raises(InputError, match=r"topology: got 18056 vertices.*native means .* cm, \+y up"):
        PosedInput(Stored(mid), layer, topology="auto")
    found = PosedInput(Stored(100 * mid), layer, topology="native").read(0, 1)
    np.testing.assert_allclose(found, 100 * mid)


def test_native_vertices_without_a_unit_are_the_backends(toy):
    vertices = native(toy)
    posed = PosedInput(Stored(vertices), toy, topology="auto")
    assert posed.topology == "native"
    np.testing.assert_array_equal(posed.read(0, 1), vertices)


def test_native_vertices_are_brought_to_the_backends_unit_and_axes(toy):
    vertices = native(toy)
    exported = 0.01 * vertices @ Z_UP_TO_CANONICAL.T
    posed = PosedInput(Stored(exported, metres=1.0, up="+y"), toy, topology="auto")
    scale = np.abs(vertices).max()
    np.testing.assert_allclose(posed.read(0, 1), vertices, atol=2 * LENGTH_TOLERANCE * scale)


def test_native_vertices_of_another_topology_are_refused(toy, mid):
    with pytest.raises(InputError, match=r"got 18056 vertices, expected one of .*for backend 'toy'"):
        PosedInput(Stored(mid), toy, topology="native")


@pytest.mark.parametrize(("factor", "said", "unit"), [(100.0, "117", "cm"), (1000.0, "1.17e\\+03", "mm")])
def test_a_unit_wrong_by_a_hundred_is_named(layer, mid, factor, said, unit):
    posed = PosedInput(Stored(factor * mid, metres=1.0), layer, topology="canonical")
    with pytest.raises(
        InputError,
        match=rf"a body {said} times as large as its identity, for lengths in m,.*pass unit={unit}",
    ):
        posed.check_size(layer, layer.identity({}))


def test_a_native_unit_wrong_by_a_hundred_is_named(toy):
    posed = PosedInput(Stored(0.01 * native(toy)), toy, topology="auto")
    with pytest.raises(InputError, match=r"a body 0\.00\S* times as large .* lengths in cm, .*pass unit=m\."):
        posed.check_size(toy, toy.identity({}))


def test_bodies_of_the_right_size_pass(layer, toy, mid):
    PosedInput(Stored(0.8 * mid, metres=1.0), layer, topology="canonical").check_size(
        layer, layer.identity({})
    )
    PosedInput(Stored(native(toy)), toy, topology="auto").check_size(toy, toy.identity({}))


def test_frames_that_are_no_body_do_not_decide(layer, mid):
    frames = np.repeat(mid, 3, axis=0)
    frames[0], frames[1] = np.nan, 0
    PosedInput(Stored(frames, metres=1.0), layer, topology="canonical").check_size(layer, layer.identity({}))
    PosedInput(Stored(frames[:2], metres=1.0), layer, topology="canonical").check_size(
        layer, layer.identity({})
    )


@pytest.mark.parametrize("factor", [10.0, 0.1, 12.0, 6.0])
def test_a_size_that_no_unit_explains_is_refused(layer, mid, factor):
    posed = PosedInput(Stored(factor * mid, metres=1.0), layer, topology="canonical")
    with pytest.raises(InputError, match=r"times as large as its identity.*No unit fits"):
        posed.check_size(layer, layer.identity({}))


def test_a_world_that_says_the_other_side_up_is_turned(layer, mid):
    for up in ("+y", "+z", "-y", "-z"):
        stored = Stored(mid @ world_axes(up), metres=1.0, up=up)
        posed = PosedInput(stored, layer, topology="canonical")
        np.testing.assert_allclose(posed.read(0, 1)[0], mid[0][layer.mesh.mid_ids], atol=1e-5)
