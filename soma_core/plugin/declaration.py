"""Checks on what a plugin hands over: its declaration, its options and its generator."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable, Mapping
from typing import Any, get_args

from soma_core.errors import InputError
from soma_core.plugin.spec import Axis, BackendSpec, FileNeeded, Parameter, Unit, WrapPair

__all__ = ["checked_options", "checks_problem", "did_you_mean", "spec_problem"]

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``Did you mean "x"?`` for the closest of `known`, or an empty text."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f'Did you mean "{close[0]}"?' if close else ""


def _axes_problem(up: object, forward: object, label: str) -> str | None:
    for key, axis in ((f"{label}up", up), (f"{label}forward", forward)):
        if axis not in get_args(Axis):
            return f"{key} is {axis!r}, expected one of {', '.join(get_args(Axis))}"
    if str(up)[1] == str(forward)[1]:
        return f"{label}up {up!r} and {label}forward {forward!r} lie on one axis"
    return None


def _params_problem(params: object) -> str | None:
    if not isinstance(params, tuple) or not all(isinstance(item, Parameter) for item in params):
        return f"params is {params!r}, expected a tuple of Parameter"
    names = [item.name for item in params]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        return f"params declares {', '.join(twice)} more than once"
    for item in params:
        if not _NAME.fullmatch(item.name):
            return f"the parameter name {item.name!r} is no key; use letters, digits, _ and -"
        if not item.range[0] < item.range[1]:
            return f"the range of parameter {item.name} is {item.range}, expected (low, high) with low < high"
    return None


def _parts_problem(spec: BackendSpec) -> str | None:
    if not (spec.wrap is None or isinstance(spec.wrap, WrapPair)):
        return f"wrap is {spec.wrap!r}, expected a WrapPair or None"
    if not (isinstance(spec.files, tuple) and all(isinstance(item, FileNeeded) for item in spec.files)):
        return f"files is {spec.files!r}, expected a tuple of FileNeeded"
    if not (
        spec.options is None or (isinstance(spec.options, type) and dataclasses.is_dataclass(spec.options))
    ):
        return f"options is {spec.options!r}, expected a dataclass type or None"
    return None


def spec_problem(spec: object, name: str) -> str | None:
    """Say what is wrong with the declaration of backend `name`, or return None when it is sound."""
    if not isinstance(spec, BackendSpec):
        return f"soma_backend returned {type(spec).__name__}, expected BackendSpec"
    if spec.name != name:
        return f"the declaration is named {spec.name!r}, the entry point {name!r}; they must be equal"
    if spec.unit not in get_args(Unit):
        return f"unit is {spec.unit!r}, expected one of {', '.join(get_args(Unit))}"
    wrap_up = spec.up if spec.wrap_up is None else spec.wrap_up
    wrap_forward = spec.forward if spec.wrap_forward is None else spec.wrap_forward
    return (
        _axes_problem(spec.up, spec.forward, "")
        or _axes_problem(wrap_up, wrap_forward, "wrap_")
        or _params_problem(spec.params)
        or _parts_problem(spec)
    )


def checks_problem(checks: Iterable[object]) -> str | None:
    """Say which of the checks that a plugin gives is none, or return None."""
    for check in checks:
        if not (isinstance(getattr(check, "id", None), str) and callable(getattr(check, "run", None))):
            return f"soma_checks gave {check!r:.80}, expected a soma_core.testing.Check"
    return None


def checked_options(spec: BackendSpec, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options with the defaults of ``spec.options`` filled in.

    The dataclass may refuse values in its ``__post_init__``. Its fields are passed on by name.

    Raises:
        InputError: an option that the backend does not declare.
    """
    fields = [field.name for field in dataclasses.fields(spec.options)] if spec.options else []
    for key, value in options.items():
        if key not in fields:
            raise InputError(
                f"backend.options.{key}",
                got=repr(value),
                expected=f"one of the options of backend {spec.name!r}: {', '.join(fields) or 'it has none'}",
                fix=did_you_mean(key, fields) or "Leave it out",
            )
    if spec.options is None:
        return {}
    made = spec.options(**options)
    return {name: getattr(made, name) for name in fields}
