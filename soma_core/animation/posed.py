"""The result of the forward path: a posed body."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

__all__ = ["Posed"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Posed:
    """Posed vertices and joints, metres, +Y up.

    Attributes:
        vertices: (batch, v, 3) [m].
        joints: world positions of the user joints, Root excluded, (batch, J - 1, 3) [m].
        transforms: world transforms of all joints, (batch, J, 4, 4) [m].
    """

    vertices: Tensor
    joints: Tensor
    transforms: Tensor
