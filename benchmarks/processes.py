"""Drive implementations that run in processes of their own; the other end is ``worker.py``."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
from collections.abc import Sequence
from pathlib import Path

__all__ = ["HERE", "ROOT", "Worker", "cpu_name", "medians_of_rounds", "short_commit"]

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent


class Worker:
    """One implementation in a process of its own."""

    def __init__(self, name: str, command: Sequence[str], *, checkout: str | None = None) -> None:
        """Start it; with `checkout`, from the sources in that folder."""
        self.name = name
        where = None
        if checkout is not None:  # its plugins too
            sources = [checkout, *map(str, Path(checkout).glob("plugins/*"))]
            where = {**os.environ, "PYTHONPATH": os.pathsep.join(sources)}
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=HERE, env=where
        )
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


def medians_of_rounds(
    turns: Sequence[tuple[str, Worker, dict]], *, rounds: int, seconds: float, least: int = 3
) -> dict[str, list[float]]:
    """Median milliseconds of each round, in which the turns (name, worker, request) follow each other."""
    found: dict[str, list[float]] = {name: [] for name, _, _ in turns}
    for _ in range(rounds):
        for name, worker, request in turns:
            reply = worker.ask(**request, seconds=seconds, least=least)
            found[name].append(statistics.median(reply["times"]))
    return found


def cpu_name() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":")[1].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor()


def short_commit() -> str:
    command = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT).stdout.strip()
