"""Time the forward path and pose inversion against their peers: correctness first, then alternating rounds.

    python -m venv peer
    peer/bin/pip install torch==2.13.0
    peer/bin/pip install py-soma-x==0.1.0 anny==0.6.2
    python benchmarks/run.py --peer-python peer/bin/python

Writes ``forward_cpu.json`` and ``inversion_cpu.json`` in ``benchmarks/results``, and the tables in
``benchmarks/README.md`` and ``README.md``.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from inputs import forward_inputs
from inversion import PEER_METHODS, inversion_table, run_inversion
from processes import HERE, ROOT, Worker, cpu_name, medians_of_rounds, short_commit

SAME_MM = {"soma": 5.0, "anny": 5.0}
"""Largest mean distance to the peer [mm] at which the work counts as the same. Different frames of joints
with several children, and our reposing to the bind pose, account for about one (see the experiment
``anny_reference``)."""
CASES = [("forward", 1), ("forward", 8), ("forward", 32), ("forward", 128), ("pose", 32), ("pose", 128),
         ("forward_backward", 8)]  # fmt: skip
BARS = {
    ("soma", "forward", 32): 3, ("soma", "forward", 128): 3,
    ("anny", "forward", 32): 5, ("anny", "forward", 128): 5,
    ("soma", "pose", 32): 4, ("soma", "pose", 128): 4, ("anny", "pose", 32): 4, ("anny", "pose", 128): 4,
    ("soma", "forward_backward", 8): 2, ("anny", "forward_backward", 8): 2,
}  # fmt: skip


def compare(ours: Worker, peer: Worker, inputs: str, folder: Path, *, limit_mm: float, hips: bool) -> float:
    """Mean distance [mm] between the vertices of both; beyond the limit nothing is timed."""
    bodies = []
    for worker in (ours, peer):
        path = str(folder / f"{worker.name}.npy")
        worker.ask(case="forward", inputs=inputs, output=path)
        bodies.append(np.load(path).astype(np.float64))
    first, second = bodies
    if hips:  # the anny package stands its root on the ground: compare shapes about their centres
        first, second = (body - body.mean(1, keepdims=True) for body in bodies)
    distance = 1e3 * float(np.linalg.norm(first - second, axis=-1).mean())
    if not distance <= limit_mm:
        raise SystemExit(
            f"{ours.name} and {peer.name} are {distance:.1f} mm apart: not the same work, not timed"
        )
    return distance


def run_backend(backend: str, options: argparse.Namespace, folder: Path, joint_names: Sequence[str]) -> dict:
    files = {}
    for batch in {batch for _, batch in CASES}:
        files[batch] = str(folder / f"inputs_{batch}.npz")
        np.savez(files[batch], **forward_inputs(joint_names, batch, options.seed))
    here, peer_python = sys.executable, options.peer_python
    ours = Worker("ours", [here, "ours.py", backend])
    peer = Worker("peer", [peer_python, "peers.py", "py-soma-x", str(folder / "assets"), backend])
    package = Worker("package", [here, "peers.py", "anny"]) if backend == "anny" else None
    result = {
        "versions": {worker.name: worker.versions for worker in (ours, peer, package) if worker},
        "rows": [],
    }
    result["mean_distance_mm"] = compare(ours, peer, files[8], folder, limit_mm=SAME_MM[backend], hips=False)
    if package:
        result["mean_distance_to_package_mm"] = compare(
            ours, package, files[8], folder, limit_mm=SAME_MM[backend], hips=True
        )
    for case, batch in CASES:
        workers = [ours, peer] + ([package] if package and case == "forward" else [])
        turns = [(worker.name, worker, {"case": case, "inputs": files[batch]}) for worker in workers]
        times = medians_of_rounds(turns, rounds=options.rounds, seconds=options.seconds)
        row = {
            "case": case,
            "batch": batch,
            "ms": {name: statistics.median(values) for name, values in times.items()},
        }
        for name in times:
            if name != "ours":
                ratios = [theirs / mine for theirs, mine in zip(times[name], times["ours"], strict=True)]
                row[f"ratio_to_{name}"] = statistics.median(ratios)
        row["bar"] = BARS.get((backend, case, batch))
        result["rows"].append(row)
        sys.stderr.write(f"{backend} {json.dumps(row)}\n")
    result["peak_mb"] = {worker.name: worker.peak_mb for worker in (ours, peer, package) if worker}
    for worker in (ours, peer, package):
        if worker:
            worker.close()
    return result


def table(results: dict) -> str:
    """The figures as markdown."""
    lines = ["| backend | case | batch | ours, ms | py-soma-x, ms | ratio | bar | anny package, ms | ratio |",
             "|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for backend, result in results["backends"].items():
        for row in result["rows"]:
            ms, package = row["ms"], row["ms"].get("package")
            bar = f"{row['bar']}x" if row["bar"] else ""
            last = f"{package:.1f} | {row['ratio_to_package']:.1f}x" if package else " | "
            lines.append(
                f"| {backend} | {row['case'].replace('_', ' + ')} | {row['batch']} | {ms['ours']:.1f} | "
                f"{ms['peer']:.1f} | {row['ratio_to_peer']:.1f}x | {bar} | {last} |"
            )
    lines.append("")
    for backend, result in results["backends"].items():
        peak, versions = result["peak_mb"], result["versions"]
        lines.append(
            f"{backend}: peak memory {peak['ours']:.0f} MB against {peak['peer']:.0f} MB; construction "
            f"{versions['ours']['construction_s']} s; "
            f"mean distance of the two results {result['mean_distance_mm']:.2f} mm."
        )
    machine = results["machine"]
    lines += ["", f"{machine['cpu']}, 2 threads, float32, medians of {machine['rounds']} alternating rounds; "
              f"torch {machine['torch']}, py-soma-x {machine['peer']}, commit {machine['commit']}. "
              "Written by `python benchmarks/run.py`."]  # fmt: skip
    return "\n".join(lines)


def insert(path: Path, name: str, text: str) -> None:
    """Replace what stands between the marks of a benchmark."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if not path.exists() or begin not in path.read_text(encoding="utf-8"):
        return
    old = path.read_text(encoding="utf-8")
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    path.write_text(pattern.sub(lambda _: f"{begin}\n{text}\n{end}", old), encoding="utf-8")


