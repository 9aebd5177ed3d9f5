"""One place that starts Warp quietly, names scalar types, and hands torch memory and streams to it."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import torch
import warp as wp

from soma_core.errors import InputError

__all__ = ["as_warp", "begin_loading", "launching", "loaded", "once", "scalar_name", "start"]

_log = logging.getLogger(__name__)

_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


_Maker = TypeVar("_Maker", bound=Callable[..., Any])

_making = threading.RLock()


def once(make: _Maker) -> _Maker:
    """Cache what a function makes; two threads never make the same: Warp builds one of equal kernels."""
    cached = functools.cache(make)

    @functools.wraps(make)
    def made(*args: Any, **kwargs: Any) -> Any:
        with _making:
            return cached(*args, **kwargs)

    made.cache_info = cached.cache_info  # type: ignore[attr-defined]
    return made  # type: ignore[return-value]


@once
def start() -> None:
    """Initialise Warp once, without its banner or its notice that no GPU is present."""
    wp.config.quiet = True
    if hasattr(wp, "LOG_ERROR"):
        wp.config.log_level = wp.LOG_ERROR
    if torch.cuda.is_available():
        wp.init()
    else:
        with _native_stderr_closed():
            wp.init()
    _log.debug("Warp %s ready", wp.config.version)


@contextlib.contextmanager
def _native_stderr_closed() -> Iterator[None]:
    """Drop what native code writes to stderr: Warp 1.19 warns of a missing GPU there."""
    sys.stderr.flush()
    saved, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)


def scalar_name(dtype: torch.dtype) -> str:
    """``float32`` or ``float64``: the key of a kernel family."""
    if dtype not in _SCALARS:
        raise InputError(
            "dtype",
            got=dtype,
            expected="torch.float32 or torch.float64",
            fix="Convert, or use kernels='torch'.",
        )
    return str(dtype).removeprefix("torch.")


def as_warp(tensor: torch.Tensor, dtype: Any = None) -> Any:
    """Descriptor of a contiguous tensor's memory for one launch.

    It holds no reference: the caller keeps the tensor alive until the launch was issued. (Full Warp
    arrays cost more to make than a small kernel runs.)
    """
    assert tensor.is_contiguous(), tensor.stride()
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


@functools.lru_cache(maxsize=64)
def _stream(device: str, handle: int) -> Any:
    """Warp's name for a stream of torch's; made once, since that registers it and makes an event for it."""
    return wp.Stream(device, cuda_stream=handle)


@contextlib.contextmanager
def launching(tensor: torch.Tensor) -> Iterator[Any]:
    """The device to launch on; on CUDA, within torch's current stream, so that both see one order of work.

    Nothing waits for the stream that Warp used before: nothing is ever put on Warp's own, and to wait for it
    would end the capture of a CUDA graph (Warp 1.19 records an event outside of the capture for it).
    """
    start()
    device = wp.device_from_torch(tensor.device)
    if not tensor.is_cuda:
        yield device
        return
    handle = torch.cuda.current_stream(tensor.device).cuda_stream
    with wp.ScopedStream(_stream(device.alias, handle), sync_enter=False):
        yield device


def loaded(kernel: wp.Kernel, device: Any) -> wp.Kernel:
    """The same kernel, once it can run on a CPU; on CUDA a launch loads it.

    One thread of the process compiles them all. Warp 1.19 lets threads that launch the same kernel each
    compile it, and makes its precompiled header, most of the time of a module, anew in every thread.
    """
    if not wp.get_device(device).is_cuda:
        _load(os.getpid(), kernel)
    return kernel


@functools.cache
def _load(process: int, kernel: wp.Kernel) -> None:
    _begin(process, kernel).result()


def begin_loading(kernels: Iterable[wp.Kernel]) -> list[Future[None]]:
    """Compile kernels for a CPU, one after the other, while the caller goes on; see :func:`loaded`."""
    start()
    return [_begin(os.getpid(), kernel) for kernel in kernels]


def _begin(process: int, kernel: wp.Kernel) -> Future[None]:
    # a CPU's launch is one thread a block, whatever it asks for
    return _compiler(process).submit(wp.load_module, kernel.module, device="cpu", block_dim=1, max_workers=0)


@once
def _compiler(_process: int) -> ThreadPoolExecutor:
    """The thread that compiles; a forked process has its own."""
    return ThreadPoolExecutor(1, thread_name_prefix="soma-compiler")
