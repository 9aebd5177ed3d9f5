"""Rows of the device benchmark: each is stored as soon as it is known, and outlives what comes after it."""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

__all__ = ["SICK", "Bench", "load_state", "store_state"]

SICK = 3
"""Exit code of a process whose CUDA context is lost; the rest goes on in a new one."""

LONG_S = 6.0
"""A call that takes longer is measured once."""

Row = dict[str, Any]


def load_state(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def store_state(path: Path, state: dict) -> None:
    """Write the whole state; a reader never sees half of it."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(state, indent=1, default=str) + "\n", encoding="utf-8")
    os.replace(temporary, path)


class Bench:
    """What all sections share: the device, the clock, and the file of results.

    Args:
        path: the state, made by the process that watches this one.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.state = path, load_state(path)
        options = self.state["options"]
        self.device, self.quick = torch.device(options["device"]), options["quick"]
        self.peer = options["peer"] and Path(options["peer"])
        self.cuda = self.device.type == "cuda"
        self.section, self.end = "", 0.0

    def left(self) -> float:
        """Seconds left to this section."""
        return min(self.end, self.state["deadline"]) - time.time()

    def run(self, section: str, share: float, function: Callable[[Bench], None]) -> None:
        """Run one section; what an earlier process stored of it is kept."""
        found = self.state["sections"].setdefault(section, {"status": "", "seconds": 0.0, "rows": []})
        if found["status"] in ("done", "failed", "skipped"):
            return
        budget = self.state["options"]["seconds_budget"]
        begin, before = time.time(), found["seconds"]
        self.section, self.end = section, begin + share * budget - before
        if self.left() <= 0:
            found["status"] = "skipped"
            found["why"] = "the time is used up"
        else:
            found["status"] = "running"
            self.store()
            try:
                function(self)
                found["status"] = "done"
            except Exception:
                found["status"], found["why"] = "failed", traceback.format_exc()
        found["seconds"] = before + time.time() - begin
        self.store()
        self._check_health()
        if self.cuda:
            torch.cuda.empty_cache()

    def store(self) -> None:
        store_state(self.path, self.state)

    def row(self, name: str, function: Callable[[], Row], *, needs: float = 0.0) -> Row:
        """Run a function and keep what it returns, or how it failed.

        Args:
            name: of the row within the section; one that is there already is not run again.
            needs: seconds that it will take; without so many left it is skipped.
        """
        rows = self.state["sections"][self.section]["rows"]
        known = [row for row in rows if row["name"] == name]
        if known:
            return known[0]
        row: Row = {"name": name, "status": "running"}
        rows.append(row)
        if self.left() <= needs:
            row["status"] = "skipped"
            row["why"] = f"{max(self.left(), 0.0):.0f} s left, {needs:.0f} s needed"
            self.store()
            return row
        self.store()
        begin = time.perf_counter()
        try:
            found = function()
            self.wait()
            row |= found
            row["status"] = "done"
        except Exception as error:
            row["status"] = "failed"
            row["why"] = f"{type(error).__name__}: {error}"[:600]
            row["traceback"] = traceback.format_exc()[-3000:]
        row["seconds"] = round(time.perf_counter() - begin, 3)
        sys.stdout.write(f"{self.section} {json.dumps(row, default=str)}\n")
        sys.stdout.flush()
        self.store()
        if row["status"] == "failed":
            self._check_health()
        return row

    def _check_health(self) -> None:
        try:
            self.wait()
            if self.cuda:
                assert float(torch.ones(3, device=self.device).sum()) == 3
        except Exception:
            sys.stdout.write(traceback.format_exc())
            sys.stdout.flush()
            os._exit(SICK)

    def wait(self) -> None:
        if self.cuda:
            torch.cuda.synchronize()

    def timed(
        self,
        call: Callable[[int], Any],
        *,
        sets: int = 1,
        seconds: float = 0.3,
        most: int = 200,
        warm: bool = True,
    ) -> Row:
        """Median and quartiles [ms] of ``call(i)``, where `i` runs through sets of inputs, after a warm-up.

        Args:
            seconds: about how long to measure; five launches at least, of long calls two or one.
            most: launches.
            warm: call each set first; False where that was done.
        """
        least = 2 if self.quick else 5
        seconds = 0.02 if self.quick else seconds
        for i in range(sets if warm else 0):
            call(i)
        self.wait()
        begin = time.perf_counter()
        call(0)
        self.wait()
        once = time.perf_counter() - begin
        if once > LONG_S:
            return {"ms": 1e3 * once, "p25_ms": 1e3 * once, "p75_ms": 1e3 * once, "launches": 1}
        count = 2 if once > 0.5 else max(least, min(most, int(seconds / max(once, 1e-6))))
        begin = time.perf_counter()
        times = self._by_events(call, sets, count) if self.cuda else _by_clock(call, sets, count)
        whole = 1e3 * (time.perf_counter() - begin) / count
        low, middle, high = (
            statistics.quantiles(times, n=4, method="inclusive") if len(times) > 1 else 3 * times
        )
        return {"ms": middle, "p25_ms": low, "p75_ms": high, "mean_ms": whole, "launches": count}

    def _by_events(self, call: Callable[[int], Any], sets: int, count: int) -> list[float]:
        marks = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(count)]
        for number, (start, stop) in enumerate(marks):
            start.record()
            call(number % sets)
            stop.record()
        torch.cuda.synchronize()
        return [start.elapsed_time(stop) for start, stop in marks]

    def peak(self, call: Callable[[int], Any]) -> Row:
        """Most memory [MB] that torch held during one call, and what it held before; empty on the CPU."""
        return self.peaked(call)[0] if self.cuda else {}

    def peaked(self, call: Callable[[int], Any]) -> tuple[Row, Any]:
        """:meth:`peak`, and what the call returned."""
        if not self.cuda:
            return {}, call(0)
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        found = call(0)
        torch.cuda.synchronize()
        return {"peak_mb": torch.cuda.max_memory_allocated() / 1e6, "held_mb": before / 1e6}, found


def _by_clock(call: Callable[[int], Any], sets: int, count: int) -> list[float]:
    found = []
    for number in range(count):
        begin = time.perf_counter()
        call(number % sets)
        found.append(1e3 * (time.perf_counter() - begin))
    return found
