"""From phenotypes to the weights of the MakeHuman macro targets.

Each phenotype is turned into weights of its named variations (piecewise linear between anchors, summing
to one). A macro target belongs to one combination of variations, and its weight is their product.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["ANCHORS", "BLOCKS", "RACES", "VARIATIONS", "Block", "macro_weights", "variation_weights"]

VARIATIONS: Mapping[str, tuple[str, ...]] = {
    "race": ("african", "asian", "caucasian"),
    "gender": ("male", "female"),
    "age": ("newborn", "baby", "child", "young", "old"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "maxheight"),
    "proportions": ("idealproportions", "uncommonproportions"),
    "cupsize": ("mincup", "averagecup", "maxcup"),
    "firmness": ("minfirmness", "averagefirmness", "maxfirmness"),
}
RACES = VARIATIONS["race"]
ANCHORS: Mapping[str, tuple[float, float]] = {
    name: (-1 / 3, 1.0) if name == "age" else (0.0, 1.0) for name in VARIATIONS if name != "race"
}
"""Values at the first and the last variation; the others lie at equal steps between."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """A family of macro targets: one for each combination of the variations of some phenotypes.

    Attributes:
        folder, prefix: where the files lie under ``targets`` and how their names begin.
        phenotypes: the phenotypes whose variations make up the rest of a name.
        first: first variation that exists, where it is not the first of all.
        newborn: whether newborns take the baby's target, reshaped.
    """

    folder: str
    prefix: str
    phenotypes: tuple[str, ...]
    first: Mapping[str, int]
    newborn: bool

    def combinations(self) -> Iterator[tuple[str, ...]]:
        """Names of the variations of each target, the last phenotype running fastest."""
        return itertools.product(*(VARIATIONS[name][self.first.get(name, 0) :] for name in self.phenotypes))


_BODY = ("gender", "age", "muscle", "weight")
_FROM_CHILD = {"age": 2}
BLOCKS = (
    Block(folder="macrodetails", prefix="universal-", phenotypes=_BODY, first={}, newborn=True),
    Block(folder="macrodetails", prefix="", phenotypes=("race", "gender", "age"), first={}, newborn=True),
    Block(folder="macrodetails/height", prefix="", phenotypes=(*_BODY, "height"), first={}, newborn=True),
    Block(
        folder="macrodetails/proportions",
        prefix="",
        phenotypes=(*_BODY, "proportions"),
        first=_FROM_CHILD,
        newborn=False,
    ),
    Block(
        folder="breast",
        prefix="",
        phenotypes=(*_BODY, "cupsize", "firmness"),
        first={"gender": 1, **_FROM_CHILD},
        newborn=False,
    ),
)


def variation_weights(name: str, value: Tensor) -> Tensor:
    """Weights (batch, variations) of one phenotype (batch,); they sum to one.

    Values beyond the anchors count as the nearest anchor. At an inner anchor the derivative is that
    of the interval below.
    """
    count = len(VARIATIONS[name])
    low, high = ANCHORS[name]
    step = (high - low) / (count - 1)
    position = (value.clamp(low, high) - low) / step
    # Compare anchors rather than positions: 0.5 must not slip into the next interval by rounding.
    inner = torch.linspace(low, high, count, dtype=value.dtype, device=value.device)[1:-1]
    interval = (value.detach()[:, None] > inner).sum(-1)
    fraction = (position - interval)[:, None]
    slots = torch.arange(count, device=value.device)
    lower = (slots == interval[:, None]).to(value.dtype)
    upper = (slots == interval[:, None] + 1).to(value.dtype)
    return lower * (1 - fraction) + upper * fraction


def _race_weights(values: Tensor) -> Tensor:
    """Shares (batch, 3) divided by their sum; equal parts where the sum is zero."""
    total = values.sum(-1, keepdim=True)
    empty = total == 0
    return torch.where(empty, torch.full_like(values, 1 / 3), values / torch.where(empty, 1.0, total))


def macro_weights(phenotypes: Mapping[str, Tensor]) -> Tensor:
    """Weights (batch, targets) of all macro targets, block by block in the order of `BLOCKS`.

    Args:
        phenotypes: all eleven phenotypes, each (batch,). Differentiable except at the anchors.
    """
    weights = {name: variation_weights(name, phenotypes[name]) for name in ANCHORS}
    weights["race"] = _race_weights(torch.stack([phenotypes[race] for race in RACES], dim=-1))
    return torch.cat([_block_weights(block, weights) for block in BLOCKS], dim=-1)


def _block_weights(block: Block, weights: Mapping[str, Tensor]) -> Tensor:
    product: Tensor | None = None
    for name in block.phenotypes:
        factor = weights[name][:, block.first.get(name, 0) :]
        # (batch, a) x (batch, b) -> (batch, a * b)
        product = factor if product is None else (product[:, :, None] * factor[:, None, :]).flatten(1)
    assert product is not None
    return product
