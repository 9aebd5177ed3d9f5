"""Drive implementations that run in processes of their own; the other end is ``worker.py``."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

__all__ = ["HERE", "ROOT", "Worker", "cpu_name", "rounds_of_turns", "short_commit"]

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
POOLS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class Worker:
    """One implementation in a process of its own."""

    def __init__(
        self, name: str, command: Sequence[str], *, threads: int, checkout: str | None = None,
        cache: Path | None = None,
    ) -> None:  # fmt: skip
        """Start it with `threads`, also its last argument; with `checkout`, from the sources there.

        Sources of another day store what they derive in another form: they need a `cache` of their own.
        """
        self.name = name
        where = {**os.environ, **dict.fromkeys(POOLS, str(threads))}
        if checkout is not None:  # its plugins too
            sources = [checkout, *map(str, Path(checkout).glob("plugins/*"))]
            where["PYTHONPATH"] = os.pathsep.join(sources)
            where["SOMA_CACHE_DIR"] = str(cache)
        self.process = subprocess.Popen(
            [*command, str(threads)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=HERE,
            env=where,
        )  # fmt: skip
        self.versions = self._read()["versions"]
        self.peak_mb = 0.0

    def _read(self) -> dict:
        for line in self.process.stdout:
            if line.startswith("{"):  # libraries greet on stdout while they are imported
                return json.loads(line)
        raise SystemExit(f"{self.name} ended; its own message is above")

    def ask(self, **request: object) -> dict:
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        reply = self._read()
        self.peak_mb = max(self.peak_mb, reply.get("peak_mb", 0.0))
        return reply

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


Found = dict[str, dict[str, list[float]]]


def rounds_of_turns(
    turns: Sequence[tuple[str, Worker, dict]], *, rounds: int, seconds: float, least: int = 3,
    most: int = 0, settled: Callable[[Found], bool] = lambda _: True,
) -> Found:  # fmt: skip
    """Of each name, median ``ms`` and mean ``cpu_ms`` of a call in each round.

    In a round the turns (name, worker, request) follow each other. There are `rounds`, and up to `most` until
    what was found is `settled`.
    """
    found: Found = {name: {"ms": [], "cpu_ms": []} for name, _, _ in turns}
    done = 0
    while done < rounds or (done < most and not settled(found)):
        for name, worker, request in turns:
            reply = worker.ask(**request, seconds=seconds, least=least)
            found[name]["ms"].append(statistics.median(reply["times"]))
            found[name]["cpu_ms"].append(reply["cpu_ms"])
        done += 1
    return found


def cpu_name() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":")[1].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor()


def short_commit() -> str:
    command = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT).stdout.strip()
