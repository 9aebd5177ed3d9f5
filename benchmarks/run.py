"""Time the forward path and pose inversion against their peers: correctness first, then alternating rounds.

    python -m venv peer
    peer/bin/pip install torch==2.13.0
    peer/bin/pip install py-soma-x==0.1.0 anny==0.6.2
    python benchmarks/run.py --peer-python peer/bin/python

    git worktree add /tmp/earlier b6ab945
    python benchmarks/run.py --only inversion --cases own --frames 512 --earlier /tmp/earlier

The first writes ``forward_cpu.json`` and ``inversion_cpu.json`` in ``benchmarks/results``, the tables in
``benchmarks/README.md``, and a short one in ``docs/benchmarks.md``. Bars that are missed are said there.
The second prints how our own fits compare with those of an earlier commit, and writes nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from forward_cpu import forward_tables, run_forward, short_table
from inversion import CASES, PEER_METHODS, inversion_table, run_inversion
from processes import HERE, ROOT, cpu_name, short_commit


def insert(path: Path, name: str, text: str) -> None:
    """Replace what stands between the marks of a benchmark."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if not path.exists() or begin not in path.read_text(encoding="utf-8"):
        return
    old = path.read_text(encoding="utf-8")
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    path.write_text(pattern.sub(lambda _: f"{begin}\n{text}\n{end}", old), encoding="utf-8")


def rounded(value: object) -> object:
    """Results with numbers of four digits: what follows is noise."""
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(one) for one in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def store(name: str, mark: str, results: dict, text: str, short: str = "") -> None:
    """Write the results and put their table into the README beside, `short` into the documentation."""
    path = HERE / "results" / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(rounded(results), separators=(",", ":")) + "\n", encoding="utf-8")
    insert(HERE / "README.md", mark, text)
    insert(ROOT / "docs/benchmarks.md", mark, short or text)
    sys.stdout.write(text + "\n")


def machine(options: argparse.Namespace, versions: dict) -> dict:
    ours = versions.get("ours") or versions["plain"]
    return {"cpu": cpu_name(), "rounds": options.rounds, "most_rounds": options.most_rounds,
            "threads": options.settings[-1], "seed": options.seed, "torch": ours["torch"],
            "frames": options.frames, "commit": short_commit(),
            "peer": versions.get("peer", {}).get("py-soma-x", "")}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peer-python", help="interpreter with py-soma-x; without it our fits alone")
    parser.add_argument("--only", choices=["forward", "inversion"], help="one of the two benchmarks")
    parser.add_argument("--backends", nargs="+", default=["soma", "anny"], help="of the forward path")
    parser.add_argument("--threads", choices=["1", "all", "both"], default="both",
                        help="of every implementation; inversion runs with the larger number")  # fmt: skip
    parser.add_argument("--rounds", type=int, default=5, help="of the forward path, more until it settles")
    parser.add_argument("--most-rounds", type=int, default=12, help="of the forward path")
    parser.add_argument("--seconds", type=float, help="of each turn in each round (0.25; inversion 1)")
    parser.add_argument("--quick", action="store_true", help="few rounds: whether all of it runs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=100, help="of each sequence that is inverted")
    parser.add_argument(
        "--peer-methods", nargs="+", default=PEER_METHODS, choices=PEER_METHODS, help="of pose inversion"
    )
    parser.add_argument("--cases", nargs="+", default=CASES, choices=CASES, help="of pose inversion")
    parser.add_argument("--earlier", help="another checkout of ours, whose fits are timed beside")
    options = parser.parse_args()
    if options.peer_python:
        options.peer_python = str(Path(options.peer_python).absolute())
    elif options.only != "inversion":
        parser.error("--peer-python is missing: the forward path is compared with the peer's")
    cores = len(os.sched_getaffinity(0))
    options.settings = {"1": [1], "all": [cores], "both": sorted({1, cores})}[options.threads]
    if options.quick:
        vars(options).update(rounds=2, most_rounds=2, seconds=0.01, frames=10)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.peer_python:
            build = [sys.executable, "peers.py", "build", str(folder / "assets")]
            subprocess.run(build, check=True, cwd=HERE)
        if options.only != "inversion":
            settings = run_forward(options, folder)
            versions = settings[0]["backends"][options.backends[0]]["versions"]
            results = {"machine": machine(options, versions), "settings": settings}
            store("forward_cpu", "benchmarks", results, forward_tables(results), short_table(results))
        if options.only != "forward":
            versions, rows = run_inversion(options, folder)
            results = {"machine": machine(options, versions), "rows": rows}
            table = inversion_table(results)
            if options.peer_python:
                store("inversion_cpu", "inversion", results, table)
            else:
                sys.stdout.write(table + "\n")


if __name__ == "__main__":
    main()
