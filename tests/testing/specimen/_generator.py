"""Template and directions as formulas of the template."""

from __future__ import annotations

import torch

from soma_core.plugin import LinearBasis, read_obj


class Specimen:
    """Rest vertices [cm], +Z up, facing -Y."""

    def __init__(self, path, strength, *, device, dtype):
        template = torch.as_tensor(read_obj(path)[0])
        x, y, z = template.T / 100
        zero = torch.zeros_like(x)
        bump = torch.exp(-((z - 1) ** 2 + x**2) / 0.02)
        fields = [
            template,
            100 * torch.stack((0.1 * x, zero, zero), 1),
            100 * torch.stack((zero, 0.2 * y, zero), 1),
            100 * torch.stack((zero, zero, 0.04 * z), 1),
            100 * torch.stack((0.02 * x * torch.sin(3 * z), 0.02 * y * torch.cos(3 * z), zero), 1),
            100 * torch.stack((zero, -0.03 * strength * bump, zero), 1),
        ]
        self.template = template.to(device=device, dtype=dtype)
        self.fields = torch.stack(fields).to(device=device, dtype=dtype)

    def coefficients(self, params):
        """(batch, 6): logarithm of size, shape saturating at the ends, belly."""
        size = params["size"]
        belly = params.get("belly", torch.zeros_like(size))
        return torch.cat((size.log()[:, None], torch.tanh(params["shape"] / 3), belly[:, None]), 1)

    def rest(self, params):
        """(batch, n, 3)."""
        coefficients = self.coefficients(params)
        return self.template + torch.einsum("bk,knc->bnc", coefficients, self.fields)

    def linear_basis(self):
        """The same, as template, basis and coefficients."""
        return LinearBasis(template=self.template, basis=self.fields, coefficients=self.coefficients)
