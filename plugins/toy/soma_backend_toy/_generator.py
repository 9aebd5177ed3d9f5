"""The generator: parameters in, vertices out. This is the only module that needs torch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from soma_backend_toy._figure import figure
from soma_core.plugin import LinearBasis

__all__ = ["ToyGenerator"]

_PROPORTIONS = ("girth", "legs", "arms", "shoulders", "head")


class ToyGenerator:
    """The figure, ``size`` times larger, with other proportions.

    The core asks only for :meth:`rest`. :meth:`linear_basis` is optional: a body that can say how it
    depends on its parameters through a few coefficients is composed with all later linear steps once.
    """

    def __init__(self, device: torch.device, dtype: torch.dtype) -> None:
        template = figure()
        # The figure is linear in its proportions, so one difference each tells all of it.
        changes = [figure(**{name: 2.0}) - template for name in _PROPORTIONS]
        self._template = torch.as_tensor(template, dtype=dtype, device=device)
        self._basis = torch.as_tensor(np.stack([template, *changes]), dtype=dtype, device=device)

    def rest(self, params: Mapping[str, Tensor]) -> Tensor:
        """Vertices (batch, n, 3) [cm], +Z up, facing -Y, in the order of ``native.obj``."""
        return self._template + torch.einsum("bk,knc->bnc", self._coefficients(params), self._basis)

    def linear_basis(self) -> LinearBasis:
        """The same as template, basis, and the function from parameters to coefficients."""
        return LinearBasis(template=self._template, basis=self._basis, coefficients=self._coefficients)

    def _coefficients(self, params: Mapping[str, Tensor]) -> Tensor:
        """Coefficients (batch, 6): size * figure = template + (size - 1) template + size * changes."""
        size = params["size"]
        return torch.stack([size - 1, *(size * (params[name] - 1) for name in _PROPORTIONS)], dim=1)
