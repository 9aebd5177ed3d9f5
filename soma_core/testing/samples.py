"""Parameter values that checks try: defaults, ends of ranges one at a time, and random identities."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from soma_core.plugin.spec import Parameter

__all__ = ["Change", "at_range_ends", "changed_rows", "entry_changes", "near_defaults", "random_rows"]

_ENTRIES_AT_ENDS = 16
"""Entries of a vector that are taken to the ends of the range: the leading components move a body most."""

_RANGE_IN_DEVIATIONS = 3.0
"""Standard deviations between the middle and an end of a vector's range, as in a shape space."""

_INNER = 0.8
"""Part of a scalar's range that random identities fill; the ends have checks of their own."""


@dataclass(frozen=True)
class Change:
    """One entry of one parameter set to a value; all others have their defaults."""

    parameter: Parameter
    entry: tuple[int, ...]
    value: float

    def __str__(self) -> str:
        index = "".join(f"[{number}]" for number in self.entry)
        return f"{self.parameter.name}{index}={self.value:g}"


def _entries(parameter: Parameter, limit: int | None = None) -> Iterator[tuple[int, ...]]:
    return itertools.islice(itertools.product(*map(range, parameter.shape)), limit)


def entry_changes(
    parameters: Sequence[Parameter], *, to: Literal["far", "inner"], limit: int | None = None
) -> list[Change]:
    """Each entry of each parameter, taken alone towards the end of its range further from the default.

    ``far`` is the end itself, ``inner`` two thirds of the way to it.
    """
    share = {"far": 1.0, "inner": 2 / 3}[to]
    return [
        Change(item, entry, item.default + share * (_far_end(item) - item.default))
        for item in parameters
        for entry in _entries(item, limit)
    ]


def _far_end(item: Parameter) -> float:
    low, high = item.range
    return high if high - item.default >= item.default - low else low


def at_range_ends(parameters: Sequence[Parameter]) -> list[Change]:
    """Each scalar, and the leading entries of each vector, taken alone to both ends of its range."""
    return [
        Change(item, entry, end)
        for item in parameters
        for entry in _entries(item, _ENTRIES_AT_ENDS)
        for end in item.range
    ]


def changed_rows(
    parameters: Sequence[Parameter], changes: Sequence[Change], *, dtype: torch.dtype
) -> dict[str, Tensor]:
    """One row a change. Grouped parameters are left out unless a change is theirs, as the contract allows."""
    touched = {change.parameter.name for change in changes}
    rows = {
        item.name: torch.full((len(changes), *item.shape), item.default, dtype=dtype)
        for item in parameters
        if not item.group or item.name in touched
    }
    for row, change in enumerate(changes):
        rows[change.parameter.name][(row, *change.entry)] = change.value
    return rows


def near_defaults(parameters: Sequence[Parameter], *, dtype: torch.dtype) -> dict[str, Tensor]:
    """One body near the default, every entry off it: at the default itself piecewise models have kinks."""
    random = torch.Generator(device="cpu").manual_seed(0)
    return {
        item.name: item.default
        + (_far_end(item) - item.default)
        * (0.05 + 0.1 * torch.rand((1, *item.shape), generator=random, dtype=dtype, device="cpu"))
        for item in parameters
    }


def random_rows(
    parameters: Sequence[Parameter], count: int, *, seed: int, dtype: torch.dtype
) -> dict[str, Tensor]:
    """Random identities inside the ranges, the same on every machine.

    Scalars are uniform, vectors normal with the range at three standard deviations. Of each group one
    parameter an identity leaves its default: all of hundreds at once would be no body.
    """
    random = torch.Generator(device="cpu").manual_seed(seed)
    rows: dict[str, Tensor] = {}
    members: dict[str, list[Parameter]] = {}
    for item in parameters:
        members.setdefault(item.group, []).append(item)
        rows[item.name] = _random(item, count, random).to(dtype)
    for group, items in members.items():
        if group:
            chosen = torch.randint(len(items), (count,), generator=random, device="cpu")
            for index, item in enumerate(items):
                rows[item.name][chosen != index] = item.default
    return rows


def _random(item: Parameter, count: int, random: torch.Generator) -> Tensor:
    (low, high), shape = item.range, (count, *item.shape)
    middle, half = (low + high) / 2, (high - low) / 2
    if math.prod(item.shape) == 1:
        uniform = 2 * torch.rand(shape, generator=random, dtype=torch.float64, device="cpu") - 1
        return middle + _INNER * half * uniform
    normal = torch.randn(shape, generator=random, dtype=torch.float64, device="cpu")
    return middle + half * (normal / _RANGE_IN_DEVIATIONS).clamp(-1, 1)
