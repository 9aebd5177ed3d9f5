"""Whether a derivative or a batch of another kind than reverse mode is at work."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad

__all__ = ["exporting", "transformed", "untracked"]


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
