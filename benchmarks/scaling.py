"""How long 288 hours of motion take on how many cores: ``python benchmarks/scaling.py --models FOLDER``.

Measured here, on one thread: processor time a frame of each kind of clip, and what a worker needs to start.
Computed: a schedule of that cost over the clips of such a data set, shard by shard, to whoever is free; and
the limit that the memory of a GPU sets to a fit. FOLDER gets a stand-in of SMPL-H, whose surface is fitted.
"""

from __future__ import annotations

import argparse
import heapq
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from dataset import FRAMES_OF_288_HOURS, amass, stand_in

CLIPS = 142_000
SHARD = 64
CORES = (2, 16, 128, 1024)
SPREAD = 1.0
"""Of the logarithm of the clips' lengths, about their mean."""

H100_BYTES_A_SECOND = 3.35e12
MID_VERTICES = 18_056


def seconds_a_frame(kind: str, rounds: int = 3) -> tuple[float, float]:
    """Processor time of a frame, median, and how many steps of a fit it took on the mean."""
    import torch

    from soma_core.motion import ConvertOptions, Picture, convert_file, load_clip, write_bvh
    from soma_core.rig import load_canonical

    torch.set_num_threads(1)
    frames = 2000 if kind == "joints" else 250
    options = ConvertOptions(lod="mid" if kind == "mid" else "low", picture=Picture(frames=0))
    times, steps = [], 0.0
    with tempfile.TemporaryDirectory() as name:
        source = Path(name) / ("clip.bvh" if kind == "joints" else "clip.npz")
        if kind == "joints":
            clip = load_clip()
            part = clip.cut(np.arange(frames) % clip.frame_count)
            write_bvh(part, source, rig=load_canonical("mid")[1])
        else:
            np.savez(source, **amass(np.random.default_rng(0), 0))
        for number in range(rounds + 1):  # the first one builds what all need
            begin = time.process_time()
            found = convert_file(source, Path(name) / str(number), options=options)
            times.append((time.process_time() - begin) / frames)
            steps = found.report.get("iterations", {}).get("mean", 0.0)
    return float(np.median(times[1:])), steps


def schedule(cost: float, workers: int, start: float, a_shard: float, seed: int = 0) -> float:
    """Seconds until the last worker ends, each taking the next shard when it is free."""
    lengths = np.random.default_rng(seed).lognormal(0, SPREAD, CLIPS)
    lengths *= FRAMES_OF_288_HOURS / lengths.sum()
    shards = [cost * lengths[at : at + SHARD].sum() + a_shard for at in range(0, CLIPS, SHARD)]
    free = [start] * workers
    for seconds in shards:
        heapq.heappush(free, heapq.heappop(free) + seconds)
    return max(free)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--start", type=float, default=10.0, help="seconds in which a worker starts")
    parser.add_argument("--a-shard", type=float, default=0.05, help="seconds beside its clips")
    given = parser.parse_args()
    stand_in(given.models)
    print("| clips | frames/s on a core, measured | " + " | ".join(f"{n} cores" for n in CORES) + " |")
    print("|---|---|" + "---|" * 4)
    found = {}
    for kind, told in (
        ("joints", "carried over by joints"),
        ("low", "fitted, `lod=low`"),
        ("mid", "fitted, `lod=mid`"),
    ):
        cost, steps = seconds_a_frame(kind)
        found[kind] = {"frames_a_second": 1 / cost, "steps": steps}
        hours = [schedule(cost, n, given.start, given.a_shard) / 3600 for n in CORES]
        ideal = [cost * FRAMES_OF_288_HOURS / n / 3600 for n in CORES]
        cells = [f"{hour:,.3g} h ({best / hour:.0%})" for hour, best in zip(hours, ideal, strict=True)]
        print(f"| {told} | {1 / cost:,.0f} | " + " | ".join(cells) + " |", flush=True)
    # A step reads the target, and writes and reads the posed vertices, once each: less is not possible.
    traffic = max(found["mid"]["steps"], 1) * 3 * MID_VERTICES * 3 * 4
    limit = H100_BYTES_A_SECOND / traffic
    minutes = FRAMES_OF_288_HOURS / limit / 60
    print(f"memory of an H100: at most {limit:,.0f} frames/s of a fit at mid, {minutes:.1f} min")
    print(json.dumps(found))


if __name__ == "__main__":
    main()
