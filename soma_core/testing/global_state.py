"""State of the process that a backend must leave alone, and a guard that puts it back."""

from __future__ import annotations

import gc
import locale
import logging
import os
import random
import signal
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

__all__ = ["changes", "kept", "snapshot"]


@dataclass(frozen=True)
class _Part:
    """One part of the state: what people call it, how it is read and how it is put back."""

    name: str
    read: Callable[[], Any]
    restore: Callable[[Any], object]


def _numpy_state() -> tuple[Any, ...]:
    import numpy as np

    name, key, *rest = np.random.get_state()  # noqa: NPY002 - the global one is the one to watch
    return (name, np.asarray(key).tobytes(), *rest)


def _set_numpy_state(state: tuple[Any, ...]) -> None:
    import numpy as np

    name, key, *rest = state
    np.random.set_state((name, np.frombuffer(key, np.uint32), *rest))  # noqa: NPY002


def _torch_state() -> bytes:
    import torch

    return torch.random.get_rng_state().numpy().tobytes()


def _set_torch_state(state: bytes) -> None:
    import numpy as np
    import torch

    torch.random.set_rng_state(torch.from_numpy(np.frombuffer(state, np.uint8).copy()))


def _default_device() -> str:
    import torch

    return str(torch.get_default_device())


def _set_default_device(device: str) -> None:
    import torch

    torch.set_default_device(None if device == "cpu" else device)


