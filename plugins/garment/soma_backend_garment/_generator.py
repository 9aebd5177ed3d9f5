"""The generator: mean plus scaled components."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from soma_backend_garment._point_pca import PointSpace
from soma_core.plugin import LinearBasis

__all__ = ["GarmentGenerator"]


class GarmentGenerator:
    """Bodies of the shape space; metres, +Y up, facing +Z."""

    def __init__(self, space: PointSpace, device: torch.device, dtype: torch.dtype) -> None:
        basis = (space.matrix * space.scales).T.reshape(len(space.scales), -1, 3)
        self._template = torch.as_tensor(space.mean.reshape(-1, 3), dtype=dtype, device=device)
        self._basis = torch.as_tensor(basis, dtype=dtype, device=device)

    def rest(self, params: Mapping[str, Tensor]) -> Tensor:
        """Vertices (batch, v, 3) [m], in the order of ``mean.obj``."""
        return self._template + torch.einsum("bk,kvc->bvc", params["coefficients"], self._basis)

    def linear_basis(self) -> LinearBasis:
        """The mean and the components."""
        return LinearBasis(
            template=self._template, basis=self._basis, coefficients=lambda params: params["coefficients"]
        )
