"""Checks of what the generator returns: shape, dtype, device, finite vertices."""

from __future__ import annotations

import itertools
import re

import torch

from soma_core.errors import InputError
from soma_core.plugin.checks import CheckFailedError, CheckNotRunError, check
from soma_core.testing.context import CPU, Context
from soma_core.testing.samples import at_range_ends

__all__ = ["CHECKS"]

_BATCH = 3


@check(
    "generator-builds",
    mend="the cause is in the message",
    level="core",
    needs=("declares", "options", "wrap-reads", "wrap-count", "parameter-defaults"),
)
def generator_builds(context: Context) -> None:
    """The generator builds with default options and generates a body."""
    with torch.no_grad():
        context.generator.rest(context.default_params())


@check(
    "generator-shape",
    mend="return all vertices, in the order of the file, for each row",
    level="core",
    needs=("generator-builds",),
)
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


@check(
    "generator-dtype", mend="make constants with the dtype given", level="core", needs=("generator-shape",)
)
def generator_dtype(context: Context) -> None:
    """The generator computes in the dtype that it was built for."""
    for dtype, default in itertools.product((torch.float32, torch.float64), repeat=2):
        torch.set_default_dtype(default)  # the user's, whatever it is; put back after each check
        with torch.no_grad():
            found = context.new_generator(dtype=dtype).rest(context.default_params(dtype=dtype)).dtype
        if found != dtype:
            raise CheckFailedError(
                f"rest() of a generator built with dtype={dtype}, under the default dtype {default}",
                got=found,
                expected=dtype,
                fix="Make every constant with the dtype that soma_generator is given.",
            )


@check(
    "generator-device", level="core", needs=("generator-dtype",), mend="make constants on the device given"
)
def generator_device(context: Context) -> None:
    """The generator computes on the CPU where it was built for it."""
    _compare_device(context, CPU)


def _compare_device(context: Context, device: torch.device) -> None:
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


_OF_TWO_DEVICES = re.compile(
    r"two devices|same device|expected (on )?(device )?meta|not on the expected device"
)


@check("other-device", level="core", needs=("generator-device",), mend="make constants on the device given")
def other_device(context: Context) -> None:
    """The generator computes on another device: a GPU, or torch's meta device without one."""
    if torch.cuda.is_available():
        _compare_device(context, torch.device("cuda", torch.cuda.current_device()))
        return
    try:
        _compare_device(context, torch.device("meta"))
    except (CheckFailedError, InputError):
        raise
    except Exception as error:
        told = " ".join(str(error).split())
        if not _OF_TWO_DEVICES.search(told):
            raise CheckNotRunError(
                f"no GPU is here, and torch's meta device, which stands in, cannot run this: {told:.150}"
            ) from error
        raise CheckFailedError(
            "rest() of a generator built for another device than the CPU",
            got=f"tensors of two devices ({told:.150})",
            expected="all of them on the device given",
            fix="Make every constant on the device that soma_generator is given.",
        ) from error


@check(
    "finite",
    mend="narrow the range, or guard the division, root or logarithm",
    level="core",
    needs=("generator-device",),
)
def finite(context: Context) -> None:
    """Bodies are finite over the declared ranges, their ends included."""
    with torch.no_grad():
        middle = context.generator.rest(context.random_params() or context.default_params())
    tried = [("the default body", context.generator.rest(context.default_params())[0].detach())]
    tried += [(f"random body {row}", body) for row, body in enumerate(middle)]
    tried += [(str(change), body) for change, body in context.generated(at_range_ends(context.parameters))]
    for label, body in tried:
        bad = ~torch.isfinite(body).all(-1)
        if bad.any():
            raise CheckFailedError(
                f"rest() at {label}, native vertex {int(bad.nonzero()[0, 0])}",
                got=f"{int(bad.sum())} vertices that are not finite",
                expected="finite vertices over the whole declared range",
                fix="Narrow the range of the parameter, or guard the logarithm, root or division.",
            )


CHECKS = (generator_builds, generator_shape, generator_dtype, generator_device, other_device, finite)
