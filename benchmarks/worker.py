"""A process that holds one implementation and times it when asked, one JSON line a request.

Implementations live in processes (and environments) of their own, so that peak memory is theirs alone;
the caller alternates between them, so that they share whatever else the machine is doing.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["Call", "Work", "serve"]

Call = Callable[[], Any]


@dataclass(frozen=True)
class Work:
    """A call to time, and how to make an array of what it returns, which is not timed."""

    call: Call
    array: Callable[[Any], np.ndarray] = np.asarray


def _times(call: Call, seconds: float, least: int) -> tuple[list[float], float]:
    """Milliseconds of each call, and of all processors for a mean one."""
    found, spent, start = [], time.process_time(), time.perf_counter()
    while len(found) < least or time.perf_counter() - start < seconds:
        begin = time.perf_counter()
        call()
        found.append(1e3 * (time.perf_counter() - begin))
    return found, 1e3 * (time.process_time() - spent) / len(found)


def serve(prepare: Callable[[str, dict[str, np.ndarray]], Call | Work], versions: dict[str, str]) -> None:
    """Answer requests on stdin until it closes.

    A request names a case and a file of inputs; with ``output`` the result is stored there, else calls are
    timed. ``warm`` calls come first; cases of the same inputs stay ready.

    Args:
        prepare: (case, inputs) -> work that does the case once.
        versions: what runs here.
    """
    answer = sys.stdout
    sys.stdout = sys.stderr  # whatever a library prints must not reach the protocol
    ready: dict[str, Work] = {}
    inputs = None

    def reply(**values: Any) -> None:
        answer.write(json.dumps(values) + "\n")
        answer.flush()

    reply(versions=versions)
    for line in sys.stdin:
        request = json.loads(line)
        case = request["case"]
        if inputs != request["inputs"]:
            ready.clear()
            inputs = request["inputs"]
        if case not in ready:
            with np.load(inputs, allow_pickle=False) as file:
                work = prepare(case, {name: file[name] for name in file.files})
            ready[case] = work if isinstance(work, Work) else Work(work)
            for _ in range(request.get("warm", 3)):
                ready[case].call()
        if request.get("output"):
            np.save(request["output"], ready[case].array(ready[case].call()))
            reply(saved=request["output"])
        else:
            found, spent = _times(ready[case].call, request["seconds"], request["least"])
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            reply(times=found, cpu_ms=spent, peak_mb=peak)
