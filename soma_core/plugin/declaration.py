"""Checks on what a plugin hands over: its declaration and its conformance checks."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Iterable, Mapping
from numbers import Real
from pathlib import Path
from typing import Any, get_args, get_type_hints

from soma_core.plugin.errors import PluginError
from soma_core.plugin.spec import (
    Axis,
    BackendSpec,
    Expressions,
    FileNeeded,
    ModelMotion,
    MotionFormat,
    Parameter,
    SkinnedModel,
    Unit,
    WrapPair,
)

__all__ = [
    "CORE_LAYOUTS",
    "checks_problem",
    "did_you_mean",
    "expressions_problem",
    "formats_problem",
    "motion_problem",
    "refuse_posed",
    "skinned_problem",
    "spec_problem",
    "tensor_problem",
]

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
CORE_LAYOUTS = {"soma", "kimodo", "amass", "smpl", "sam3d", "skeleton", "vertices"}
"""Layouts of motions that the core knows by name."""

_SHARED_SUFFIXES = {".npz", ".npy", ".pkl", ".pickle", ".pt", ".pth"}
"""Of files in which anybody keeps anything; names in them tell what they are."""

_SUFFIX = re.compile(r"\.[a-z0-9]+")


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
    if item.limits is not None and not _around(item.limits, item.range):
        return (
            f"the limits of parameter {item.name} are {item.limits!r}, expected two finite numbers around "
            f"{item.range}"
        )
    if not _is_finite(item.default):
        return f"the default of parameter {item.name} is {item.default!r}, expected a finite number"
    return None


def _around(limits: object, inner: tuple[float, float]) -> bool:
    if not (isinstance(limits, tuple) and len(limits) == 2 and all(map(_is_finite, limits))):
        return False
    return bool(limits[0] <= inner[0] and inner[1] <= limits[1])


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


def formats_problem(formats: Iterable[object]) -> str | None:
    """Say which of the motion formats that a plugin gives is none, or return None."""
    names = set()
    for each in formats:
        if not isinstance(each, MotionFormat):
            return f"soma_motions gave {each!r:.80}, expected a soma_core.plugin.MotionFormat"
        if not (isinstance(each.name, str) and _NAME.fullmatch(each.name)) or each.name in names:
            return f"the motion format {each.name!r} has no name of its own; use letters, digits, _ and -"
        names.add(each.name)
        for key in ("suffixes", "keys"):
            texts = getattr(each, key)
            if not (isinstance(texts, tuple) and all(isinstance(text, str) for text in texts)):
                return f"{key} of the motion format {each.name} is {texts!r}, expected a tuple of texts"
        if each.name in CORE_LAYOUTS:
            return f"the motion format {each.name!r} is one of the core's own; choose another name"
        if not each.suffixes or not all(_SUFFIX.fullmatch(suffix) for suffix in each.suffixes):
            return f"suffixes of the motion format {each.name} are {each.suffixes!r}, expected like ('.npz',)"
        shared = sorted({*each.suffixes} & _SHARED_SUFFIXES)
        if shared and not each.keys:
            return (
                f"the motion format {each.name} claims every {shared[0]} file; name keys that its files hold"
            )
        calls = [call for call in (each.read, each.write) if call is not None]
        if not calls or not all(map(callable, calls)):
            return f"the motion format {each.name} has neither read nor write that can be called"
    return None


def tensor_problem(value: Any, shape: tuple[int, ...], *, like: Any = None) -> str | None:
    """Say why a value is no finite tensor of a shape, in the dtype and on the device of another; or None."""
    if not (hasattr(value, "shape") and hasattr(value, "isfinite")):
        return f"{type(value).__name__}, expected a tensor {shape}"
    if tuple(value.shape) != shape:
        return f"a tensor {tuple(value.shape)}, expected {shape}"
    if like is not None and (value.dtype, value.device) != (like.dtype, like.device):
        return f"{value.dtype} on {value.device}, expected {like.dtype} on {like.device}"
    return None if bool(value.isfinite().all()) else "numbers that are not finite, expected finite ones"


_WEIGHTS = 1e-3
"""How far weights may sum from 1, or lie below 0: files round them."""


def _range(values: Any) -> str:
    return f"{float(values.min()):g} to {float(values.max()):g}"


def skinned_problem(model: Any, batch: int, count: int) -> str | None:
    """Say what is wrong with what ``skinning()`` returned for `batch` bodies of `count` vertices; or None."""
    if not isinstance(model, SkinnedModel):
        return f"skinning returned {type(model).__name__}, expected a SkinnedModel"
    names, parents = model.joint_names, model.parents
    if not (isinstance(names, tuple) and names and len(set(names)) == len(names)):
        return f"joint_names of skinning is {names!r:.60}, expected a tuple of names, each once"
    if (
        len(parents) != len(names)
        or not all(-1 < up < at for at, up in enumerate(parents) if at)
        or parents[0] != -1
    ):
        return f"parents of skinning is {parents!r:.60}, expected -1, then for each joint one before it"
    joints = len(names)
    for key, shape in {
        "rest": (batch, count, 3),
        "joints": (batch, joints, 3),
        "weights": (count, joints),
    }.items():
        problem = tensor_problem(getattr(model, key), shape)
        if problem is not None:
            return f"{key} of skinning is {problem}"
    low, sums = float(model.weights.min()), model.weights.sum(-1)
    if not (sums - 1).abs().max() <= _WEIGHTS or not low >= -_WEIGHTS:
        return f"weights of skinning are {low:g} or more, sums {_range(sums)}, expected rows that sum to 1"
    if model.pose_offsets is not None and not callable(model.pose_offsets):
        return f"pose_offsets of skinning is {type(model.pose_offsets).__name__}, expected a function or None"
    return None


def expressions_problem(found: Any, count: int) -> str | None:
    """Say what is wrong with what ``expressions()`` returned for a mesh of `count` vertices; or None."""
    if not isinstance(found, Expressions):
        return f"expressions returned {type(found).__name__}, expected Expressions"
    if not (isinstance(found.names, tuple) and found.names and len({*found.names}) == len(found.names)):
        return f"names of expressions is {found.names!r:.60}, expected a tuple of names, each once"
    problem = tensor_problem(found.basis, (len(found.names), count, 3))
    return f"the basis of expressions is {problem}" if problem else None


def refuse_posed(found: Any, frames: int) -> None:
    """Refuse what ``posed()`` returned where it is no mesh of each of the frames.

    Raises:
        PluginError: it is none.
    """
    shape = tuple(getattr(found, "shape", ()))
    if len(shape) != 3 or shape[0] != frames or shape[2] != 3:
        kind = f"a tensor {shape}" if shape else type(found).__name__
        raise PluginError(
            f"posed returned {kind}, expected ({frames}, n, 3)", fix="Return the posed vertices"
        )


def motion_problem(motion: Any) -> str | None:
    """Say why what the ``read`` of a motion format returned is no motion; or None."""
    if not isinstance(motion, ModelMotion):
        return f"read returned {type(motion).__name__}, expected a ModelMotion"
    if not (isinstance(motion.pose, Mapping) and isinstance(motion.params, Mapping) and motion.pose):
        kinds = f"{type(motion.pose).__name__} and {type(motion.params).__name__}"
        return f"pose and params of a motion are {kinds}, expected arrays by name"
    frames = {len(value) if hasattr(value, "__len__") else -1 for value in motion.pose.values()}
    if len(frames) != 1 or min(frames) < 1:
        return f"pose of a motion has arrays of {sorted(frames)} frames, expected as many in each"
    if not _is_finite(motion.fps) or not motion.fps > 0:
        return f"fps of a motion is {motion.fps!r}, expected frames per second"
    if motion.up is not None and motion.up not in get_args(Axis):
        return f"up of a motion is {motion.up!r}, expected one of {', '.join(get_args(Axis))}, or None"
    return None