def _set_environment(variables: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(variables)


def _logging_state() -> tuple[int, int, tuple[logging.Handler, ...]]:
    return logging.root.level, logging.root.manager.disable, tuple(logging.root.handlers)


def _set_logging_state(state: tuple[int, int, tuple[logging.Handler, ...]]) -> None:
    logging.root.setLevel(state[0])
    logging.disable(state[1])
    logging.root.handlers[:] = state[2]


def _set_filters(filters: list[Any]) -> None:
    warnings.filters[:] = filters  # type: ignore[index]
    warnings._filters_mutated()  # type: ignore[attr-defined]


class _Members(dict[str, Any]):
    """Functions and classes of a module by name; equal where those of both are the same."""

    def __ne__(self, other: object) -> bool:
        assert isinstance(other, dict)
        return any(self[name] is not other[name] for name in self.keys() & other.keys())


def _members(*modules: str) -> Callable[[], _Members]:
    return lambda: _Members(
        (f"{module}.{name}", value)
        for module in modules
        for name, value in vars(sys.modules[module]).items()
        if callable(value) and not name.startswith("__")
    )


def _put_back(members: _Members) -> None:
    for name, value in members.items():
        module, _, name_there = name.rpartition(".")
        setattr(sys.modules[module], name_there, value)


def _torch_print_options() -> dict[str, Any]:
    from torch import _tensor_str

    return dict(vars(_tensor_str.PRINT_OPTS))


def _set_torch_print_options(options: dict[str, Any]) -> None:
    from torch import _tensor_str

    vars(_tensor_str.PRINT_OPTS).update(options)


def _tf32() -> tuple[bool, bool]:
    import torch

    return torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32


def _set_tf32(allowed: tuple[bool, bool]) -> None:
    import torch

    torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = allowed


def _flushes_denormals() -> bool:
    import torch

    return bool((torch.full((), 2.0**-1060, dtype=torch.float64, device="cpu") * 2 == 0).item())


def _handlers() -> dict[int, Any]:
    named = (signal.SIGINT, signal.SIGTERM, signal.SIGFPE, signal.SIGSEGV, signal.SIGABRT)
    return {number: signal.getsignal(number) for number in named}


def _set_handlers(handlers: dict[int, Any]) -> None:
    for number, handler in handlers.items():
        if signal.getsignal(number) is not handler and handler is not None:
            signal.signal(number, handler)


def _hooks() -> tuple[Any, ...]:
    return sys.excepthook, threading.excepthook, sys.displayhook, sys.stdout, sys.stderr


def _set_hooks(hooks: tuple[Any, ...]) -> None:
    sys.excepthook, threading.excepthook, sys.displayhook, sys.stdout, sys.stderr = hooks


def _set_locale(name: str) -> None:
    locale.setlocale(locale.LC_ALL, name)


def _set_gc(enabled: bool) -> None:
    (gc.enable if enabled else gc.disable)()


def _of(module: str, name: str) -> Callable[..., Any]:
    """A function of a module that is looked up when it is called."""
    return lambda *given: getattr(sys.modules[module], name)(*given)


_HEAVY_PARTS = (
    _Part("torch's default dtype", _of("torch", "get_default_dtype"), _of("torch", "set_default_dtype")),
    _Part("torch's default device", _default_device, _set_default_device),
    _Part("torch's random state", _torch_state, _set_torch_state),
    _Part("torch's gradient mode", _of("torch", "is_grad_enabled"), _of("torch", "set_grad_enabled")),
    _Part("torch's number of threads", _of("torch", "get_num_threads"), _of("torch", "set_num_threads")),
    _Part(
        "torch's deterministic mode",
        _of("torch", "are_deterministic_algorithms_enabled"),
        _of("torch", "use_deterministic_algorithms"),
    ),
    _Part(
        "torch's matmul precision",
        _of("torch", "get_float32_matmul_precision"),
        _of("torch", "set_float32_matmul_precision"),
    ),
    _Part("torch's print options", _torch_print_options, _set_torch_print_options),
    _Part(
        "torch's anomaly mode",
        _of("torch", "is_anomaly_enabled"),
        _of("torch.autograd", "set_detect_anomaly"),
    ),
    _Part("torch's use of TF32", _tf32, _set_tf32),
    _Part("torch's treatment of denormal numbers", _flushes_denormals, _of("torch", "set_flush_denormal")),
    _Part("functions of torch", _members("torch", "torch.nn.functional", "torch.linalg"), _put_back),
    _Part("functions of NumPy", _members("numpy", "numpy.linalg"), _put_back),
    _Part(
        "NumPy's print options",
        _of("numpy", "get_printoptions"),
        lambda state: sys.modules["numpy"].set_printoptions(**state),
    ),
    _Part("NumPy's random state", _numpy_state, _set_numpy_state),
    _Part(
        "NumPy's error handling", _of("numpy", "geterr"), lambda state: sys.modules["numpy"].seterr(**state)
    ),
)
"""Of NumPy and torch; looked at where these are loaded, which loads nothing."""

_LIGHT_PARTS = (
    _Part("Python's random state", random.getstate, random.setstate),
    _Part("the current folder", os.getcwd, os.chdir),
    _Part("the environment variables", lambda: dict(os.environ), _set_environment),
    _Part("the import path", lambda: list(sys.path), lambda path: sys.path.__setitem__(slice(None), path)),
    _Part("the warning filters", lambda: list(warnings.filters), _set_filters),
    _Part("the root logger", _logging_state, _set_logging_state),
    _Part("handlers of signals", _handlers, _set_handlers),
    _Part("standard streams or hooks of uncaught errors", _hooks, _set_hooks),
    _Part("the limit of recursion", sys.getrecursionlimit, sys.setrecursionlimit),
    _Part("garbage collection", gc.isenabled, _set_gc),
    _Part("the locale", lambda: locale.setlocale(locale.LC_ALL), _set_locale),
    _Part("the time limit of sockets", socket.getdefaulttimeout, socket.setdefaulttimeout),
    _Part("built-in functions", _members("builtins"), _put_back),
)


def _parts() -> tuple[_Part, ...]:
    return _HEAVY_PARTS + _LIGHT_PARTS if "torch" in sys.modules else _LIGHT_PARTS


def snapshot() -> dict[str, Any]:
    """Read every part of the state, by name; those of NumPy and torch once these are loaded."""
    return {part.name: part.read() for part in _parts()}


def changes(before: dict[str, Any]) -> list[str]:
    """Names of the parts that differ from `before`."""
    return [part.name for part in _parts() if part.name in before and part.read() != before[part.name]]


@contextmanager
def kept() -> Iterator[None]:
    """Put back on leaving whatever part of the state has changed."""
    before = snapshot()
    try:
        yield
    finally:
        changed = changes(before)
        for part in _parts():
            if part.name in changed:
                part.restore(before[part.name])
