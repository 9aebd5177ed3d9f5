"""The Warp tree walk against the torch reference."""

import pytest
import torch

from soma_core.animation.kinematics import Kinematics
from soma_core.errors import InputError
from soma_core.kernels.kinematics_wp import forward_kinematics
from soma_core.rig import load_canonical
from tests.animation.test_kinematics import bodies, run, turns
from tests.bodies import CPU, randn, tiny_canonical
from tests.kernels.parity import BATCHES, DEVICES, DTYPES, assert_twins


def rig_of(lod):
    return tiny_canonical()[1] if lod == "tiny" else load_canonical(lod)[1]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("lod", ["tiny", "low"])
def test_parity(lod, batch, dtype, device):
    rig = rig_of(lod)
    modules = [Kinematics(rig, dtype=dtype, device=device, warp=warp) for warp in (False, True)]
    inputs = [x.to(device, dtype) for x in (bodies(rig, batch), turns(rig, batch), randn(batch, 3, seed=1))]
    assert_twins(*((lambda *x, m=module: run(m, *x)) for module in modules), inputs, dtype=dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_parity_with_one_shared_body(dtype):
    rig = rig_of("tiny")
    modules = [Kinematics(rig, dtype=dtype, device=CPU, warp=warp) for warp in (False, True)]
    inputs = [x.to(dtype) for x in (bodies(rig, 1), turns(rig, 5), randn(5, 3, seed=1))]
    assert_twins(*((lambda *x, m=module: run(m, *x)) for module in modules), inputs, dtype=dtype)


def arguments(batch=3, dtype=torch.float64):
    rig = rig_of("tiny")
    module = Kinematics(rig, dtype=dtype, device=CPU)
    offsets = module.local_offsets(bodies(rig, batch).to(dtype))
    relative = torch.cat(
        (torch.eye(3, dtype=dtype).expand(batch, 1, 3, 3), turns(rig, batch, dtype=dtype)), 1
    )
    return relative, offsets, module.order, module.tree


def test_gradcheck(fast_mode):
    relative, offsets, order, tree = arguments(2)
    inputs = (relative.requires_grad_(), offsets.detach().requires_grad_())
    assert torch.autograd.gradcheck(
        lambda r, o: forward_kinematics(r, o, order, tree), inputs, fast_mode=fast_mode
    )


def test_backward_through_one_output_alone():
    """The other output's gradient is then absent, or zero; both must work."""
    relative, offsets, order, tree = arguments()
    relative.requires_grad_()
    both = forward_kinematics(relative, offsets, order, tree)
    for output in both:
        (grad,) = torch.autograd.grad(output.sum(), relative, retain_graph=True)
        assert grad.isfinite().all()
        assert grad.abs().max() > 0


def test_backward_twice_gives_the_same():
    """The kernel's adjoint accumulates; nothing of it may stay in saved tensors."""
    relative, offsets, order, tree = arguments()
    relative.requires_grad_()
    turned, _ = forward_kinematics(relative, offsets, order, tree)
    pull = randn(*turned.shape, seed=3)
    first, second = (
        torch.autograd.grad((turned * pull).sum(), relative, retain_graph=True)[0] for _ in range(2)
    )
    assert torch.equal(first, second)


def test_half_precision_is_refused_by_name():
    relative, offsets, order, tree = arguments()
    with pytest.raises(InputError, match=r"dtype: got torch.float16, .*kernels='torch'"):
        forward_kinematics(relative.half(), offsets.half(), order, tree)


def test_operator_is_registered_soundly():
    relative, offsets, order, tree = arguments()
    args = (relative.requires_grad_(), offsets.detach().contiguous().requires_grad_(), order, tree)
    torch.library.opcheck(torch.ops.soma_core.forward_kinematics.default, args)


def test_empty_batch():
    relative, offsets, order, tree = arguments()
    turned, positions = forward_kinematics(relative[:0], offsets[:0], order, tree)
    assert turned.shape == (0, *relative.shape[1:])
    assert positions.shape == (0, *offsets.shape[1:])
