"""Jobs over many items, by processes of this machine or by an actor pool of Ray Data, which retries them."""

from __future__ import annotations

import contextlib
import json
import logging
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from soma_core._lazy import needed
from soma_core.errors import InputError, SomaError
from soma_core.motion.options import DatasetOptions

if TYPE_CHECKING:
    from ray.data import ActorPoolStrategy

__all__ = ["Job", "need_ray", "pool_settings", "run_job", "usual_workers"]

_log = logging.getLogger(__name__)

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_AHEAD = 2
"""Items that are handed out for each process: one that it does, and one that waits."""

_READERS = 2
"""Logical CPUs that no actor takes: without any, tasks that read wait for ever."""

_LEAST_CPUS = 4
_MOST_BLOCKS = 2000
"""Tasks of Ray: each costs milliseconds of its scheduler."""


class Job(Protocol):
    """What is done to each item, as plain values that can be pickled; again where a worker ends."""

    def opened(self) -> Callable[[Any], Any]:
        """Load what all items need, in the process that does them."""


def usual_workers(options: DatasetOptions) -> int:
    """One a core that this process may use; one for a GPU, which they would share."""
    if options.device != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_job(job: Job, items: Sequence[Any], options: DatasetOptions) -> Iterator[Any]:
    """Do a job for each item, and give the results as they come.

    Every worker computes on one thread, so results do not depend on how many there are. A worker that ends
    is replaced, and its item done again.

    Args:
        job: of each item; it must bear being done twice.
        items: plain values, such as JSON has.
        options: the engine, and how many workers.

    Raises:
        InputError: Ray is asked for and not installed, or its cluster cannot be reached.
        Exception: as the job raises it.
    """
    if options.engine == "ray":
        return _by_ray(job, items, options)
    return _by_processes(job, items, min(options.workers or usual_workers(options), len(items)))


class _Worker:
    """A job in the process that does it, opened by its first item."""

    def __init__(self, job: Job) -> None:
        self._job, self._do = job, None
        logging.getLogger().addHandler(logging.NullHandler())  # what is said stands in the results

    def __call__(self, item: Any) -> tuple[Any, Exception | None]:
        """The result, or what was raised: Ray would wrap it in its own words."""
        try:
            if self._do is None:
                import torch

                torch.set_num_threads(1)
                self._do = self._job.opened()
            return self._do(item), None
        except Exception as error:
            return None, error if isinstance(error, SomaError) else SomaError(
                f"{type(error).__name__}: {error}"
            )


_here: dict[str, _Worker] = {}
"""The worker of a process of the pool."""


