"""Skinning with bodies in SIMD lanes, and its derivative, against the torch reference."""

import pytest
import torch

from soma_core.animation.skinning import Skinning
from soma_core.kernels.body_skin_back_wp import skin
from soma_core.kernels.body_skin_wp import blend_of
from tests.animation.test_skinning import RIG, case, general
from tests.bodies import CPU
from tests.kernels.parity import BATCHES, DTYPES, assert_twins


def twins(dtype):
    skinning, blend = Skinning(RIG.weights, dtype=dtype, device=CPU), blend_of(RIG.weights, dtype=dtype)
    return (lambda *x: general(skinning, *x)), (lambda *x: skin(*x, blend))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", [*BATCHES, 20])
def test_parity(batch, dtype, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert_twins(*twins(dtype), case(batch, dtype), dtype=dtype)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("given", ["planes", "rows", "apart"])
def test_any_layout_of_points_gives_the_same(given):
    _, lanes = twins(torch.float64)
    rest, transforms = (part.detach() for part in case(3, torch.float64))
    order = {"planes": (2, 1, 0), "rows": (0, 1, 2), "apart": (0, 2, 1)}[given]
    back = [order.index(axis) for axis in range(3)]
    turned = rest.permute(order).contiguous().permute(back).requires_grad_(), transforms.requires_grad_()
    straight = rest.clone().requires_grad_(), transforms
    found = [(out, *torch.autograd.grad(out.square().sum(), each)) for each in (turned, straight)
             for out in [lanes(*each)]]  # fmt: skip
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def test_one_body_in_many_poses_adds_what_each_pulls():
    reference, lanes = twins(torch.float64)
    rest, transforms = (part.detach() for part in case(5, torch.float64))
    rest = rest[:1].requires_grad_()
    expected, got = (
        torch.autograd.grad(out.square().sum(), rest)[0]
        for out in (reference(rest.expand(5, -1, 3), transforms), lanes(rest, transforms))
    )
    torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("asking", [0, 1])
def test_gradients_only_for_inputs_that_ask(asking):
    reference, lanes = twins(torch.float64)
    inputs = [part.detach() for part in case(2, torch.float64)]
    inputs[asking].requires_grad_()
    expected, got = (
        torch.autograd.grad(f(*inputs).square().sum(), inputs[asking])[0] for f in (reference, lanes)
    )
    torch.testing.assert_close(got, expected)


def test_deterministic():
    _, lanes = twins(torch.float32)
    rest, transforms = case(7, torch.float32)
    runs = [(out, *torch.autograd.grad(out.square().sum(), (rest, transforms)))
            for out in (lanes(rest, transforms) for _ in range(2))]  # fmt: skip
    for one, other in zip(*runs, strict=True):
        assert torch.equal(one, other)


def test_operator_is_registered_soundly():
    args = (*case(2, torch.float64), *blend_of(RIG.weights, dtype=torch.float64))
    torch.library.opcheck(torch.ops.soma_core.skin_bodies.default, args)


def test_empty_batch():
    _, lanes = twins(torch.float32)
    rest, transforms = (part[:0] for part in case(1, torch.float32))
    rest, transforms = rest.detach().requires_grad_(), transforms.detach().requires_grad_()
    out = lanes(rest, transforms)
    assert out.shape == rest.shape
    out.sum().backward()
    assert rest.grad.shape == rest.shape