def store(name: str, mark: str, results: dict, text: str) -> None:
    """Write the results and put their table into the texts that have a place for it."""
    path = HERE / "results" / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    for file in (HERE / "README.md", ROOT / "README.md"):
        insert(file, mark, text)
    sys.stdout.write(text + "\n")


def machine(options: argparse.Namespace, versions: dict) -> dict:
    return {"cpu": cpu_name(), "rounds": options.rounds, "seed": options.seed,
            "torch": versions["ours"]["torch"], "peer": versions["peer"]["py-soma-x"],
            "commit": short_commit()}  # fmt: skip


def run_forward(options: argparse.Namespace, folder: Path) -> None:
    from soma_core.rig import load_canonical

    names = load_canonical("mid")[1].user_joint_names
    backends = {backend: run_backend(backend, options, folder, names) for backend in options.backends}
    results = {"machine": machine(options, backends[options.backends[0]]["versions"]), "backends": backends}
    store("forward_cpu", "benchmarks", results, table(results))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peer-python", required=True, help="interpreter with py-soma-x installed")
    parser.add_argument("--only", choices=["forward", "inversion"], help="one of the two benchmarks")
    parser.add_argument("--backends", nargs="+", default=["soma", "anny"], help="of the forward path")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each implementation in each round")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=100, help="of each sequence that is inverted")
    parser.add_argument(
        "--peer-methods", nargs="+", default=PEER_METHODS, choices=PEER_METHODS, help="of pose inversion"
    )
    parser.add_argument("--earlier", help="another checkout of ours, whose fits are timed beside")
    options = parser.parse_args()
    options.peer_python = str(Path(options.peer_python).absolute())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run([sys.executable, "peers.py", "build", str(folder / "assets")], check=True, cwd=HERE)
        if options.only != "inversion":
            run_forward(options, folder)
        if options.only != "forward":
            versions, rows = run_inversion(options, folder)
            results = {"machine": machine(options, versions), "rows": rows}
            store("inversion_cpu", "inversion", results, inversion_table(results))


if __name__ == "__main__":
    main()
