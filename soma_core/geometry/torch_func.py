"""Whether a derivative or a batch of another kind than reverse mode is at work; operators of this project."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

__all__ = ["exporting", "operator", "transformed", "untracked"]


def transformed() -> bool:
    """Whether ``torch.func`` or forward-mode differentiation is at work, outside ``torch.compile``.

    Operators that torch knows from outside have reverse-mode derivatives alone, and forward mode takes their
    results for constants without a word; plain torch stands in for them then. torch.compile in turn takes
    no function that has a forward-mode derivative of its own. (Both: torch 2.4 to 2.13, which have no public
    question either.)
    """
    if torch.compiler.is_compiling():
        return False
    return forward_ad._current_level >= 0 or torch._C._are_functorch_transforms_active()


def exporting() -> bool:
    """Whether ``torch.export`` follows what is computed; torch before 2.7 does not say."""
    return getattr(torch.compiler, "is_exporting", bool)()


def untracked(*given: Tensor | None) -> bool:
    """Whether no derivative, transform or compiler follows what is computed from these tensors."""
    if torch.compiler.is_compiling() or transformed():
        return False
    return not (torch.is_grad_enabled() and any(part is not None and part.requires_grad for part in given))


def operator(name: str) -> Callable[[Callable[..., Any]], Any]:
    """``torch.library.custom_op`` without writes to its arguments, that starts without PyTorch's compiler.

    The first call of any such operator imports ``torch._dynamo``, for two seconds of computing, to keep it
    out of the operator's code. Where nothing else has imported it there is nothing to keep out. Releases of
    torch that keep their implementations elsewhere get an ordinary operator. (torch 2.5 to 2.13,
    https://github.com/pytorch/pytorch/blob/v2.9.0/torch/_library/custom_ops.py.)
    """

    def registered(function: Callable[..., Any]) -> Any:
        made = torch.library.custom_op(name, mutates_args=())(function)
        kept = getattr(made, "_backend_fns", None)
        if isinstance(kept, dict) and callable(kept_out := kept.get(None)):
            kept[None] = lambda *given, **keywords: (
                kept_out if "torch._dynamo" in sys.modules else function
            )(*given, **keywords)
        return made

    return registered
