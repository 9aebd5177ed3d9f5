"""Checks of the generator as a function: the same input gives the same body and nothing else changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from soma_core.plugin.checks import CheckFailedError, check
from soma_core.plugin.spec import Generator, HasLinearBasis
from soma_core.testing.context import Context
from soma_core.testing.global_state import changes, snapshot
from soma_core.testing.process_probe import KEPT, probe_process

__all__ = ["CHECKS"]

_SAME_M = 1e-9
"""Metres. The same float64 sums in another order, on bodies of two metres."""

_BODIES = 8
"""Bodies that another process makes."""


def _rest(generator: Generator, params: Mapping[str, Tensor]) -> Tensor:
    """Generate from copies, so that a generator which writes to its input disturbs no other call."""
    with torch.no_grad():
        return generator.rest({name: value.clone() for name, value in params.items()}).clone()


def _compare(context: Context, found: Tensor, expected: Tensor, where: str, fix: str) -> None:
    distance = context.metres * (found - expected).norm(dim=-1)
    if not distance.max() <= _SAME_M:
        raise CheckFailedError(
            f"{where}, native vertex {int(distance.argmax()) % distance.shape[-1]}",
            got=f"a body {1000 * float(distance.max()):.3g} mm away",
            expected=f"the same body to {1000 * _SAME_M:.0e} mm",
            fix=fix,
        )


def _no_parameters(context: Context) -> str:
    return "" if context.parameters else "the backend has no parameters"


@check(
    "deterministic",
    mend="keep no state between calls, draw nothing at random",
    level="core",
    needs=("finite",),
)
def deterministic(context: Context) -> None:
    """Equal parameters give equal bodies, whatever was generated before."""
    first, other = (context.random_params(2, seed=seed) or context.default_params() for seed in (1, 2))
    generator = context.new_generator()
    body = _rest(generator, first)
    fix = "Keep no state between calls and draw no random numbers."
    _compare(context, _rest(generator, first), body, "rest() called again", fix)
    second = _rest(generator, other)
    _compare(context, _rest(generator, first), body, "rest() called again after other parameters", fix)
    _compare(context, _rest(context.new_generator(), other), second, "rest() of a new generator", fix)
    with torch.no_grad():
        kept = generator.rest({name: value.clone() for name, value in first.items()})
    _rest(generator, other)
    again = "the result of rest(), once rest() was called again"
    anew = "Return new memory from each call, not a buffer that the next one fills, nor what the model keeps."
    _compare(context, kept, body, again, anew)
    for params in (first, context.default_params(len(body))):
        plain = _rest(generator, params)
        with torch.no_grad():
            made = generator.rest({name: value.clone() for name, value in params.items()})
        made.as_strided((made.untyped_storage().nbytes() // made.element_size(),), (1,), 0).fill_(0)
        again = "rest() called again, once its last result was written to"
        _compare(context, _rest(generator, params), plain, again, anew)


@check(
    "batch-invariant",
    mend="compute each row for itself",
    level="core",
    needs=("deterministic",),
    unless=_no_parameters,
)
def batch_invariant(context: Context) -> None:
    """Each body of a batch is the one it would be alone."""
    params = context.random_params()
    bodies = _rest(context.generator, params)
    fix = (
        "Treat the rows of a batch apart: no statistics, sorting or shared result over the first dimension; "
        "and compute in the dtype given."
    )
    for row in range(len(bodies)):
        alone = _rest(context.generator, {name: value[row : row + 1] for name, value in params.items()})
        _compare(context, bodies[row : row + 1], alone, f"random body {row} in a batch of {len(bodies)}", fix)


@check(
    "inputs-unchanged",
    mend="do not write in place",
    level="core",
    needs=("generator-device",),
    unless=_no_parameters,
)
def inputs_unchanged(context: Context) -> None:
    """The generator leaves the tensors that it is given as they are."""
    params = context.random_params()
    given = {name: value.clone() for name, value in params.items()}
    with torch.no_grad():
        context.generator.rest(given)
    for name, value in params.items():
        if name not in given or not torch.equal(given[name], value):
            raise CheckFailedError(
                f"params[{name!r}] after rest()",
                got="nothing" if name not in given else "other values",
                expected="the values that were passed",
                fix="Work on a new tensor or a copied dictionary instead of writing in place.",
            )


@check(
    "no-global-state", mend="pass dtype, device, generator; set nothing global", needs=("generator-device",)
)
def no_global_state(context: Context) -> None:
    """Importing, building and generating leave what is global in the process alone."""
    with torch.enable_grad():
        before = snapshot()
        context.new_generator().rest(context.default_params())
        changed = [*context.import_probe.changed, *(context.first_changes or ()), *changes(before)]
    if changed:
        raise CheckFailedError(
            "the process after importing, building and generating",
            got=f"a change of {', '.join(dict.fromkeys(changed))}",
            expected="everything as before: other backends share the process",
            fix="Pass dtype, device and a torch.Generator of your own instead of setting what is global.",
        )


@check(
    "no-own-gradient",
    level="core",
    needs=("generator-device",),
    mend="keep constants as plain tensors, not as `nn.Parameter`",
)
def no_own_gradient(context: Context) -> None:
    """Bodies carry a gradient of the parameters given, and of nothing that the model keeps."""
    with torch.enable_grad():
        found: dict[str, Any] = {"rest()": context.generator.rest(context.default_params())}
        if isinstance(context.generator, HasLinearBasis):
            linear = context.generator.linear_basis()
            found |= {f"linear_basis().{key}": getattr(linear, key, None) for key in ("template", "basis")}
    for where, value in found.items():
        if getattr(value, "requires_grad", False):
            raise CheckFailedError(
                where,
                got="a tensor that requires a gradient, though no parameter given does",
                expected="constants: an optimiser would train them, and every body keeps their graph",
                fix="Keep them as plain tensors or buffers, or call requires_grad_(False).",
            )


@check(
    "another-process",
    mend="name files from `Path(__file__).parent`; end what was started; keep nothing",
    needs=("deterministic", "batch-invariant", "inputs-unchanged"),
)
def another_process(context: Context) -> None:
    """A new process elsewhere makes the same bodies and ends; the package stays as it is."""
    if context.first_written:
        raise CheckFailedError(
            f"the folder of {context.offer.package} after building",
            got=f"{', '.join(context.first_written):.200} written",
            expected="nothing written: an installed package may be read-only, and others share it",
            fix="Write to a folder in soma_core.plugin.data_dir(), or use soma_core.plugin.cached_arrays.",
        )
    params = context.random_params(_BODIES, seed=1) or context.default_params()
    probe = probe_process(context.offer, context.options, {key: each.numpy() for key, each in params.items()})
    where = "a new process in an empty folder"
    if probe.bodies is None:
        fix = "Name files from Path(__file__).parent, not from the current folder, and end no process."
        raise CheckFailedError(where, got=probe.ending, expected="the bodies that are made here", fix=fix)
    fix = "Depend on no order of a set, no time and no state of the machine."
    _compare(
        context, torch.from_numpy(probe.bodies), _rest(context.generator, params), f"rest() in {where}", fix
    )
    if probe.ending:
        fix = "End threads and processes before, or make them daemons; let no exit handler end the process."
        raise CheckFailedError(where, got=probe.ending, expected="an end with exit code 0", fix=fix)
    if probe.growth > KEPT * probe.bodies.nbytes:
        raise CheckFailedError(
            f"memory of {where}",
            got=f"{probe.growth / 2**20:.1f} MiB more after each call of rest()",
            expected="as much as before, since results are the caller's",
            fix="Keep no results, no parameters and no graphs of calls.",
        )


CHECKS = (
    deterministic, batch_invariant, inputs_unchanged, no_global_state, no_own_gradient, another_process,
)  # fmt: skip
