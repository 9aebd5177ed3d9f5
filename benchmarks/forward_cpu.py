"""The forward path against the peers: vertices first, then alternating rounds, with one thread and with all.

``plain`` is our layer doing the work of the peers, ``default`` the layer as it ships.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from inputs import forward_inputs
from processes import Found, Worker, rounds_of_turns

__all__ = ["forward_tables", "run_forward", "short_table"]

CASES = [("forward", 1), ("forward", 8), ("forward", 32), ("forward", 128), ("pose", 1), ("pose", 32),
         ("pose", 128), ("forward_backward", 8)]  # fmt: skip
SHORT = [("forward", 32), ("forward", 128), ("pose", 32), ("pose", 128)]
SAME_MM = {"peer": 5.0, "package": 5.0, "default": 0.01}
"""Largest distance [mm] at which the work counts as the same: mean to the peers, of the default layer the
largest to double precision. Different frames of joints with several children, and our reposing to the bind
pose, account for about one to the peers (see the experiment ``anny_reference``)."""
SETTLED = 10.0
"""Rounds repeat until the interquartile range of each ratio is below so many percent of its median."""
NAMES = {"peer": "py-soma-x", "package": "anny package", "default": "default", "threads": "threads"}


def bars_of(case: str, batch: int, backend: str) -> dict[str, float]:
    """What the ratios of a row mean to be: ``default`` at most, all others at least."""
    if case == "pose":
        return {"peer": 12, "default": 1.6}
    if case == "forward_backward":
        return {"peer": 3.5}
    if batch >= 32:
        return {"peer": 6, "package": 2.5, "default": 1.25, "threads": 1.6}
    return {"peer": 3, "default": 1.25} if (batch, backend) == (1, "soma") else {"default": 1.25}


def _apart(workers: Sequence[Worker], case: str, file: str, folder: Path, *, centred: bool) -> np.ndarray:
    """Distances [mm] between the vertices of two workers."""
    bodies = []
    for worker in workers:
        path = str(folder / f"{worker.name}.npy")
        worker.ask(case=case, inputs=file, output=path, warm=0)
        body = np.load(path).astype(np.float64)
        bodies.append(body - body.mean(1, keepdims=True) if centred else body)
    return 1e3 * np.linalg.norm(bodies[0] - bodies[1], axis=-1)


def _check(workers: dict[str, Worker], reference: Worker, files: dict[int, str], folder: Path) -> dict:
    """Distances [mm]; beyond the limits nothing is timed."""
    found = {}
    for name in workers.keys() - {"plain", "default"}:
        pair, centred = (workers["plain"], workers[name]), name == "package"  # which stands on the ground
        found[name] = float(_apart(pair, "forward", files[8], folder, centred=centred).mean())
    pair = workers["default"], reference
    found["default"] = max(
        float(_apart(pair, case, files[batch], folder, centred=False).max())
        for batch in (8, 128) for case in ("forward", "pose")
    )  # fmt: skip
    for name, distance in found.items():
        if not distance <= SAME_MM[name]:
            raise SystemExit(f"{name}: {distance:.3f} mm apart, not the same work, not timed")
    return found


def _spread(values: Sequence[float]) -> float:
    """Interquartile range over median [%]."""
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return 100 * (high - low) / middle


def _ratios(found: Found) -> dict[str, list[float]]:
    """Times over those of ``plain`` in the same round."""
    return {
        name: [ms / plain for ms, plain in zip(values["ms"], found["plain"]["ms"], strict=True)]
        for name, values in found.items() if name != "plain"
    }  # fmt: skip


def _row(case: str, batch: int, workers: dict[str, Worker], file: str, options: argparse.Namespace) -> dict:
    turns = [(name, worker, {"case": case, "inputs": file}) for name, worker in workers.items()
             if name != "package" or case == "forward"]  # fmt: skip
    found = rounds_of_turns(
        turns, rounds=options.rounds, seconds=options.seconds or 0.25, least=2, most=options.most_rounds,
        settled=lambda found: all(_spread(values) < SETTLED for values in _ratios(found).values()),
    )  # fmt: skip
    ratios = _ratios(found)
    return {
        "case": case, "batch": batch, "rounds": len(ratios["peer"]),
        "ms": {name: statistics.median(values["ms"]) for name, values in found.items()},
        "cpu_ms": {name: statistics.median(values["cpu_ms"]) for name, values in found.items()},
        "spread": {name: _spread(values["ms"]) for name, values in found.items()},
        "ratios": {name: statistics.median(values) for name, values in ratios.items()},
        "ratio_spread": {name: _spread(values) for name, values in ratios.items()},
    }  # fmt: skip


def _run(
    backend: str, threads: int, files: dict[int, str], options: argparse.Namespace, folder: Path
) -> dict:
    """All cases of a backend with so many threads."""
    ours = [sys.executable, "ours.py", backend]
    commands = {
        "plain": [*ours, "plain"], "default": [*ours, "default"],
        "peer": [options.peer_python, "peers.py", "py-soma-x", str(folder / "assets"), backend],
    }  # fmt: skip
    if backend == "anny":
        commands["package"] = [sys.executable, "peers.py", "anny"]
    workers = {name: Worker(name, command, threads=threads) for name, command in commands.items()}
    reference = Worker("reference", [*ours, "reference"], threads=threads)
    distances = _check(workers, reference, files, folder)
    reference.close()
    rows = []
    for case, batch in CASES:
        rows.append(_row(case, batch, workers, files[batch], options))
        sys.stderr.write(f"{backend}, {threads} threads: {json.dumps(rows[-1])}\n")
    for worker in workers.values():
        worker.close()
    return {
        "versions": {name: worker.versions for name, worker in workers.items()},
        "distances_mm": distances, "rows": rows,
        "peak_mb": {name: worker.peak_mb for name, worker in workers.items()},
    }  # fmt: skip


def run_forward(options: argparse.Namespace, folder: Path) -> list[dict]:
    """Of each number of threads, the rows of each backend."""
    from soma_core.rig import load_canonical

    names, files = load_canonical("mid")[1].user_joint_names, {}
    for batch in {batch for _, batch in CASES}:
        files[batch] = str(folder / f"inputs_{batch}.npz")
        np.savez(files[batch], **forward_inputs(names, batch, options.seed))
    settings = []
    for threads in options.settings:
        backends = {name: _run(name, threads, files, options, folder) for name in options.backends}
        settings.append({"threads": threads, "backends": backends})
    if len(settings) == 2:
        for backend in options.backends:
            single, many = (setting["backends"][backend]["rows"] for setting in settings)
            for one, row in zip(single, many, strict=True):
                row["ratios"]["threads"] = one["ms"]["plain"] / row["ms"]["plain"]
    return settings


def _bars(row: dict, backend: str) -> str:
    cells = []
    for name, bar in bars_of(row["case"], row["batch"], backend).items():
        if name in row["ratios"]:
            ratio, least = row["ratios"][name], name != "default"
            met = ratio >= bar if least else ratio <= bar
            word = "met" if met else "**missed**"
            cells.append(f"{NAMES[name]} {ratio:.2f} {'≥' if least else '≤'} {bar}: {word}")
    return "; ".join(cells)


def _time(row: dict, name: str) -> str:
    if name not in row["ms"]:
        return ""
    return f"{row['ms'][name]:.1f} ({row['cpu_ms'][name]:.1f}) ±{row['spread'][name]:.0f}%"


def _ratio(row: dict, name: str) -> str:
    if name not in row["ratios"]:
        return ""
    mark = "†" if row["ratio_spread"][name] >= SETTLED else ""
    return f"{row['ratios'][name]:.{2 if name == 'default' else 1}f}x{mark}"


def _footer(results: dict) -> list[str]:
    machine = results["machine"]
    return [
        "", f"† the ratio still spread over {SETTLED:.0f} % of itself after {machine['most_rounds']} rounds.",
        "", f"{machine['cpu']}, float32, medians of {machine['rounds']} to {machine['most_rounds']} "
        f"alternating rounds; torch {machine['torch']}, py-soma-x {machine['peer']}, commit "
        f"{machine['commit']}. Written by `python benchmarks/run.py`.",
    ]  # fmt: skip


def _setting_table(setting: dict) -> list[str]:
    lines = [
        f"Threads of every implementation: {setting['threads']}", "",
        "| backend | case | batch | plain, ms | default, ms | default / plain | py-soma-x, ms | ratio | "
        "anny package, ms | ratio | bars |", "|---|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for backend, result in setting["backends"].items():
        for row in result["rows"]:
            cells = [
                backend, row["case"].replace("_", " + "), str(row["batch"]), _time(row, "plain"),
                _time(row, "default"), _ratio(row, "default"), _time(row, "peer"),
                _ratio(row, "peer"), _time(row, "package"), _ratio(row, "package"), _bars(row, backend),
            ]  # fmt: skip
            lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    for backend, result in setting["backends"].items():
        peak, built, apart = result["peak_mb"], result["versions"], result["distances_mm"]
        lines.append(
            f"{backend}: peak memory plain {peak['plain']:.0f} MB, default {peak['default']:.0f} MB, "
            f"py-soma-x {peak['peer']:.0f} MB; construction {built['plain']['construction_s']} s and "
            f"{built['default']['construction_s']} s; plain and py-soma-x {apart['peer']:.2f} mm apart on "
            f"average, default and its float64 reference {apart['default']:.4f} mm at most."
        )
    return [*lines, ""]


def forward_tables(results: dict) -> str:
    """A table for each number of threads, as markdown."""
    lines = [line for setting in results["settings"] for line in _setting_table(setting)]
    lines.append("Times: wall clock of a call (processors' time), and the interquartile range over rounds.")
    return "\n".join(lines + _footer(results))


def short_table(results: dict) -> str:
    """The figures of large batches beside each other for all numbers of threads, as markdown."""
    settings, head = results["settings"], "| backend | case | batch |"
    for setting in settings:
        count = f"{setting['threads']} thread{'s' * (setting['threads'] > 1)}"
        head += f" {count}: plain, ms | default, ms | py-soma-x, ms | py-soma-x / plain |"
    lines = [head, "|---" * (3 + 4 * len(settings)) + "|"]
    for backend in settings[0]["backends"]:
        for index, key in enumerate(CASES):
            if key in SHORT:
                line = f"| {backend} | {key[0]} | {key[1]} |"
                for row in (setting["backends"][backend]["rows"][index] for setting in settings):
                    times = " | ".join(f"{row['ms'][name]:.1f}" for name in ("plain", "default", "peer"))
                    line += f" {times} | {_ratio(row, 'peer')} |"
                lines.append(line)
    return "\n".join(lines + _footer(results))
