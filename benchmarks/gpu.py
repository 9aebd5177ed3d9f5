"""Correctness and speed on a GPU, in one go: what is known so far is on disk after every row.

    python benchmarks/gpu.py --device cuda --out FOLDER --peer PEER    everything
    python benchmarks/gpu.py --device cpu --quick --out FOLDER        the same at toy sizes
    python benchmarks/gpu.py --table FOLDER/gpu.json                  its table, for benchmarks/README.md

This process only watches: the sections run in another one. Where that one dies or hangs, a new one goes on
after the row that was its end. PEER is a folder with ``site`` (py-soma-x); its assets are made there when
first needed. On CUDA all kernels are compiled first, in as many processes as there are cores.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from gpu_table import gpu_table, short_table
from gpu_warm import warm
from processes import HERE, ROOT, short_commit

__all__ = ["SECTIONS", "main"]

SECTIONS = {
    "machine": ("gpu_checks", 0.1),
    "kernels": ("gpu_kernels", 0.25),
    "layer": ("gpu_checks", 0.15),
    "fit": ("gpu_checks", 0.2),
    "table4": ("gpu_speed", 0.25),
    "graph": ("gpu_speed", 0.15),
    "inversion": ("gpu_speed", 0.35),
    "peer": ("gpu_peer", 0.25),
    "after": ("gpu_checks", 0.1),
}
"""Module whose function of that name runs the section, and the most it may take of the budget."""
SILENT_S = {"cuda": 100.0, "cpu": 400.0}
"""A process that stores nothing for so long hangs."""
ATTEMPTS = 12
WARM_SHARE = 0.4
"""Of the budget, at most, for compiling."""


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--quick", action="store_true", help="toy sizes, for a test of this script")
    parser.add_argument("--seconds-budget", type=float, default=300.0)
    parser.add_argument("--out", type=Path, help="folder of gpu.json and gpu.log; default a new one")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--peer", type=Path, help="folder with site/ and assets/ of py-soma-x")
    parser.add_argument("--commit", default="", help="where git is not there to tell")
    parser.add_argument("--table", type=Path, help="a gpu.json whose table is wanted")
    parser.add_argument("--warm", choices=["yes", "no", "only"], default="yes", help="compile first (CUDA)")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def work(path: Path) -> None:
    """Run the sections that are still open."""
    from gpu_bench import Bench

    bench = Bench(path)
    for name in bench.state["options"]["only"]:
        module, share = SECTIONS[name]
        bench.run(name, share, getattr(importlib.import_module(module), name))


def watch(options: argparse.Namespace, path: Path) -> None:
    """Start workers until all sections are through or the time is over."""
    log = path.with_suffix(".log")
    command = [sys.executable, str(HERE / "gpu.py"), "--worker", str(path)]
    for attempt in range(ATTEMPTS):
        place = log.stat().st_size if log.exists() else 0
        with log.open("a") as stream:
            process = subprocess.Popen(
                command, stdout=stream, stderr=subprocess.STDOUT, cwd=ROOT,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )  # fmt: skip
            why = _wait(process, path, SILENT_S[options.device])
        if not why:
            return
        _mark_dead(path, why, log.read_text(errors="replace")[place:][-2500:], attempt)
        if time.time() > _load(path)["deadline"]:
            return


def _wait(process: subprocess.Popen, path: Path, silent: float) -> str:
    """Why the process ended before its time; empty where it did not."""
    deadline = _load(path)["deadline"] + 20
    while process.poll() is None:
        time.sleep(0.2)
        now = time.time()
        quiet = now - path.stat().st_mtime > silent
        if quiet or now > deadline:
            process.kill()
            process.wait()
            return f"killed: nothing new for {silent:.0f} s" if quiet else "killed: the time is used up"
    return "" if process.returncode == 0 else f"exit code {process.returncode}"


def _load(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def _mark_dead(path: Path, why: str, tail: str, attempt: int) -> None:
    """Note where a worker ended, so that the next one goes on behind it."""
    state = _load(path)
    state.setdefault("restarts", []).append({"attempt": attempt, "why": why, "log": tail})
    found = False
    for section in state["sections"].values():
        for row in section["rows"]:
            if row["status"] == "running":
                row["status"], row["why"], found = "failed", f"the process ended: {why}", True
        if section["status"] == "running" and not section["rows"]:
            section["status"], section["why"], found = "failed", why, True
    if not found and attempt:  # dies outside of rows: leave out the section at which it does
        for section in state["sections"].values():
            if section["status"] == "running":
                section["status"], section["why"] = "failed", why
    path.write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")


def begin(options: argparse.Namespace) -> Path:
    """Write the state that workers go on from."""
    folder = (options.out or Path(tempfile.mkdtemp(prefix="soma-gpu-"))).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "gpu.json"
    path.with_suffix(".log").unlink(missing_ok=True)
    now = time.time()
    state = {
        "options": {
            "device": options.device, "quick": options.quick, "seconds_budget": options.seconds_budget,
            "only": [name for name in SECTIONS if name in options.only],
            "peer": str(options.peer.absolute()) if options.peer else "",
        },
        "commit": options.commit or short_commit(), "started": now,
        "deadline": now + options.seconds_budget, "sections": {},
    }  # fmt: skip
    path.write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")
    return path


def main() -> None:
    options = parse()
    if options.worker:
        work(options.worker)
        return
    if options.table:
        from run import insert

        state = _load(options.table)
        text = gpu_table(state)
        if not state["options"]["quick"]:  # toy sizes are nobody's figures
            insert(HERE / "README.md", "gpu", text)
        sys.stdout.write(text + "\n")
        return
    path = begin(options)
    if options.device == "cuda" and options.warm != "no":
        state = _load(path)
        state["compile"] = warm(options.device, state["started"] + WARM_SHARE * options.seconds_budget)
        path.write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")
        sys.stdout.write(f"compiled: {json.dumps(state['compile'])[:1500]}\n")
        if options.warm == "only":
            return
    watch(options, path)
    state = _load(path)
    sys.stdout.write(f"{short_table(state)}\n{path}\n")
    bad = [row for section in state["sections"].values() for row in section["rows"]
           if row["status"] == "failed" or row.get("ok") is False]  # fmt: skip
    failed = [name for name, section in state["sections"].items() if section["status"] == "failed"]
    sys.exit(1 if bad or failed else 0)


if __name__ == "__main__":
    main()
