"""State of the process that a backend must leave alone, and a guard that puts it back."""

from __future__ import annotations

import logging
import os
import random
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

__all__ = ["changes", "kept", "snapshot"]


@dataclass(frozen=True)
class _Part:
    """One part of the state: what people call it, how it is read and how it is put back."""

    name: str
    read: Callable[[], Any]
    restore: Callable[[Any], object]


def _numpy_state() -> tuple[Any, ...]:
    name, key, *rest = np.random.get_state()  # noqa: NPY002 - the global one is the one to watch
    return (name, np.asarray(key).tobytes(), *rest)


def _set_numpy_state(state: tuple[Any, ...]) -> None:
    name, key, *rest = state
    np.random.set_state((name, np.frombuffer(key, np.uint32), *rest))  # noqa: NPY002


def _torch_state() -> bytes:
    return torch.random.get_rng_state().numpy().tobytes()


def _set_torch_state(state: bytes) -> None:
    torch.random.set_rng_state(torch.from_numpy(np.frombuffer(state, np.uint8).copy()))


def _default_device() -> str:
    return str(torch.get_default_device())


def _set_default_device(device: str) -> None:
    torch.set_default_device(None if device == "cpu" else device)


def _set_environment(variables: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(variables)


def _logging_state() -> tuple[int, tuple[logging.Handler, ...]]:
    return logging.root.level, tuple(logging.root.handlers)


def _set_logging_state(state: tuple[int, tuple[logging.Handler, ...]]) -> None:
    logging.root.setLevel(state[0])
    logging.root.handlers[:] = state[1]


def _set_filters(filters: list[Any]) -> None:
    warnings.filters[:] = filters  # type: ignore[index]
    warnings._filters_mutated()  # type: ignore[attr-defined]


_PARTS = (
    _Part("torch's default dtype", torch.get_default_dtype, torch.set_default_dtype),
    _Part("torch's default device", _default_device, _set_default_device),
    _Part("torch's random state", _torch_state, _set_torch_state),
    _Part("torch's gradient mode", torch.is_grad_enabled, torch.set_grad_enabled),
    _Part("torch's number of threads", torch.get_num_threads, torch.set_num_threads),
    _Part(
        "torch's deterministic mode",
        torch.are_deterministic_algorithms_enabled,
        torch.use_deterministic_algorithms,
    ),
    _Part(
        "torch's matmul precision",
        torch.get_float32_matmul_precision,
        torch.set_float32_matmul_precision,
    ),
    _Part("NumPy's random state", _numpy_state, _set_numpy_state),
    _Part("NumPy's error handling", np.geterr, lambda state: np.seterr(**state)),
    _Part("Python's random state", random.getstate, random.setstate),
    _Part("the current folder", os.getcwd, os.chdir),
    _Part("the environment variables", lambda: dict(os.environ), _set_environment),
    _Part("the import path", lambda: list(sys.path), lambda path: sys.path.__setitem__(slice(None), path)),
    _Part("the warning filters", lambda: list(warnings.filters), _set_filters),
    _Part("the root logger", _logging_state, _set_logging_state),
)


def snapshot() -> dict[str, Any]:
    """Read every part of the state, by name."""
    return {part.name: part.read() for part in _PARTS}


def changes(before: dict[str, Any]) -> list[str]:
    """Names of the parts that differ from `before`."""
    return [part.name for part in _PARTS if part.read() != before[part.name]]


@contextmanager
def kept() -> Iterator[None]:
    """Put back on leaving whatever part of the state has changed."""
    before = snapshot()
    try:
        yield
    finally:
        changed = changes(before)
        for part in _PARTS:
            if part.name in changed:
                part.restore(before[part.name])
