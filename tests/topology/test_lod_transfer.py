"""Bodies on the extra-low mesh: carried over from low."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.plugin.spec import BackendSpec
from soma_core.rig import load_canonical
from soma_core.topology.lod_transfer import LodTransfer, lod_correspondence, offset_rows
from soma_core.topology.transfer import make_transfer

ROUNDING_M = 1e-12  # float64 on lengths of a metre
AFFINE_M = 2e-3  # a height along the normal does not shear with its face: 5 mm times a shear of 0.2, squared
OFFSET_M = 5e-5  # offsets of 1 cm that bend over 20 cm: the second order of their faces' turns


@pytest.fixture(scope="module")
def low():
    return load_canonical("low")


@pytest.fixture(scope="module")
def xlo():
    return load_canonical("xlo")


@pytest.fixture(scope="module")
def transfer(low, xlo):
    return LodTransfer(low[0], xlo[0], dtype=torch.float64, device="cpu")


def wave(points: np.ndarray) -> np.ndarray:
    """Smooth offsets of at most 1 cm."""
    return 0.01 * np.sin(points[:, [1, 2, 0]] / 0.2)


def test_the_bind_shape_is_kept(low, xlo, transfer):
    carried = transfer(torch.tensor(low[0].vertices)[None])[0]
    np.testing.assert_allclose(carried, xlo[0].vertices, atol=ROUNDING_M)


def test_it_commutes_with_similarities(low, xlo, transfer):
    turn, scale, shift = Rotation.from_rotvec([0.3, -1, 2]).as_matrix(), 0.37, np.array([1, -2, 0.5])
    body = scale * low[0].vertices @ turn.T + shift
    expected = scale * xlo[0].vertices @ turn.T + shift
    np.testing.assert_allclose(transfer(torch.as_tensor(body)[None])[0], expected, atol=ROUNDING_M)


def test_a_wider_and_shorter_body_is_followed(low, xlo, transfer):
    stretch = np.diag([1.2, 0.8, 1.1])
    carried = transfer(torch.as_tensor(low[0].vertices @ stretch)[None])[0].numpy()
    assert np.linalg.norm(carried - xlo[0].vertices @ stretch, axis=1).max() < AFFINE_M


def test_every_vertex_lies_close_to_its_face_outside_the_bags(low, xlo):
    found = lod_correspondence(low[0], xlo[0])
    assert found.distances.max() < 0.006
    assert not np.isin(found.corners, low[0].face_interior).any()
    # On the same part of the body: the joints that carry a face carry the vertex. Two vertices on the
    # membrane between the lips may take after the other lip.
    weights = np.einsum("nk,nkj->nj", _shares(found), low[1].weights.toarray()[found.corners])
    apart = np.abs(weights - xlo[1].weights.toarray()).max(axis=1) > 0.1
    assert apart.sum() <= 2
    assert np.isin(np.flatnonzero(apart), xlo[0].segments["head"]).all()


def _shares(found):
    first, second, _ = found.coordinates.T
    return np.stack([1 - first - second, first, second], 1)


def test_only_the_named_vertices_are_needed(low, transfer):
    body = torch.tensor(low[0].vertices)[None].clone()
    expected = transfer(body)
    others = np.setdiff1d(np.arange(low[0].vertex_count), transfer.source_ids.numpy())
    body[:, others] = torch.nan
    torch.testing.assert_close(transfer(body), expected, rtol=0, atol=0)
    torch.testing.assert_close(transfer.from_needed(body[:, transfer.source_ids]), expected, rtol=0, atol=0)


def test_gradients(low, transfer):
    body = torch.tensor(low[0].vertices)[None, transfer.source_ids].requires_grad_()
    torch.autograd.gradcheck(
        lambda move: transfer.from_needed(body + move)[:, ::60], (torch.zeros(3).double().requires_grad_(),)
    )


@pytest.mark.parametrize("lod", ["mid", "low"])
def test_offsets_of_a_subset_are_selected(lod):
    mesh = load_canonical(lod)[0]
    offsets = wave(load_canonical("mid")[0].vertices[: mesh.mid_ids.max() + 1])
    found = (offset_rows(mesh) @ offsets.ravel()).reshape(-1, 3)
    np.testing.assert_array_equal(found, offsets[mesh.mid_ids])


def test_offsets_reach_xlo_as_the_difference_of_two_bodies_does(low, xlo, transfer):
    offsets = wave(low[0].vertices)
    rows = offset_rows(xlo[0])
    found = (rows @ offsets.ravel()[: rows.shape[1]]).reshape(-1, 3)
    both = torch.as_tensor(np.stack([low[0].vertices + offsets, low[0].vertices]))
    moved, still = transfer(both).numpy()
    assert np.linalg.norm(found - (moved - still), axis=1).max() < OFFSET_M


def test_a_shift_and_a_small_turn_of_everything_are_exact(low, xlo):
    rows = offset_rows(xlo[0])
    count = rows.shape[1] // 3
    for of in (lambda points: np.full_like(points, 0.01), lambda points: np.cross([0.1, 0.2, -0.1], points)):
        found = (rows @ of(low[0].vertices[:count]).ravel()).reshape(-1, 3)
        np.testing.assert_allclose(found, of(xlo[0].vertices), atol=ROUNDING_M)


def test_native_vertices_are_refused_with_the_way_round(xlo):
    spec = BackendSpec(name="toy", unit="m", up="+y", forward="+z", params=(), wrap=None)
    with pytest.raises(InputError, match="lod: got 'xlo', expected 'mid' or 'low'.*lod='low'"):
        make_transfer(spec, xlo[0], None, dtype=torch.float32, device="cpu")
