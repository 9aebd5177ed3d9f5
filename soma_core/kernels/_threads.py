"""Work side by side in threads: parts of a kernel's launch, and parts of a computation of many operations."""

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor

__all__ = ["FEW", "in_parts", "in_threads", "shared_out", "side_by_side"]

_own = threading.local()

_ABREAST = 16
"""Frames that lie in the lanes of one SIMD register: parts are multiples."""

FEW = 8
"""Fewer bodies to pose are not worth another thread: to launch a kernel takes as long."""

_Part = TypeVar("_Part")
_Made = TypeVar("_Made")


def in_threads(run: Callable[[slice], None], count: int, like: Tensor, *, least: int = 1) -> None:
    """Run consecutive parts of `count` groups, of at least so many, in as many threads as torch uses.

    Warp runs a CPU kernel on the calling thread and lets go of the interpreter meanwhile. On a GPU there is
    one part.
    """
    if not count:
        return
    alone = like.is_cuda or hasattr(_own, "beside")
    threads = 1 if alone else min(torch.get_num_threads(), max(1, count // least))
    parts = [slice(count * k // threads, count * (k + 1) // threads) for k in range(threads)]
    if len(parts) == 1:
        run(parts[0])
        return
    list(_pool(os.getpid(), len(parts)).map(run, parts))


def in_parts(run: Callable[[_Part], _Made], parts: Sequence[_Part], threads: int) -> list[_Made]:
    """What `run` makes of each part, side by side in threads in which torch and kernels have one each."""
    if min(threads, len(parts)) < 2 or hasattr(_own, "beside"):
        return [run(part) for part in parts]
    inference, graded = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    def alone(part: _Part) -> _Made:
        with torch.inference_mode(inference), torch.set_grad_enabled(graded):
            return run(part)

    return list(_pool(os.getpid(), threads).map(alone, parts))


def shared_out(count: int, most: int, threads: int) -> list[slice]:
    """Parts of `count` frames, as many for every thread; at most `most` frames are under way at a time."""
    parts = threads * max(1, -(-count // most))
    size = max(1, -(-count // (parts * _ABREAST))) * _ABREAST
    return [slice(first, first + size) for first in range(0, count, size) or (0,)]


@contextlib.contextmanager
def side_by_side(count: int, least: int, like: Tensor) -> Iterator[int]:
    """How many threads are for :func:`in_parts` of at least so many of `count` items; torch has one here.

    An operation of torch in several threads lets them wait awake, in the way of those of the next parts.
    There is one, and torch goes on as it did, where items are few or on a GPU.
    """
    before = torch.get_num_threads()
    threads = min(before, count // least)
    if threads < 2 or like.is_cuda or not torch.backends.openmp.is_available():
        yield 1
        return
    _have(1)
    try:
        yield threads
    finally:
        _have(before)


@functools.cache
def _pool(_process: int, size: int) -> ThreadPoolExecutor:
    """Threads that stay between launches; a forked process has its own."""
    return ThreadPoolExecutor(size, thread_name_prefix="soma-lanes", initializer=_belong)


def _belong() -> None:
    """Make this thread one that works beside others, and starts none."""
    _own.beside = True
    _have(1)


@functools.cache
def _turn(_process: int) -> threading.Lock:
    return threading.Lock()


def _have(count: int) -> None:
    """Give torch so many threads in this one, and leave what threads to come begin with as it is."""
    torch.get_num_threads()  # a thread that asks for the first time takes what new ones begin with
    with _turn(os.getpid()):
        begun = _apart(torch.get_num_threads)
        torch.set_num_threads(count)
        _apart(torch.set_num_threads, begun)


def _apart(run: Callable[..., _Made], *args: object) -> _Made:
    """What a new thread makes of this."""
    with ThreadPoolExecutor(1) as one:
        return one.submit(run, *args).result()
