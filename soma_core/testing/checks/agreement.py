"""Checks of the generator against what else describes its bodies: the wrap pair and the linear basis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.plugin.checks import CheckFailedError, check
from soma_core.plugin.spec import HasLinearBasis, LinearBasis
from soma_core.testing.context import Context

__all__ = ["CHECKS"]

_OBJ_M = 1e-4
"""Metres. Files with four decimals of a metre, or two of a centimetre, keep a tenth of a millimetre."""

_SLOPE = 1e-6
"""Relative difference of derivatives; float64 sums over some hundred directions."""

_LINEAR_M = 1e-6
"""Metres. float64 sums over some hundred directions; far below what a file or float32 keeps."""


def _no_pair(context: Context) -> str:
    return "there is no wrap pair" if context.spec.wrap is None else ""


@check(
    "neutral-equals-obj",
    mend="write `native.obj` from the default body",
    level="core",
    needs=("deterministic",),
    unless=_no_pair,
)
def neutral_equals_obj(context: Context) -> None:
    """The default body is the native OBJ, up to where it stands."""
    with torch.no_grad():
        native = context.generator.rest(context.default_params())[0].numpy()
    body = native @ context.native_frame.T
    file = context.wrap.native @ context.wrap_frame.T
    distance = np.linalg.norm((body - body.mean(0)) - (file - file.mean(0)), axis=1)
    worst = int(distance.argmax())
    if not distance[worst] <= _OBJ_M:
        sizes = " by ".join(f"{np.ptp(mesh, axis=0).max():.4g}" for mesh in (body, file))
        raise CheckFailedError(
            f"native vertex {worst} of the default body",
            got=f"{1000 * distance[worst]:.2f} mm from {context.wrap.native_path} (extents {sizes} m)",
            expected=f"at most {1000 * _OBJ_M:.1f} mm",
            fix="Write the OBJ from the generator's default body, in its unit, axes and vertex order; "
            "declare wrap_up and wrap_forward where the file has other axes.",
        )


def _not_linear(context: Context) -> str:
    return "" if isinstance(context.generator, HasLinearBasis) else "the generator offers no linear basis"


@check(
    "linear-basis",
    mend="`template + coefficients @ basis` must be `rest()`",
    level="core",
    needs=("batch-invariant", "inputs-unchanged"),
    unless=_not_linear,
)
def linear_basis(context: Context) -> None:
    """The linear basis gives the same bodies as the generator, and the same derivatives."""
    params = context.random_params() or context.default_params()
    assert isinstance(context.generator, HasLinearBasis)
    with torch.no_grad():
        linear: Any = context.generator.linear_basis()
        if not isinstance(linear, LinearBasis):
            raise CheckFailedError(
                "linear_basis()", got=type(linear).__name__, expected="a LinearBasis",
                fix="Return soma_core.plugin.LinearBasis.",
            )  # fmt: skip
        found = linear.template + torch.einsum("bk,knc->bnc", linear.coefficients(params), linear.basis)
        distance = context.metres * (found - context.generator.rest(params)).norm(dim=-1)
    if not distance.max() <= _LINEAR_M:
        row, vertex = divmod(int(distance.argmax()), distance.shape[1])
        raise CheckFailedError(
            f"linear_basis(), native vertex {vertex} of random body {row}",
            got=f"{1000 * float(distance.max()):.4f} mm from rest()",
            expected=f"at most {1000 * _LINEAR_M:.3f} mm",
            fix="Return template, basis and coefficients with template + coefficients @ basis = rest().",
        )
    _compare_slopes(context, linear, params)


def _compare_slopes(context: Context, linear: LinearBasis, params: Mapping[str, Tensor]) -> None:
    """Refuse coefficients that lose the derivative that rest() has: layers are composed of them."""
    random = torch.Generator(device="cpu").manual_seed(0)
    cotangent = torch.randn(linear.template.shape, generator=random, dtype=torch.float64, device="cpu")

    def slopes(body: Callable[[dict[str, Tensor]], Tensor]) -> dict[str, Tensor]:
        leaves = {name: value.clone().requires_grad_() for name, value in params.items()}
        with torch.enable_grad():
            total = (body({name: leaf * 1 for name, leaf in leaves.items()}) * cotangent).sum()
            if total.requires_grad:
                total.backward()
        return {
            name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()
        }

    wanted = slopes(context.generator.rest)
    found = slopes(
        lambda given: linear.template + torch.einsum("bk,knc->bnc", linear.coefficients(given), linear.basis)
    )
    for name, slope in wanted.items():
        largest = float(slope.abs().max())  # where rest() has no derivative, `gradient` tells
        if largest and not torch.allclose(found[name], slope, rtol=0, atol=_SLOPE * largest):
            worst = int((found[name] - slope).abs().argmax())
            raise CheckFailedError(
                f"derivative of linear_basis() by {name}",
                got=f"{float(found[name].flatten()[worst]):.6g}",
                expected=f"{float(slope.flatten()[worst]):.6g}, that of rest()",
                fix="Compute coefficients in torch, without detach, .data, NumPy or no_grad.",
            )


CHECKS = (neutral_equals_obj, linear_basis)
