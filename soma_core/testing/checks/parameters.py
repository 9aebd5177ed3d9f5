"""Checks of the parameters: each with an effect, optional where it has a group, differentiable."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import torch
from torch import Tensor

from soma_core.plugin.checks import CheckFailedError, check
from soma_core.testing.context import Context
from soma_core.testing.samples import Change, changed_rows, entry_changes, near_defaults

__all__ = ["CHECKS"]

_EFFECT_M = 1e-6
"""Metres. A parameter whose whole range moves no vertex by a thousandth of a millimetre does nothing."""

_STEP = 1e-5
"""Part of the range that a finite difference steps to either side: its error is about 1e-10 of the value."""
_SLOPE = 1e-4
"""Error of a derivative, relative to the largest of its parameter: far below a wrong one."""

_ROUNDING = 1e-13
"""Rounding of a float64 sum of coordinates, relative to the sum of their sizes; a difference shows it."""

_GRADIENT_ENTRIES = 8
"""Entries of a vector whose derivatives are measured."""

_CHUNK = 16
"""Derivatives measured at a time, to bound memory."""

Pull: TypeAlias = Callable[[Mapping[str, Tensor]], Tensor]
"""A scalar of each body: parameters (batch, ...) to (batch,)."""


def _no_parameters(context: Context) -> str:
    return "" if context.parameters else "the backend has no parameters"


@check("parameters", mend="use it, or take it out", needs=("batch-invariant",), unless=_no_parameters)
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


@check(
    "group-defaults",
    mend="`params.get(name)` with the declared default",
    level="core",
    needs=("deterministic",),
    unless=_no_groups,
)
def group_defaults(context: Context) -> None:
    """A parameter of a group that is left out counts as its default."""
    with torch.no_grad():
        default = context.generator.rest(context.default_params())[0]
        given = context.generator.rest(changed_rows(context.parameters, _kept(context), dtype=torch.float64))
    if context.metres * (given - default).norm(dim=-1).max() <= _EFFECT_M:
        return
    for change in _kept(context):
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


def _kept(context: Context) -> list[Change]:
    """Each parameter of a group, given at its default."""
    grouped = [item for item in context.parameters if item.group and 0 not in item.shape]
    return [Change(item, (0,) * len(item.shape), item.default) for item in grouped]


@check(
    "gradient",
    mend="stay in torch; no `detach`, `.data`, NumPy",
    needs=("batch-invariant", "inputs-unchanged", "no-global-state"),
    unless=_no_parameters,
)
def gradient(context: Context) -> None:
    """Bodies are differentiable in every parameter."""
    start = near_defaults(context.parameters, dtype=torch.float64)
    with torch.no_grad():
        body = context.generator.rest(start)
    random = torch.Generator(device="cpu").manual_seed(0)
    cotangent = torch.randn(body.shape, generator=random, dtype=torch.float64, device="cpu")

    def pull(params: Mapping[str, Tensor]) -> Tensor:
        return (context.generator.rest(params) * cotangent).flatten(1).sum(1)

    _finite_at_defaults(pull, context)
    _slopes(pull, start)  # a graph that outlives its call shows in the next one
    changes = entry_changes(context.parameters, to="far", limit=_GRADIENT_ENTRIES)
    slopes = _slopes(pull, start)
    got = torch.stack([slopes[change.parameter.name][change.entry] for change in changes])
    expected = torch.cat([
        _differences(pull, start, changes[first : first + _CHUNK]) for first in range(0, len(changes), _CHUNK)
    ])  # fmt: skip
    largest = dict.fromkeys(start, 0.0)
    for change, value in zip(changes, expected.abs().tolist(), strict=True):
        largest[change.parameter.name] = max(largest[change.parameter.name], value)
    allowed = _SLOPE * torch.tensor(
        [largest[change.parameter.name] for change in changes], dtype=torch.float64
    )
    rounding = _ROUNDING * (body * cotangent).abs().sum() / _widths(changes)
    wrong = torch.nonzero(~((got - expected).abs() <= allowed + rounding)).flatten().tolist()
    if wrong:
        raise CheckFailedError(
            f"derivative by {str(changes[wrong[0]]).partition('=')[0]}",
            got=f"{float(got[wrong[0]]):.6g}",
            expected=f"{float(expected[wrong[0]]):.6g}, the finite difference of a sum of coordinates",
            fix="Compute in torch from the parameters to the vertices, without detach, .data or NumPy.",
        )


def _finite_at_defaults(pull: Pull, context: Context) -> None:
    """At the defaults, where a fit begins, a root or a norm of zero has no derivative."""
    for name, slope in _slopes(pull, context.default_params()).items():
        if not torch.isfinite(slope).all():
            raise CheckFailedError(
                f"derivative by {name} at the defaults",
                got=f"{float(slope[~torch.isfinite(slope)][0]):g}",
                expected="a finite number: a fit begins there",
                fix="Guard the root, norm, division or angle that has no derivative there.",
            )


def _widths(changes: Sequence[Change]) -> Tensor:
    """Distance of the two ends of each finite difference, (c,)."""
    ranges = torch.tensor([change.parameter.range for change in changes], dtype=torch.float64)
    return 2 * _STEP * (ranges[:, 1] - ranges[:, 0])


def _slopes(pull: Pull, start: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Derivative of ``pull`` by each parameter, of the parameter's shape; zero where autograd knows none."""
    leaves = {name: value.clone().requires_grad_() for name, value in start.items()}
    with torch.enable_grad():
        total = pull({name: leaf * 1 for name, leaf in leaves.items()}).sum()
        if total.requires_grad:
            total.backward()
    return {
        name: (torch.zeros_like(leaf) if leaf.grad is None else leaf.grad)[0] for name, leaf in leaves.items()
    }


def _differences(pull: Pull, start: Mapping[str, Tensor], changes: Sequence[Change]) -> Tensor:
    """Central finite differences of ``pull`` by the entries that `changes` name."""
    rows = {name: value.repeat(2 * len(changes), *[1] * (value.ndim - 1)) for name, value in start.items()}
    for index, (change, width) in enumerate(zip(changes, _widths(changes), strict=True)):
        rows[change.parameter.name][(2 * index, *change.entry)] += width / 2
        rows[change.parameter.name][(2 * index + 1, *change.entry)] -= width / 2
    with torch.no_grad():
        ends = pull(rows)
    return (ends[0::2] - ends[1::2]) / _widths(changes)


CHECKS = (parameters, group_defaults, gradient)
