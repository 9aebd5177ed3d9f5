"""The Warp skinning kernel against the torch reference."""

import pytest
import torch

from soma_core.animation.skinning import Skinning
from soma_core.errors import InputError
from soma_core.kernels.skinning_wp import skin
from tests.animation.test_skinning import MESH, RIG, case, general
from tests.bodies import CPU
from tests.kernels.parity import BATCHES, DEVICES, DTYPES, assert_twins


def twins(dtype, device):
    skinning = Skinning(RIG.weights, dtype=dtype, device=device)
    weights = skinning.weights
    return (lambda *x: general(skinning, *x)), (lambda *x: skin(*x, weights.csr, weights.transpose))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
def test_parity(batch, dtype, device):
    inputs = [part.to(device) for part in case(batch, dtype)]
    assert_twins(*twins(dtype, device), inputs, dtype=dtype)


def test_strides_do_not_matter():
    _, warp = twins(torch.float64, CPU)
    rest, transforms = (part.detach() for part in case(3, torch.float64))
    rest, transforms = rest.requires_grad_(), transforms.requires_grad_()
    turned = rest.transpose(0, 2).contiguous().transpose(0, 2), transforms.mT.contiguous().mT
    out, expected = warp(*turned), warp(rest, transforms)
    assert torch.equal(out, expected)
    grads = [torch.autograd.grad(x.sum(), (rest, transforms)) for x in (out, expected)]
    for one, other in zip(*grads, strict=True):
        torch.testing.assert_close(one, other)


def test_deterministic():
    _, warp = twins(torch.float32, CPU)
    rest, transforms = case(7, torch.float32)
    runs = []
    for _ in range(2):
        out = warp(rest, transforms)
        runs.append((out, *torch.autograd.grad(out.square().sum(), (rest, transforms))))
    for one, other in zip(*runs, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("asking", [0, 1])
def test_gradients_only_for_inputs_that_ask(asking):
    torch_path, warp = twins(torch.float64, CPU)
    inputs = [part.detach() for part in case(2, torch.float64)]
    inputs[asking].requires_grad_()
    expected, got = (
        torch.autograd.grad(f(*inputs).square().sum(), inputs[asking])[0] for f in (torch_path, warp)
    )
    torch.testing.assert_close(got, expected)


def test_half_precision_is_refused_by_name():
    skinning = Skinning(RIG.weights, dtype=torch.float16, device=CPU)
    rest, transforms = (part.detach() for part in case(1, torch.float16))
    with pytest.raises(
        InputError, match=r"dtype: got torch.float16, expected torch.float32 or torch.float64"
    ):
        skin(rest, transforms, skinning.weights.csr, skinning.weights.transpose)


def test_operator_is_registered_soundly():
    """Schema, shapes without data, autograd and tracing, by torch's own checker."""
    weights = Skinning(RIG.weights, dtype=torch.float64, device=CPU).weights
    args = (*case(2, torch.float64), *weights.csr, *weights.transpose)
    torch.library.opcheck(torch.ops.soma_core.skin.default, args)


def test_empty_batch():
    _, warp = twins(torch.float32, CPU)
    rest, transforms = (part[:0] for part in case(1, torch.float32))
    assert warp(rest, transforms).shape == (0, MESH.vertex_count, 3)
