"""A layer of one batch size: what it returns, what it refuses, and on CUDA that the graph is replayed."""

import pytest
import torch

from soma_core.errors import InputError
from soma_core.layer import SomaLayer
from tests.animation.test_fused import assert_same, poses, shapes
from tests.kernels.parity import DEVICES


@pytest.fixture(scope="module", params=DEVICES)
def layer(request):
    return SomaLayer("soma", lod="low", device=request.param)


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize(("batch", "identities"), [(1, 1), (5, 1), (5, 5)])
def test_poses_as_the_layer_does(layer, batch, identities, absolute):
    compiled = layer.compiled(batch=batch, identities=identities, absolute=absolute)
    for seed in range(3):  # another body and pose each time
        identity = layer.identity(shapes(layer, identities, seed=seed))
        rotations, translation = poses(layer, batch, seed=10 * seed)
        for shift in (translation, translation[0], None):
            got = compiled(identity, rotations, shift)
            assert_same(got, layer.pose(identity, rotations, shift, absolute=absolute))


def test_makes_identities_as_the_layer_does(layer):
    compiled = layer.compiled(batch=3, identities=3, params=True)
    for seed in range(2):
        given = shapes(layer, 3, seed=seed)
        rotations, translation = poses(layer, 3, seed=10 * seed)
        assert_same(compiled(given, rotations, translation), layer(given, rotations, translation))


def test_takes_matrices(layer):
    compiled = layer.compiled(batch=2, matrices=True)
    matrices = torch.eye(3, device=layer.device).expand(2, 77, 3, 3)
    assert_same(compiled(layer.identity(), matrices), layer.pose(layer.identity(), matrices))


def test_another_number_of_bodies_is_refused(layer):
    compiled, whole = layer.compiled(batch=2), layer.compiled(batch=2, identities=2, params=True)
    rotations, translation = poses(layer, 3)
    identity = layer.identity()
    with pytest.raises(InputError, match=r"rotations: got \(3, 77, 3\), expected \(2, 77, 3\), as compiled"):
        compiled(identity, rotations)
    with pytest.raises(InputError, match=r"translation: got \(3, 3\), expected \(2, 3\)"):
        compiled(identity, rotations[:2], translation)
    with pytest.raises(InputError, match=r"identity: got a batch of 2, expected .* batch 1"):
        compiled(layer.identity(shapes(layer, 2)), rotations[:2])
    with pytest.raises(InputError, match=r"identity: got dict.*params=True"):
        compiled({}, rotations[:2])
    with pytest.raises(InputError, match=r"params\['shape'\]: got a batch of 3, expected .* batch 2"):
        whole(shapes(layer, 3), rotations[:2])
    with pytest.raises(InputError, match="rotations: got list"):
        compiled(identity, [0.0])
    for wrong in ({"batch": 0}, {"batch": 4, "identities": 3}):
        with pytest.raises(InputError, match=r"batch: got 0|identities: got 3, expected 1 or 4"):
            layer.compiled(**wrong)


def test_no_gradients_come_out(layer):
    rotations, _ = poses(layer, 2)
    vertices = layer.compiled(batch=2)(layer.identity(), rotations.requires_grad_()).vertices
    assert not vertices.requires_grad


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_the_graph_writes_to_the_same_place():
    layer = SomaLayer("soma", lod="low", device="cuda")
    compiled, identity = layer.compiled(batch=2), layer.identity()
    rotations, _ = poses(layer, 2)
    first = compiled(identity, rotations).vertices
    kept = first.clone()
    assert compiled(identity, 0 * rotations).vertices.data_ptr() == first.data_ptr()
    assert not torch.equal(first, kept)
