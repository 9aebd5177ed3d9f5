"""Checks on what a plugin hands over: its declaration and its conformance checks."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Iterable
from numbers import Real
from pathlib import Path
from typing import Any, get_args, get_type_hints

from soma_core.plugin.spec import Axis, BackendSpec, FileNeeded, Parameter, Unit, WrapPair

__all__ = ["checks_problem", "did_you_mean", "spec_problem"]

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
    return next(filter(None, map(_parameter_problem, params)), None)


def _parameter_problem(item: Parameter) -> str | None:
    if not (isinstance(item.name, str) and _NAME.fullmatch(item.name)):
        return f"the parameter name {item.name!r} is no key; use letters, digits, _ and -"
    if not (isinstance(item.shape, tuple) and all(isinstance(n, int) and n >= 0 for n in item.shape)):
        return f"the shape of parameter {item.name} is {item.shape!r}, expected a tuple of sizes like (10,)"
    if not (isinstance(item.range, tuple) and len(item.range) == 2 and all(map(_is_finite, item.range))):
        return f"the range of parameter {item.name} is {item.range!r}, expected two finite numbers"
    if not item.range[0] < item.range[1]:
        return f"the range of parameter {item.name} is {item.range}, expected (low, high) with low < high"
    if not _is_finite(item.default):
        return f"the default of parameter {item.name} is {item.default!r}, expected a finite number"
    return None


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _parts_problem(spec: BackendSpec) -> str | None:
    if not isinstance(spec.api, int) or isinstance(spec.api, bool):
        return f"api is {spec.api!r}, expected the whole number of a contract version"
    for key in ("licence", "url", "description"):
        if not isinstance(getattr(spec, key), str):
            return f"{key} is {getattr(spec, key)!r}, expected a text"
    segments = spec.fill_segments
    if not (isinstance(segments, tuple) and all(isinstance(name, str) for name in segments)):
        return f"fill_segments is {segments!r}, expected a tuple of names"
    return _paths_problem(spec) or _options_problem(spec.options)


def _paths_problem(spec: BackendSpec) -> str | None:
    if not (spec.wrap is None or isinstance(spec.wrap, WrapPair)):
        return f"wrap is {spec.wrap!r}, expected a WrapPair or None"
    if not (isinstance(spec.files, tuple) and all(isinstance(item, FileNeeded) for item in spec.files)):
        return f"files is {spec.files!r}, expected a tuple of FileNeeded"
    paths: list[tuple[str, object]] = [("files", item.path) for item in spec.files]
    if spec.wrap:
        paths += [("wrap.native", spec.wrap.native), ("wrap.wrap", spec.wrap.wrap)]
    wrong = next(((key, path) for key, path in paths if not isinstance(path, Path)), None)
    return f"{wrong[0]} names {wrong[1]!r}, expected a pathlib.Path" if wrong else None


def _options_problem(options: Any) -> str | None:
    if options is None:
        return None
    if not (isinstance(options, type) and dataclasses.is_dataclass(options)):
        return f"options is {options!r}, expected a dataclass type or None"
    try:
        get_type_hints(options)
    except (NameError, TypeError, SyntaxError) as error:
        return f"the annotations of {options.__name__} cannot be read ({error}); import what they name"
    return None


def spec_problem(spec: object, name: str) -> str | None:
    """Say what is wrong with the declaration of backend `name`, or return None when it is sound.

    The version of the contract is the registry's to judge.
    """
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
            return f"soma_checks gave {check!r:.80}, expected a soma_core.plugin.Check"
    return None
