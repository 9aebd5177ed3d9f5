"""A check of the plugin's own."""

from __future__ import annotations

import torch

from soma_core.plugin import CheckFailedError, check


@check("taller", level="core", needs=("finite",))
def taller(context):
    """A larger size is a taller body."""
    params = context.default_params(2) | {"size": torch.tensor([1.0, 1.1], dtype=torch.float64)}
    height = torch.aminmax(context.generator.rest(params)[..., 2], dim=1)
    small, large = (height.max - height.min).tolist()
    if not large > small:
        raise CheckFailedError(
            "size=1.1",
            got=f"{large:g} cm",
            expected=f"more than {small:g} cm",
            fix="Let size scale the body.",
        )
