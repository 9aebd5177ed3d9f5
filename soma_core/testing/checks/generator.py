"""Checks of what the generator returns: shape, dtype, device, and the default body."""

from __future__ import annotations

import numpy as np
import torch

from soma_core.plugin.spec import HasLinearBasis
from soma_core.testing.check import CheckFailedError, check
from soma_core.testing.context import CPU, Context

__all__ = ["CHECKS"]

_OBJ_M = 1e-4
"""Metres. Files with four decimals of a metre, or two of a centimetre, keep a tenth of a millimetre."""

_LINEAR_M = 1e-6
"""Metres. float64 sums over some hundred directions; far below what a file or float32 keeps."""

_BATCH = 3


@check(
    "generator-builds",
    level="core",
    needs=("declares", "options", "wrap-reads", "wrap-count", "parameter-defaults"),
)
def generator_builds(context: Context) -> None:
    """The generator builds with default options and generates a body."""
    with torch.no_grad():
        context.generator.rest(context.default_params())


@check("generator-shape", level="core", needs=("generator-builds",))
def generator_shape(context: Context) -> None:
    """The generator returns as many vertices as the native OBJ has, (batch, n, 3)."""
    for count in (1, _BATCH) if context.default_params() else (1,):
        with torch.no_grad():
            found = context.generator.rest(context.default_params(count))
        expected = (count, context.native_count, 3)
        if not isinstance(found, torch.Tensor) or tuple(found.shape) != expected:
            of = "the native OBJ" if context.spec.wrap else "the canonical mesh"
            raise CheckFailedError(
                f"rest() of a batch of {count}",
                got=tuple(found.shape) if isinstance(found, torch.Tensor) else type(found).__name__,
                expected=f"a tensor of shape {expected}, with the vertices of {of}",
                fix="Return every vertex, in the order of that file, for every row of the parameters.",
            )


@check("generator-dtype", level="core", needs=("generator-shape",))
def generator_dtype(context: Context) -> None:
    """The generator computes in the dtype that it was built for."""
    asked = (torch.float32, torch.float64)
    generators = [context.new_generator(dtype=dtype) for dtype in asked]
    for dtype, generator in zip(asked, generators, strict=True):
        with torch.no_grad():
            found = generator.rest(context.default_params(dtype=dtype)).dtype
        if found != dtype:
            raise CheckFailedError(
                f"rest() of a generator built with dtype={dtype}",
                got=found,
                expected=dtype,
                fix="Make every constant with the dtype that soma_generator is given.",
            )


def _devices() -> list[torch.device]:
    return [CPU, *([torch.device("cuda", torch.cuda.current_device())] if torch.cuda.is_available() else [])]


@check("generator-device", level="core", needs=("generator-shape",))
def generator_device(context: Context) -> None:
    """The generator computes on the device that it was built for, CPU or GPU."""
    for device in _devices():
        generator = context.new_generator(device=device)
        params = {name: value.to(device) for name, value in context.default_params().items()}
        with torch.no_grad():
            found = generator.rest(params).device
        if found != device:
            raise CheckFailedError(
                f"rest() of a generator built with device={device}",
                got=found,
                expected=device,
                fix="Make every constant on the device that soma_generator is given.",
            )


def _no_pair(context: Context) -> str:
    return "there is no wrap pair" if context.spec.wrap is None else ""


@check("neutral-equals-obj", level="core", needs=("generator-device", "finite"), unless=_no_pair)
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
            got=f"{1000 * distance[worst]:.2f} mm from {context.spec.wrap.native} (extents {sizes} m)",
            expected=f"at most {1000 * _OBJ_M:.1f} mm",
            fix="Write the OBJ from the generator's default body, in its unit, axes and vertex order; "
            "declare wrap_up and wrap_forward where the file has other axes.",
        )


def _not_linear(context: Context) -> str:
    return "" if isinstance(context.generator, HasLinearBasis) else "the generator offers no linear basis"


@check("linear-basis", level="core", needs=("generator-device", "finite"), unless=_not_linear)
def linear_basis(context: Context) -> None:
    """The linear basis gives the same bodies as the generator."""
    params = context.random_params() or context.default_params()
    assert isinstance(context.generator, HasLinearBasis)
    with torch.no_grad():
        linear = context.generator.linear_basis()
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


CHECKS = (
    generator_builds, generator_shape, generator_dtype, generator_device, neutral_equals_obj, linear_basis,
)  # fmt: skip
