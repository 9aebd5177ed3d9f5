"""Constants of a module: what it is moved with, and no state dict holds."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
import torch
from torch import Tensor

__all__ = ["Kind", "constant"]


class Kind(TypedDict):
    """What constants are kept as."""

    dtype: torch.dtype
    device: torch.device | str


def constant(
    value: np.ndarray | Tensor, *, device: torch.device | str, dtype: torch.dtype | None = None
) -> Tensor:
    """Make a buffer of `value`, which a module takes as an attribute and leaves out of its state dict.

    Args:
        dtype: of real numbers; whole ones are int64 then. None leaves both as they are.
    """
    tensor = torch.as_tensor(np.array(value, order="C")) if isinstance(value, np.ndarray) else value
    if dtype is not None and tensor.dtype != torch.bool:
        tensor = tensor.to(dtype if tensor.is_floating_point() else torch.int64)
    return torch.nn.Buffer(tensor.to(device), persistent=False)
