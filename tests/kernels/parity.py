"""What every twin must satisfy: the torch reference's values and gradients, on every device."""

import pytest
import torch

VALUES_M = {torch.float32: 1e-5, torch.float64: 1e-10}
"""The promised bound on positions; float64 leaves room for ill-conditioned rotations only."""
GRADIENTS = {torch.float32: 1e-4, torch.float64: 1e-8}
"""The promised bound, relative to the largest gradient of an input."""


def quick(*values, slow):
    """Cases of a parametrised test, of which some run only where the slow tests do."""
    slow = [value if isinstance(value, tuple) else (value,) for value in slow]
    return [*values, *(pytest.param(*value, marks=pytest.mark.slow) for value in slow)]


BATCHES = quick(1, 7, slow=[2, 33])
DTYPES = quick(torch.float32, slow=[torch.float64])
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")),
]


def assert_twins(reference, twin, inputs, *, dtype, seed=0):
    """Compare values and gradients of two functions that return a tensor or a tuple of them."""
    outputs = []
    for function in (reference, twin):
        leaves = [part.detach().clone().requires_grad_() for part in inputs]
        found = function(*leaves)
        found = found if isinstance(found, tuple) else (found,)
        random = torch.Generator().manual_seed(seed)
        pulls = [torch.randn(part.shape, generator=random, dtype=torch.float64).to(part) for part in found]
        loss = sum((part * pull).sum() for part, pull in zip(found, pulls, strict=True))
        outputs.append((found, torch.autograd.grad(loss, leaves)))
    (values, grads), (twin_values, twin_grads) = outputs
    for expected, got in zip(values, twin_values, strict=True):
        assert got.dtype == dtype
        torch.testing.assert_close(got, expected, atol=VALUES_M[dtype], rtol=0)
    for expected, got in zip(grads, twin_grads, strict=True):
        bound = GRADIENTS[dtype] * max(float(expected.abs().max()), 1e-12)
        torch.testing.assert_close(got, expected, atol=bound, rtol=0)
