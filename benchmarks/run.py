"""Time the forward path against its peers: correctness first, then alternating rounds, then the tables.

    python -m venv peer
    peer/bin/pip install torch==2.13.0
    peer/bin/pip install py-soma-x==0.1.0 anny==0.6.2
    python benchmarks/run.py --peer-python peer/bin/python

Writes ``benchmarks/results/forward_cpu.json`` and the tables in ``benchmarks/README.md`` and ``README.md``.
"""

from __future__ import annotations

import argparse
import json
import platform
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from inputs import forward_inputs

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
MARKS = ("<!-- benchmarks:begin -->", "<!-- benchmarks:end -->")
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


class Worker:
    """One implementation in a process of its own."""

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self.name = name
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=HERE
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


def measure(
    workers: list[Worker], case: str, inputs: str, *, rounds: int, seconds: float
) -> dict[str, list[float]]:
    """Median milliseconds of each round, workers taking turns."""
    found: dict[str, list[float]] = {worker.name: [] for worker in workers}
    for _ in range(rounds):
        for worker in workers:
            reply = worker.ask(case=case, inputs=inputs, seconds=seconds, least=3)
            found[worker.name].append(statistics.median(reply["times"]))
    return found


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
        times = measure(workers, case, files[batch], rounds=options.rounds, seconds=options.seconds)
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


def insert(path: Path, text: str) -> None:
    """Replace what stands between the marks."""
    if not path.exists() or MARKS[0] not in path.read_text(encoding="utf-8"):
        return
    old = path.read_text(encoding="utf-8")
    pattern = re.compile(re.escape(MARKS[0]) + ".*?" + re.escape(MARKS[1]), re.DOTALL)
    path.write_text(pattern.sub(lambda _: f"{MARKS[0]}\n{text}\n{MARKS[1]}", old), encoding="utf-8")


def machine(options: argparse.Namespace, backends: dict) -> dict:
    names = [
        line.split(":")[1].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if "model name" in line
    ]
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT)
    versions = next(iter(backends.values()))["versions"]
    cpu = names[0] if names else platform.processor()
    return {"cpu": cpu, "rounds": options.rounds, "seed": options.seed,
            "torch": versions["ours"]["torch"], "peer": versions["peer"]["py-soma-x"],
            "commit": commit.stdout.strip()}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peer-python", required=True, help="interpreter with py-soma-x installed")
    parser.add_argument("--backends", nargs="+", default=["soma", "anny"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each implementation in each round")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.peer_python = str(Path(options.peer_python).absolute())
    from soma_core.rig import load_canonical

    names = load_canonical("mid")[1].user_joint_names
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run([sys.executable, "peers.py", "build", str(folder / "assets")], check=True, cwd=HERE)
        backends = {backend: run_backend(backend, options, folder, names) for backend in options.backends}
    results = {"machine": machine(options, backends), "backends": backends}
    path = HERE / "results" / "forward_cpu.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    for file in (HERE / "README.md", ROOT / "README.md"):
        insert(file, table(results))
    sys.stdout.write(table(results) + "\n")


if __name__ == "__main__":
    main()
