"""Time the reading of BVH files: ``python benchmarks/bvh.py [--frames N]``, one thread.

What is read is compared with what was written first. Frames a second are medians of processor time; the ratio
is against the parser of numpy on the same numbers in the same process, since machines are busy.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from soma_core.io.bvh import read_bvh, write_bvh
from soma_core.io.joint_order import PARENT_NAMES, USER_JOINTS
from soma_core.io.skeleton_motion import SkeletonMotion
from tests.skeletons import biped, moved

_PARTS = (
    "hips:Hips spine:a,b,c neck:Neck head:Head collar:*Shoulder arm:*Arm elbow:*ForeArm wrist:*Hand "
    "thigh:*UpLeg knee:*Leg ankle:*Foot toe:*Toe"
)
_NEAR_MM = 1e-3


def _bodies() -> dict[str, SkeletonMotion]:
    """Motions of the 22 joints of LAFAN1 and the 77 of this skeleton."""
    names = {part: name.replace(",", " ") for part, name in (word.split(":") for word in _PARTS.split())}
    parents = np.array([USER_JOINTS.index(PARENT_NAMES[name]) if number else -1
                        for number, name in enumerate(USER_JOINTS)])  # fmt: skip
    rest = np.zeros((77, 3))
    for joint in range(1, 77):
        rest[joint] = rest[parents[joint]] + np.random.default_rng(joint).normal(scale=0.1, size=3)
    return {"22 joints": moved(*biped(names, hands=False), frames=200),
            "77 joints": moved(tuple(USER_JOINTS), parents, rest, frames=200)}  # fmt: skip


def _seconds(work: Callable[[], object], repeats: int = 7) -> float:
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return statistics.median(taken)


def main() -> None:
    """Print a row for each skeleton."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--frames", type=int, default=10_000)
    frames = options.parse_args().frames
    with tempfile.TemporaryDirectory() as folder:
        for name, motion in _bodies().items():
            path = Path(folder) / "walk.bvh"
            write_bvh(motion, path)
            head, _, rows = path.read_text().partition("Frame Time")
            time_line, _, rows = rows.partition("\n")
            copies = -(-frames // motion.frame_count)
            path.write_text(f"{head}Frame Time{time_line}\n{rows * copies}".replace(
                f"Frames: {motion.frame_count}", f"Frames: {copies * motion.frame_count}"))  # fmt: skip
            found = read_bvh(path)
            order = [motion.names.index(joint) for joint in found.names]  # a file has them depth first
            apart = (
                10
                * np.abs(found.positions()[: motion.frame_count] - 100 * motion.positions()[:, order]).max()
            )
            if not apart < _NEAR_MM:
                raise SystemExit(f"{name}: joints are {apart} mm from where they were written")
            numbers = rows * copies
            taken = _seconds(lambda file=path: read_bvh(file))
            plain = _seconds(lambda text=numbers: np.fromstring(text, sep=" "))
            sys.stdout.write(
                f"{name}: {found.frame_count / taken:,.0f} frames/s, {taken / plain:.2f} of the time that "
                f"numpy takes for the numbers alone ({apart:.1e} mm from what was written)\n"
            )


if __name__ == "__main__":
    main()
