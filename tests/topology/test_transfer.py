"""The transfer commutes with similarities, bags included, and reproduces the wrap."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.topology.correspondence import build_correspondence
from soma_core.topology.frames import native_to_canonical
from soma_core.topology.transfer import CanonicalPassThrough, TopologyTransfer, filled_vertices, make_transfer
from tests.bodies import CPU, TO_NATIVE, native_body, randn, tiny_canonical, tiny_spec, wrap_vertices

EQUIVARIANCE = 1e-6
"""Bound the project promises, relative to the body; float64 rounding is far below."""
WRAP_MM = 1e-9
MESH, _ = tiny_canonical()
SPEC = tiny_spec(None)
NATIVE = torch.as_tensor(native_body()[0])[None]


@pytest.fixture(scope="module")
def correspondence():
    return build_correspondence(*native_body(), wrap_vertices())


@pytest.fixture(scope="module")
def transfer(correspondence):
    return TopologyTransfer(correspondence, SPEC, MESH, dtype=torch.float64, device=CPU)


def canonical(native):
    return 1e-2 * native @ native_to_canonical("+z", "-y").T


def test_neutral_body_is_the_wrap_in_metres(transfer):
    expected = canonical(wrap_vertices())
    np.testing.assert_allclose(1e3 * transfer(NATIVE)[0].numpy(), 1e3 * expected, atol=WRAP_MM)


@pytest.mark.parametrize("scale", [0.6, 100.0, 0.01])
def test_scaling_the_source_scales_the_result(transfer, scale):
    once, scaled = transfer(NATIVE), transfer(scale * NATIVE)
    torch.testing.assert_close(scaled / scale, once, atol=EQUIVARIANCE * float(once.abs().max()), rtol=0)


@pytest.mark.parametrize("scale", [0.6, 100.0])
def test_scaling_in_float32(correspondence, scale):
    """The promise holds in the working precision, too, as an error relative to the body."""
    transfer = TopologyTransfer(correspondence, SPEC, MESH, dtype=torch.float32, device=CPU)
    once, scaled = transfer(NATIVE.float()), transfer(scale * NATIVE.float())
    torch.testing.assert_close(scaled / scale, once, atol=EQUIVARIANCE * 2, rtol=0)  # a body of two metres


@pytest.mark.parametrize("seed", range(3))
def test_equivariant_under_similarities(transfer, seed):
    """On a body that is no affine image of the wrap, so that nothing is exact by construction."""
    lumpy = NATIVE + 2 * torch.sin(NATIVE[..., [1, 2, 0]] / 9)
    turn, shift = torch.from_numpy(Rotation.random(random_state=seed).as_matrix()), 300 * randn(3, seed=seed)
    moved = transfer(0.6 * lumpy @ turn.T + shift)
    frame = torch.as_tensor(native_to_canonical("+z", "-y"))
    expected = 0.6 * transfer(lumpy) @ (frame @ turn @ frame.T).T + 1e-2 * shift @ frame.T
    torch.testing.assert_close(moved, expected, atol=EQUIVARIANCE * 1e-3, rtol=0)


@pytest.mark.parametrize("unit", ["m", "cm", "mm"])
def test_declared_unit(correspondence, unit):
    factor = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}[unit]
    transfer = make_transfer(
        tiny_spec(None, unit=unit), MESH, correspondence, dtype=torch.float64, device=CPU
    )
    expected = factor * wrap_vertices() @ native_to_canonical("+z", "-y").T
    torch.testing.assert_close(transfer(NATIVE)[0], torch.as_tensor(expected))


@pytest.mark.parametrize(("up", "forward"), [("+y", "+z"), ("-x", "+y"), ("-z", "-y")])
def test_declared_axes(correspondence, up, forward):
    """Turning the source and declaring it gives the same body."""
    frame = native_to_canonical(up, forward)
    turned = torch.as_tensor(native_body()[0] @ (frame.T @ native_to_canonical("+z", "-y")).T)[None]
    transfer = make_transfer(
        tiny_spec(None, up=up, forward=forward), MESH, correspondence, dtype=torch.float64, device=CPU
    )
    expected = torch.as_tensor(canonical(wrap_vertices()))
    torch.testing.assert_close(transfer(turned)[0], expected, atol=1e-12, rtol=0)


def test_batch_rows_are_independent(transfer):
    batch = NATIVE + randn(5, *NATIVE.shape[1:], seed=1)
    together = transfer(batch)
    assert together.shape == (5, MESH.vertex_count, 3)
    torch.testing.assert_close(together[2:3], transfer(batch[2:3]))
    assert transfer(batch[:0]).shape == (0, MESH.vertex_count, 3)


def test_input_stays_and_strides_do_not_matter(transfer):
    strided = NATIVE.transpose(1, 2).contiguous().transpose(1, 2)
    kept = strided.clone()
    torch.testing.assert_close(transfer(strided), transfer(NATIVE))
    assert torch.equal(strided, kept)


def test_gradcheck(transfer):
    """Along random directions of the native mesh: the full Jacobian would be thousands of columns."""
    directions, pull = randn(4, *NATIVE.shape[1:], seed=2), randn(MESH.vertex_count, 3, seed=3)

    def along(steps):
        return (transfer(NATIVE + torch.einsum("d,dnc->nc", steps, directions)) * pull).sum((1, 2))

    assert torch.autograd.gradcheck(along, 0.1 * randn(4, seed=4).requires_grad_(), atol=1e-6)


@pytest.mark.parametrize("shape", [(1, 10, 3), (1014, 3), (1, 1016, 2), (1, 2, 1016, 3)])
def test_wrong_shape(transfer, shape):
    with pytest.raises(
        InputError, match=r"native vertices: got \(.*expected \(batch, \d+, 3\), as in the wrap"
    ) as caught:
        transfer(torch.zeros(shape, dtype=torch.float64))
    assert str(shape) in str(caught.value)


# --- fills ----------------------------------------------------------------------------------------------


def test_filled_vertices_are_those_of_the_declared_segments():
    np.testing.assert_array_equal(filled_vertices(SPEC, MESH), MESH.face_interior)
    only = tiny_spec(None, fill_segments=("mouth_bag",))
    np.testing.assert_array_equal(filled_vertices(only, MESH), MESH.segments["mouth_bag"])
    assert len(filled_vertices(tiny_spec(None, fill_segments=()), MESH)) == 0


def test_unknown_segments_are_refused():
    with pytest.raises(
        InputError, match=r"fill_segments: got ears, nose, expected names among eye_bags, mouth_bag.*'tiny'"
    ):
        filled_vertices(tiny_spec(None, fill_segments=("nose", "ears", "mouth_bag")), MESH)


def test_filled_vertices_do_not_depend_on_where_the_wrap_found_them(correspondence):
    """Correspondence inside a bag is meaningless: changing it changes nothing but the wrap it came from."""
    bags = MESH.face_interior
    corners = correspondence.corners.copy()
    corners[bags] = corners[bags[::-1]]
    coordinates = correspondence.coordinates.copy()
    coordinates[bags] = 17.0
    scrambled = dataclasses.replace(correspondence, corners=corners, coordinates=coordinates)
    lumpy = NATIVE + torch.sin(NATIVE[..., [1, 2, 0]] / 9)
    results = [
        TopologyTransfer(made, SPEC, MESH, dtype=torch.float64, device=CPU)(lumpy)
        for made in (correspondence, scrambled)
    ]
    torch.testing.assert_close(*results)


def test_unfilled_bags_are_gathered(correspondence):
    plain = make_transfer(
        tiny_spec(None, fill_segments=()), MESH, correspondence, dtype=torch.float64, device=CPU
    )
    expected = torch.as_tensor(canonical(wrap_vertices()))
    torch.testing.assert_close(plain(NATIVE)[0], expected, atol=1e-12, rtol=0)


# --- pass-through ---------------------------------------------------------------------------------------


def test_canonical_topology_passes_through():
    transfer = make_transfer(SPEC, MESH, None, dtype=torch.float64, device=CPU)
    assert isinstance(transfer, CanonicalPassThrough)
    given = torch.as_tensor(MESH.vertices @ TO_NATIVE.T)[None]
    torch.testing.assert_close(transfer(given)[0], torch.as_tensor(MESH.vertices))


def test_pass_through_of_another_vertex_count():
    transfer = make_transfer(SPEC, MESH, None, dtype=torch.float64, device=CPU)
    text = (
        rf"native vertices: got \(1, 7, 3\), expected \(batch, {MESH.vertex_count}, 3\), the canonical mesh"
    )
    with pytest.raises(InputError, match=text):
        transfer(torch.zeros(1, 7, 3, dtype=torch.float64))


def test_pass_through_of_a_lower_lod_gathers():
    ids = np.array([3, 5, 8])
    low = dataclasses.replace(MESH, vertices=MESH.vertices[ids], mid_ids=ids, lod="low")
    transfer = make_transfer(
        tiny_spec(None, unit="m", up="+y", forward="+z"), low, None, dtype=torch.float64, device=CPU
    )
    given = torch.as_tensor(MESH.vertices)[None]
    assert torch.equal(transfer(given), given[:, ids])


def test_pass_through_of_a_lower_lod_refuses_meshes_that_are_too_small():
    ids = np.array([3, 5, 8])
    low = dataclasses.replace(MESH, vertices=MESH.vertices[ids], mid_ids=ids, lod="low")
    transfer = make_transfer(SPEC, low, None, dtype=torch.float64, device=CPU)
    with pytest.raises(InputError, match=r"native vertices: got \(1, 4, 3\)"):
        transfer(torch.zeros(1, 4, 3, dtype=torch.float64))
