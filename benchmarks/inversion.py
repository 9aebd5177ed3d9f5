"""Pose inversion, ours and the peer's: errors on the same meshes first, then alternating rounds.

Cases: ``own`` is a motion on meshes that each implementation posed itself, so that an exact answer exists;
``woman`` and ``child`` are meshes that the anny package posed with its own rig of 104 bones, brought to the
canonical mesh once and given to both. Errors are those of the mid mesh under each implementation's own
forward model, whatever the level of detail of the fit; ``own`` at low is measured on what was posed.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path

import numpy as np
from inputs import own_motion, own_rig_meshes
from processes import Worker, rounds_of_turns

__all__ = ["CASES", "PEER_METHODS", "inversion_table", "run_inversion"]

LODS = ("low", "mid")
CASES = ("own", "woman", "child")
OURS = ("plain", "default")
"""Skinning by the public joints, which is what the peer fits, and the layer and fit as they ship."""
REFERENCE = "analytical"
PEER_METHODS = ("skeleton_transfer", REFERENCE, "autograd", "analytical_autograd")
SLOW = ("autograd", "analytical_autograd")
"""A hundred steps of Adam: timed once a sequence."""
BARS = {"low": 3, "mid": 8}
"""How many times faster than the peer's analytical solver our plain fit means to be."""
OWN_BARS = {("earlier", "plain"): "1.7x", ("earlier", "default"): "7x", ("ours", "default"): "at most 4x"}
"""The same against commit b6ab945, each fit against its own; and of the default against the plain fit."""
WORST_MM = {"own": 20.0, "woman": 30.0, "child": 30.0}
"""Mean error beyond which a result is wrong, whoever made it, and nothing is timed."""


def run_inversion(options: argparse.Namespace, folder: Path) -> tuple[dict, list[dict]]:
    """Versions, and a row for each case, level of detail and method; without an interpreter no peer's."""
    files = {"own": folder / "own.npz"}
    np.savez(files["own"], **own_motion(options.frames, options.seed))
    others = own_rig_meshes(options.frames, options.seed) if {*options.cases} - {"own"} else {}
    for name, arrays in others.items():
        files[name] = folder / f"{name}.npz"
        np.savez(files[name], **arrays)
    threads = options.settings[-1]
    command = [sys.executable, "ours.py", "inversion"]
    workers = [Worker("ours", command, threads=threads)]
    if options.peer_python:
        theirs = [options.peer_python, "peers.py", "py-soma-x-inversion", str(folder / "assets")]
        workers.append(Worker("peer", theirs, threads=threads))
    if options.earlier:
        checkout = str(Path(options.earlier).absolute())
        workers.append(Worker("earlier", command, threads=threads, checkout=checkout, cache=folder / "cache"))
    rows = []
    for case in options.cases:
        for lod in LODS:
            rows += _compare(case, lod, str(files[case]), workers, options, folder)
    versions = {worker.name: worker.versions for worker in workers}
    for worker in workers:
        rows.append({"implementation": worker.name, "peak_mb": worker.peak_mb})
        worker.close()
    return versions, rows


def _compare(
    case: str, lod: str, file: str, workers: list[Worker], options: argparse.Namespace, folder: Path
) -> list[dict]:
    """Errors of every method, then times."""
    methods = [
        (worker, method) for worker in workers
        for method in (options.peer_methods if worker.name == "peer" else OURS)
    ]  # fmt: skip
    rows = []
    for worker, method in methods:
        request = {"case": f"{lod}/{method}", "inputs": file, "warm": 0 if method in SLOW else 1}
        path = folder / "result.npy"
        worker.ask(**request, output=str(path))
        found, target = np.load(path)
        rows.append({"case": case, "lod": lod, "implementation": worker.name, "method": method,
                     **_errors(found, target)})  # fmt: skip
        if not rows[-1]["mean_mm"] < WORST_MM[case]:
            raise SystemExit(f"{worker.name}, {method}: {rows[-1]['mean_mm']:.1f} mm on {case}; not timed")
    quick = [(f"{worker.name} {method}", worker, {"case": f"{lod}/{method}", "inputs": file})
             for worker, method in methods if method not in SLOW]  # fmt: skip
    times = rounds_of_turns(quick, rounds=options.rounds, seconds=options.seconds or 1.0, least=2)
    slow = [(f"peer {method}", worker, {"case": f"{lod}/{method}", "inputs": file})
            for worker, method in methods if method in SLOW]  # fmt: skip
    times |= rounds_of_turns(slow, rounds=1, seconds=0.0, least=1)
    for row in rows:
        spent = times[f"{row['implementation']} {row['method']}"]["ms"]
        row["frames_per_second"] = 1e3 * options.frames / statistics.median(spent)
        row["ms_a_frame"] = statistics.median(spent) / options.frames
        for method in OURS:
            pairs = zip(spent, times[f"ours {method}"]["ms"], strict=False)
            row[f"ratio_to_{method}"] = statistics.median(theirs / ms for theirs, ms in pairs)
        sys.stderr.write(f"{row}\n")
    return rows


def _errors(found: np.ndarray, target: np.ndarray) -> dict[str, float]:
    error = 1e3 * np.linalg.norm(found.astype(np.float64) - target, axis=-1)
    return {"mean_mm": float(error.mean()), "median_mm": float(np.median(error)),
            "p95_mm": float(np.percentile(error, 95)), "max_mm": float(error.max())}  # fmt: skip


def inversion_table(results: dict) -> str:
    """The figures as markdown."""
    lines = ["| case | LOD | method | mean, mm | median | P95 | max | ms/frame | frames/s | "
             "time over our plain fit's | over our default fit's | bar |", "|---" * 12 + "|"]  # fmt: skip
    names = {"ours": "**ours: {}**", "peer": "py-soma-x: {}", "earlier": "ours, an earlier commit: {}"}
    for row in results["rows"]:
        if "case" not in row:
            continue
        name = names[row["implementation"]].format(row["method"].replace("_", " "))
        bar = OWN_BARS.get((row["implementation"], row["method"]), "")
        bar = f"{BARS[row['lod']]}x" if row["method"] == REFERENCE else bar
        cells = [f"{row[key]:.4g}" for key in ("mean_mm", "median_mm", "p95_mm", "max_mm")]
        ratios = " | ".join(f"{row[f'ratio_to_{method}']:.2g}x" for method in OURS)
        lines.append(
            f"| {row['case']} | {row['lod']} | {name} | {' | '.join(cells)} | "
            f"{row['ms_a_frame']:.3g} | {row['frames_per_second']:,.0f} | {ratios} | {bar} |"
        )
    peaks = {row["implementation"]: row["peak_mb"] for row in results["rows"] if "peak_mb" in row}
    machine = results["machine"]
    memory = ", ".join(f"{name} {peak:.0f} MB" for name, peak in peaks.items())
    peer = f", py-soma-x {machine['peer']}" if machine["peer"] else ""
    lines += ["", f"Peak memory: {memory}.", "",
              f"{machine['cpu']}, {machine['threads']} threads, float32, {machine['frames']} frames, medians "
              f"of {machine['rounds']} alternating rounds; torch {machine['torch']}{peer}, commit "
              f"{machine['commit']}. Written by `python benchmarks/run.py --only inversion`."]  # fmt: skip
    return "\n".join(lines)
