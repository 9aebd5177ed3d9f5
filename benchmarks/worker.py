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
from typing import Any

import numpy as np

__all__ = ["serve"]

Call = Callable[[], Any]


def _times(call: Call, seconds: float, least: int) -> list[float]:
    found, start = [], time.perf_counter()
    while len(found) < least or time.perf_counter() - start < seconds:
        begin = time.perf_counter()
        call()
        found.append(1e3 * (time.perf_counter() - begin))
    return found


def serve(prepare: Callable[[str, dict[str, np.ndarray]], Call], versions: dict[str, str]) -> None:
    """Answer requests on stdin until it closes.

    Args:
        prepare: (case, inputs) -> a call that does the work once and returns vertices (batch, v, 3).
        versions: what runs here.
    """
    answer = sys.stdout
    sys.stdout = sys.stderr  # whatever a library prints must not reach the protocol
    ready: dict[str, Call] = {}

    def reply(**values: Any) -> None:
        answer.write(json.dumps(values) + "\n")
        answer.flush()

    reply(versions=versions)
    for line in sys.stdin:
        request = json.loads(line)
        key = f"{request['case']}-{request['inputs']}"
        if key not in ready:
            ready.clear()
            with np.load(request["inputs"], allow_pickle=False) as file:
                ready[key] = prepare(request["case"], {name: file[name] for name in file.files})
            for _ in range(3):
                ready[key]()
        if request.get("output"):
            np.save(request["output"], np.asarray(ready[key]()))
            reply(saved=request["output"])
        else:
            found = _times(ready[key], request["seconds"], request["least"])
            reply(times=found, peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