def _start(job: Job) -> None:
    """Make this process a worker, which ends with the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
    _here["worker"] = _Worker(job)


def _work(item: Any) -> tuple[Any, Exception | None]:
    return _here["worker"](item)


def _by_processes(job: Job, items: Sequence[Any], workers: int) -> Iterator[Any]:
    """By a pool; items that were under way where a process ended are done again, each alone."""
    left, lost = deque(items), deque[Any]()
    while left or lost:
        alone = bool(lost)
        try:
            yield from _by_pool(job, deque([lost[0]]) if alone else left, 1 if alone else workers, lost)
        except BrokenProcessPool:
            _log.warning("a worker process ended; going on with %d items again, one by one", len(lost))
            continue
        if alone:
            lost.popleft()


def _by_pool(job: Job, left: deque[Any], workers: int, lost: deque[Any]) -> Iterator[Any]:
    """By one pool, which takes items from `left`; of a pool that broke, those under way come to `lost`."""
    before = set(multiprocessing.active_children())
    spawn, running = multiprocessing.get_context("spawn"), dict[Future[Any], Any]()
    pool = ProcessPoolExecutor(workers, mp_context=spawn, initializer=_start, initargs=(job,))
    try:
        while left or running:
            _hand_out(pool, left, running, _AHEAD * workers)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                result = future.result()
                del running[future]
                yield _given(result)
        pool.shutdown()
    except BrokenProcessPool:
        lost.extend(item for item in running.values() if item not in lost)
        raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()


def _hand_out(
    pool: ProcessPoolExecutor, left: deque[Any], running: dict[Future[Any], Any], most: int
) -> None:
    """Give the pool items until `most` are under way; its processes, which begin now, have one thread."""
    with _one_thread():
        while left and len(running) < most:
            item = left.popleft()
            running[pool.submit(_work, item)] = item


def _given(result: tuple[Any, Exception | None]) -> Any:
    value, error = result
    if error is not None:
        raise error
    return value


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let processes that are started here use one thread for linear algebra."""
    before = {name: os.environ.get(name) for name in _POOLS}
    os.environ.update(dict.fromkeys(_POOLS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            os.environ.update({} if value is None else {name: value})


def need_ray() -> Any:
    """The module ``ray``, or an InputError that says how to install it."""
    return needed("ray", "data", setting="engine", pip="[ray]", otherwise="pass engine=local")


def pool_settings(options: DatasetOptions) -> Mapping[str, Any]:
    """Arguments of ``map_batches`` for a pool of actors: one a core, or as many on a GPU as share it."""
    return {
        "compute": _pool(options), **({"num_gpus": options.num_gpus} if options.num_gpus else {"num_cpus": 1})
    }  # fmt: skip


def _pool(options: DatasetOptions) -> ActorPoolStrategy:
    ray = need_ray()
    if options.workers:
        return ray.data.ActorPoolStrategy(size=options.workers)
    found = ray.cluster_resources() if ray.is_initialized() else {}
    most = found.get("GPU", 1) / options.num_gpus if options.num_gpus else found.get("CPU", 4) - _READERS
    return ray.data.ActorPoolStrategy(min_size=1, max_size=max(int(most), 1))


def _by_ray(job: Job, items: Sequence[Any], options: DatasetOptions) -> Iterator[Any]:
    ray = need_ray()
    with _connected(ray, options):
        blocks = min(len(items), _MOST_BLOCKS)
        given = ray.data.from_items(
            [{"item": json.dumps(item)} for item in items], override_num_blocks=blocks
        )
        settings = pool_settings(options)
        done = given.map_batches(
            _Actor, fn_constructor_args=(job,), batch_size=1, batch_format="numpy", **settings
        )
        for row in done.iter_rows():
            yield _given(row["result"])


class _Actor:
    """A worker as Ray Data calls it."""

    def __init__(self, job: Job) -> None:
        self._worker = _Worker(job)

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        results = np.empty(len(batch["item"]), object)
        for number, item in enumerate(batch["item"]):
            results[number] = self._worker(json.loads(str(item)))
        return {"result": results}


@contextlib.contextmanager
def _connected(ray: Any, options: DatasetOptions) -> Iterator[None]:
    """Use the cluster that this process is connected to, that at the address, or one of its own.

    Raises:
        InputError: no cluster answers there, or one of its own does not start.
    """
    if ray.is_initialized():
        yield
        return
    cpus = max((options.workers or usual_workers(options)) + _READERS, _LEAST_CPUS)
    own = {} if options.address else {"num_cpus": cpus, "include_dashboard": False}
    try:
        ray.init(options.address or "local", log_to_driver=False, logging_level=logging.WARNING, **own)
    except Exception as error:  # a start that takes too long has no kind of its own
        if options.address and isinstance(error, ConnectionError):
            raise InputError(
                "address", got=options.address, expected="the address of a Ray cluster that runs",
                fix="ray start --head prints one; ray status says whether it answers.",
            ) from error  # fmt: skip
        with contextlib.suppress(Exception):
            ray.shutdown()
        told = " ".join(str(error).split())[:200].rstrip(".") or "no text"
        raise InputError(
            "engine", got=f"ray, which does not start ({type(error).__name__}: {told})",
            expected="Ray to start", fix="Try again when the machine is less busy, or pass engine=local.",
        ) from error  # fmt: skip
    try:
        context = ray.data.DataContext.get_current()
        context.enable_progress_bars = context.print_on_execution_start = False  # shards are counted here
        yield
    finally:
        ray.shutdown()
