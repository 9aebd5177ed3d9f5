"""A synthetic data set through both engines, with faults: ``python benchmarks/dataset.py --out FOLDER``.

Clips of several bodies, some of them broken, are converted to shards by processes, by Ray undisturbed, and by
Ray on a local cluster of two nodes while workers are killed, a node is killed, and in the end the run itself,
which is started again. Shards must be the same bytes. Needs ``soma-body-core[ray]``.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # so that processes that are started find the tests' stand-ins too

BROKEN = 0.03
CLIP = 250
FRAMES_OF_288_HOURS = 124_000_000


def make(folder: Path, frames: int, fits: int, seed: int = 0) -> None:
    """Write the clips: BVH of bodies of several proportions, our own files with identities, AMASS to fit."""
    from soma_core import SomaLayer
    from soma_core.motion import load_clip, write, write_bvh
    from soma_core.rig import load_canonical

    rng, layer, rig = np.random.default_rng(seed), SomaLayer("soma", lod="low"), load_canonical("mid")[1]
    clip, bodies = load_clip(), []
    for _ in range(5):
        params = {name: rng.normal(0, 0.7, 8).tolist() for name in ("shape",)}
        bodies.append((params, layer.identity(params).bind_world[0].cpu().numpy()))
    count = frames // CLIP
    for number in range(count):
        start, body = int(rng.integers(clip.frame_count)), bodies[number % len(bodies)]
        part = clip.cut((start + np.arange(CLIP)) % clip.frame_count)
        file = folder / f"{number // 100:03d}/{number:05d}"
        file.parent.mkdir(parents=True, exist_ok=True)
        if number < fits:
            np.savez(file.with_suffix(".npz"), **amass(rng, number))
        elif number % 2:
            write_bvh(part, file.with_suffix(".bvh"), rig=rig, bind_world=body[1])
        else:
            write(replace(part, identity={"backend": "soma", "params": body[0]}), file.with_suffix(".npz"))
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for number, file in enumerate(rng.permutation(files)[: round(BROKEN * count)]):
        content = Path(file).read_bytes()
        kinds = (b"", content[: len(content) // 2], rng.bytes(len(content)))
        Path(file).write_bytes(kinds[number % len(kinds)])


def amass(rng: np.random.Generator, number: int) -> dict[str, object]:
    """A walk as AMASS stores it, for the stand-in of SMPL-H, whose surface is fitted."""
    phase = 2 * np.pi * rng.random((52, 3))
    swing = 0.15 * rng.standard_normal((52, 3))
    poses = swing * np.sin(np.linspace(0, 2 * np.pi, CLIP)[:, None, None] + phase)
    poses[:, 0] = [np.pi / 2, 0, 0]
    betas = 0.5 * np.random.default_rng(number % 5).standard_normal(3)
    return {"poses": poses.reshape(CLIP, -1), "trans": np.tile([0, 0, 0.9], (CLIP, 1)), "betas": betas,
            "gender": "female", "mocap_framerate": 60.0}  # fmt: skip


def stand_in(folder: Path) -> None:
    """A model of SMPL-H's layout that is nobody's, where processes that are started find it."""
    import soma_backend_smpl.smplh as smplh

    from tests.standins.smpl_files import smpl_arrays, write_npz, write_smpl_wrap

    os.environ |= {"SOMA_DATA_DIR": str(folder), "SOMA_CACHE_DIR": str(folder / "cache")}
    if not (folder / "official").exists():
        official = write_npz(folder / "official/SMPLH_FEMALE.npz", smpl_arrays("smplh", width=3))
        smplh.soma_convert(official, None)
        write_smpl_wrap(folder, "smplh")


def options(engine: str, workers: int):
    from soma_core.motion import DatasetOptions

    return DatasetOptions(engine=engine, output="parquet", workers=workers, lod="low", shard=8)


def convert(source: Path, out: Path, engine: str, workers: int) -> tuple[dict, float]:
    """What became of the data set, and how long it took [s]."""
    from soma_core.motion import convert_shards

    begin = time.monotonic()
    found = convert_shards(source, out, options=options(engine, workers))
    return dict(found.counts), time.monotonic() - begin


def digests(out: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in out.glob("shards/*.parquet")}


def names(out: Path) -> list[str]:
    import pyarrow.parquet as pq

    return sorted(
        name for file in out.glob("shards/*.parquet") for name in pq.read_table(file)["name"].to_pylist()
    )


def children(parents: set[int]) -> dict[int, str]:
    """Processes below others, and what they call themselves."""
    found, all_of = {}, {}
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = int((place / "stat").read_text().rsplit(")", 1)[1].split()[1])
            all_of[int(place.name)] = (parent, (place / "cmdline").read_text().replace("\0", " "))
    grown = True
    while grown:
        grown = False
        for process, (parent, title) in all_of.items():
            if process not in found and (parent in parents or parent in found):
                found[process], grown = title, True
    return found


def actors(parents: set[int]) -> list[int]:
    return [process for process, title in children(parents).items() if title.startswith("ray::MapWorker")]


@contextlib.contextmanager
def watched(match: str) -> Iterator[dict[str, float]]:
    """Highest memory [MB] of the workers among the processes below, and processor time of all of them [s]."""
    seen, spent, ended = {"peak_mb": 0.0}, {}, threading.Event()
    begin, ticks = time.process_time(), os.sysconf("SC_CLK_TCK")

    def look(process: int, title: str) -> None:
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
        spent[process] = (int(fields[11]) + int(fields[12])) / ticks
        if match in title:
            lines = Path(f"/proc/{process}/status").read_text().splitlines()
            peak = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
            seen["peak_mb"] = max(seen["peak_mb"], peak)

    def watch() -> None:
        while not ended.wait(0.5):
            for process, title in children({os.getpid()}).items():
                with contextlib.suppress(OSError, IndexError, StopIteration):
                    look(process, title)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield seen
    finally:
        ended.set()
        thread.join()
        seen["cpu_seconds"] = sum(spent.values()) + time.process_time() - begin


def disturbed(source: Path, out: Path, kills: int, shards: int) -> dict:
    """A run on two nodes: workers killed as shards are finished, one node in the middle."""
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 4, "include_dashboard": False})
    second = cluster.add_node(num_cpus=4)
    ray.init(cluster.address, log_to_driver=False)
    told, ended = {"workers_killed": 0, "nodes_killed": 0}, threading.Event()

    def disturb() -> None:
        due = [round(k * 0.8 * shards / kills) for k in range(kills)]
        while not ended.wait(0.1):
            done, running = len([*out.glob("shards/*.json")]), actors({os.getpid()})
            if due and done >= due[0] and running:
                os.kill(random.choice(running), signal.SIGKILL)
                told["workers_killed"] += 1
                due.pop(0)
            if done >= 0.4 * shards and not told["nodes_killed"]:
                told["nodes_killed"] += 1
                cluster.remove_node(second, allow_graceful=False)

    thread = threading.Thread(target=disturb, daemon=True)
    thread.start()
    try:
        counts, seconds = convert(source, out, "ray", 4)
    finally:
        ended.set()
        thread.join()
        ray.shutdown()
        cluster.shutdown()
    return {"counts": counts, "seconds": seconds, **told}


def driver_killed(source: Path, out: Path, shards: int) -> dict:
    """A run that is killed when a third is done, and started again."""
    command = [sys.executable, __file__, "--one", "ray", "--source", str(source), "--out", str(out)]
    first = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while len([*out.glob("shards/*.json")]) < shards // 3 and first.poll() is None:
        time.sleep(0.1)
    first.kill()
    first.wait()
    kept = {file.name: file.stat().st_mtime_ns for file in out.glob("shards/*.json")}
    counts, _ = convert(source, out, "ray", 2)
    again = [name for name, time in kept.items() if (out / "shards" / name).stat().st_mtime_ns != time]
    return {"shards_before": len(kept), "made_again": len(again), "counts": counts}


def flatness(folder: Path, lengths: list[int]) -> dict[str, float]:
    """Highest memory of the process that fits one clip [MB], by its length in frames."""
    found, rng = {}, np.random.default_rng(0)
    for frames in lengths:
        source, out = folder / f"long_{frames}", folder / f"flat_{frames}"
        source.mkdir(parents=True, exist_ok=True)
        clip = amass(rng, 0)
        keys = {name: np.resize(clip[name], (frames, clip[name].shape[1])) for name in ("poses", "trans")}
        np.savez(source / "long.npz", **clip | keys)
        with watched("spawn_main") as seen:
            convert(source, out, "local", 1)
        found[str(frames)] = round(seen["peak_mb"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--fits", type=int, default=20, help="clips of a model whose surface is fitted")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument(
        "--lengths", type=int, nargs="*", default=[500, 2000], help="of clips whose fit is weighed"
    )
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--source", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    paths = [str(ROOT), *map(str, (ROOT / "plugins").glob("*"))]
    os.environ["PYTHONPATH"] = os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")])
    if given.one:
        convert(given.source, given.out, given.one, 2)
        return
    source = given.out / "clips"
    stand_in(given.out / "models")
    if not source.exists():
        make(source, given.frames, given.fits)
    report = {"frames": given.frames, "clips": given.frames // CLIP}
    for engine, title in (("local", "spawn_main"), ("ray", "ray::MapWorker")):
        with watched(title) as seen:
            counts, seconds = convert(source, given.out / engine, engine, 2)
        report[engine] = {**counts, "seconds": seconds, **seen}
    plain = digests(given.out / "local")
    report["shards"] = len(plain)
    report["ray_over_local"] = report["ray"]["cpu_seconds"] / report["local"]["cpu_seconds"]
    report["disturbed"] = disturbed(source, given.out / "faults", given.kills, len(plain))
    report["driver_killed"] = driver_killed(source, given.out / "killed", len(plain))
    report["peak_mb_by_frames"] = flatness(given.out, given.lengths)
    for name in ("ray", "faults", "killed"):
        found = names(given.out / name)
        report[f"{name}_same_bytes"] = digests(given.out / name) == plain
        report[f"{name}_lost"] = len(set(names(given.out / "local")) - set(found))
        report[f"{name}_doubled"] = len(found) - len(set(found))
    (given.out / "dataset.json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
