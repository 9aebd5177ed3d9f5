"""Vertex errors in Warp: distances to the posed vertices of the forward model, none of them written."""

import pytest
import torch

from soma_core.animation.skinning import skinning_transforms
from soma_core.kernels import skin_error_wp
from soma_core.kernels.skin_error_wp import skin_error
from tests.bodies import randn
from tests.inversion.small_problem import synthetic
from tests.kernels.parity import DEVICES, DTYPES, VALUES_M

BATCHES = [1, 7, 8, 15, 16, 17, 33]
BODY = synthetic()


def inputs(count, dtype=torch.float64, device="cpu"):
    """Arguments of the kernel, and the posed vertices it never writes."""
    animation, identity = BODY.animation(dtype), BODY.identities(1, dtype=dtype)
    rotations, hips = BODY.poses(count, dtype=dtype)
    posed = animation.pose(identity, rotations, hips, absolute=False)
    transforms = skinning_transforms(
        posed.transforms[..., :3, :3], posed.transforms[..., :3, 3], identity.bind_world
    )
    weights = animation.skinning.weights
    rest = torch.cat((identity.rest[0], torch.ones_like(identity.rest[0, :, :1])), 1)
    point = weights.val[:, None] * rest[animation.skinning.influence_vertex]
    targets = posed.vertices + 0.01 * randn(*posed.vertices.shape, seed=3, dtype=dtype)
    given = weights.crow, weights.col, point, BODY.vertex_weights(1, dtype=dtype)[0], transforms, targets
    return [part.to(device) for part in given], posed.vertices.to(device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
def test_distances_and_energies(batch, dtype, device):
    given, posed = inputs(batch, dtype, device)
    error, total = skin_error(*given)
    expected = (posed - given[5]).norm(dim=-1)
    assert error.dtype == total.dtype == dtype
    torch.testing.assert_close(error, expected, atol=VALUES_M[dtype], rtol=0)
    energy = (given[3] * expected.square()).sum(1)
    torch.testing.assert_close(total, energy, rtol=1e-3 if dtype == torch.float32 else 1e-10, atol=0)


def test_the_layout_of_a_gpu_gives_the_same(monkeypatch):
    given, _ = inputs(5)
    expected = skin_error(*given)
    monkeypatch.setattr(skin_error_wp, "lane_count", lambda tensor: 1)
    for found, one in zip(skin_error(*given), expected, strict=True):
        torch.testing.assert_close(found, one, atol=1e-13, rtol=1e-13)


def test_an_exact_reconstruction_has_no_error():
    given, posed = inputs(5)
    given[5] = posed
    error, total = skin_error(*given)
    assert error.max() < 1e-14
    assert total.max() < 1e-24


def test_vertices_without_weight_have_an_error_but_no_energy():
    given, _ = inputs(5)
    weight = given[3]
    expected = skin_error(*given)[1]
    given[5] = given[5].clone()
    given[5][:, weight == 0] += 1.0
    error, total = skin_error(*given)
    assert torch.equal(total, expected)
    assert (error[:, weight == 0] > 0.9).all()


def test_no_frame_at_all():
    given, _ = inputs(1)
    error, total = skin_error(*given[:4], given[4][:0], given[5][:0])
    assert error.shape == (0, BODY.mesh.vertex_count)
    assert total.shape == (0,)


def test_targets_may_be_any_view():
    given, _ = inputs(5)
    expected, _ = skin_error(*given)
    given[5] = given[5].transpose(1, 2).contiguous().transpose(1, 2)
    found, _ = skin_error(*given)
    assert torch.equal(found, expected)
