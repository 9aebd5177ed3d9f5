"""Operators of this project start without PyTorch's compiler, where torch keeps them as it does today."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from soma_core.geometry.torch_func import operator

CALLED = """
import sys
import torch
from soma_core import SomaLayer
layer = SomaLayer("soma", lod="low", kernels={kernels!r})
turns = torch.zeros(2, 77, 3, requires_grad=True)
layer.pose(layer.identity(), turns).vertices.sum().backward()
assert turns.grad is not None
assert "torch._dynamo" not in sys.modules
"""


@pytest.mark.parametrize("kernels", ["warp", pytest.param("torch", marks=pytest.mark.slow)])
def test_a_first_body_and_its_gradient_import_no_compiler(kernels):
    done = subprocess.run(
        [sys.executable, "-c", CALLED.format(kernels=kernels)], capture_output=True, text=True
    )
    assert not done.returncode, done.stderr


@pytest.mark.parametrize("kept", [{}, {"_backend_fns": []}, {"_backend_fns": {"cpu": torch.neg}}])
def test_another_torch_gets_an_ordinary_operator(kept, monkeypatch):
    made = SimpleNamespace(**kept)
    monkeypatch.setattr(torch.library, "custom_op", lambda name, mutates_args: lambda function: made)
    assert operator("soma_core::tested")(torch.neg) is made
    assert vars(made) == kept


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
def test_compiled_code_is_kept_out_of_an_operator():
    seen = []

    @operator("soma_core::tested_inside")
    def inside(x: Tensor) -> Tensor:
        seen.append(torch.compiler.is_compiling())
        return torch.from_numpy(x.numpy() + 1)

    @inside.register_fake
    def _(x: Tensor) -> Tensor:
        return torch.empty_like(x)

    x = torch.tensor([2.0])
    assert inside(x) == 3
    compiled = torch.compile(lambda x: inside(2 * x), backend="eager", fullgraph=True)
    assert compiled(x) == 5
    torch.library.opcheck(inside, (x,))
    assert seen
    assert not any(seen)
    torch._dynamo.reset()
