"""Checks of the parameters: each with an effect, optional where it has a group, differentiable."""

from __future__ import annotations

import torch
from torch import Tensor

from soma_core.testing.conformance import CheckFailedError, check
from soma_core.testing.context import Context
from soma_core.testing.samples import Change, changed_rows, entry_changes, near_defaults

__all__ = ["CHECKS"]

_EFFECT_M = 1e-6
"""Metres. A parameter whose whole range moves no vertex by a thousandth of a millimetre does nothing."""

_STEP = 1e-5
"""Part of the range that a finite difference steps to either side: its error is about 1e-10 of the value."""
_SLOPE = 1e-4
"""Error of a derivative, relative to the largest of its parameter: far below a wrong one."""

_GRADIENT_ENTRIES = 8
"""Entries of a vector whose derivatives are measured."""


def _no_parameters(context: Context) -> str:
    return "" if context.parameters else "the backend has no parameters"


@check("parameters", needs=("batch-invariant",), unless=_no_parameters)
def parameters(context: Context) -> None:
    """Every entry of every parameter changes the body."""
    with torch.no_grad():
        default = context.generator.rest(context.default_params())[0]
    changes = entry_changes(context.parameters, to="inner")
    idle = [
        str(change).partition("=")[0]
        for change, body in context.generated(changes)
        if context.metres * (body - default).norm(dim=-1).max() <= _EFFECT_M
    ]
    if idle:
        shown = ", ".join(idle[:3]) + (f" and {len(idle) - 3} more" if len(idle) > 3 else "")
        raise CheckFailedError(
            f"the parameter {shown}",
            got="the default body over most of the range",
            expected=f"a vertex that moves by more than {1000 * _EFFECT_M:g} mm",
            fix="Use the parameter in rest(), or take it out of the declaration.",
        )


def _no_groups(context: Context) -> str:
    grouped = any(item.group for item in context.parameters)
    return "" if grouped else "no parameter that the generator takes has a group"


@check("group-defaults", level="core", needs=("deterministic",), unless=_no_groups)
def group_defaults(context: Context) -> None:
    """A parameter of a group that is left out counts as its default."""
    with torch.no_grad():
        default = context.generator.rest(context.default_params())[0]
    grouped = [item for item in context.parameters if item.group]
    changes = [Change(item, (0,) * len(item.shape), item.default) for item in grouped]
    for change in changes:
        rows = changed_rows(context.parameters, [change], dtype=torch.float64)
        with torch.no_grad():
            distance = context.metres * (context.generator.rest(rows)[0] - default).norm(dim=-1)
        if not distance.max() <= _EFFECT_M:
            raise CheckFailedError(
                f"the parameter {change.parameter.name}",
                got=f"a body {1000 * float(distance.max()):.3g} mm away when {change} is given",
                expected="the body without it",
                fix="Let rest() take a missing parameter of a group as its declared default.",
            )


@check("gradient", needs=("batch-invariant", "inputs-unchanged"), unless=_no_parameters)
def gradient(context: Context) -> None:
    """Bodies are differentiable in every parameter."""
    start = near_defaults(context.parameters, dtype=torch.float64)
    with torch.no_grad():
        cotangent = torch.randn(
            context.generator.rest(start).shape,
            generator=torch.Generator(device="cpu").manual_seed(0), dtype=torch.float64, device="cpu",
        )  # fmt: skip

    def pull(params: dict[str, Tensor]) -> Tensor:
        return (context.generator.rest(params) * cotangent).flatten(1).sum(1)

    leaves = {name: value.clone().requires_grad_() for name, value in start.items()}
    with torch.enable_grad():
        value = pull({name: leaf * 1 for name, leaf in leaves.items()}).sum()
        if value.requires_grad:
            value.backward()
    for item in context.parameters:
        found = torch.zeros(item.shape, dtype=torch.float64)
        if leaves[item.name].grad is not None:
            found = leaves[item.name].grad[0]
        if not found.numel():
            continue
        entries = [change.entry for change in entry_changes([item], to="far", limit=_GRADIENT_ENTRIES)]
        step = _STEP * (item.range[1] - item.range[0])
        rows = {
            name: value.repeat(2 * len(entries), *[1] * (value.ndim - 1)) for name, value in start.items()
        }
        for index, entry in enumerate(entries):
            rows[item.name][(2 * index, *entry)] += step
            rows[item.name][(2 * index + 1, *entry)] -= step
        with torch.no_grad():
            ends = pull(rows)
        expected = (ends[0::2] - ends[1::2]) / (2 * step)
        got = torch.stack([found[entry] for entry in entries])
        error = (got - expected).abs()
        if not error.max() <= _SLOPE * expected.abs().max():
            worst = int(error.argmax())
            raise CheckFailedError(
                f"derivative by {str(Change(item, entries[worst], 0)).partition('=')[0]}",
                got=f"{float(got[worst]):.6g}",
                expected=f"{float(expected[worst]):.6g}, the finite difference of a sum of coordinates",
                fix="Compute in torch from the parameters to the vertices, without detach, .data or NumPy.",
            )


CHECKS = (parameters, group_defaults, gradient)
