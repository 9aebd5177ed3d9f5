"""Pose from 22 joints against Adam on the same joints: errors first, then alternating rounds.

``python benchmarks/points.py`` prints the table of the README. The peer is what fits of SMPL's joints
usually are: forward kinematics of the rotations of 22 joints as axis-angles, the mean squared distance, and
Adam from the rest pose, as short as it can be written, with no prior and no check.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np
import torch
from torch import Tensor

from soma_core import PointInversion, SomaLayer
from soma_core.evaluation.random_poses import random_axis_angles
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.motion import load_clip

__all__ = ["main"]

SET = "smpl22"


class AdamFit:
    """Axis-angles of the joints above the points, by Adam."""

    def __init__(self, layer: SomaLayer, steps: int, rate: float) -> None:
        rig, places = layer.rig, layer.places(SET)
        at = places.joint_weight.argmax(1).tolist()
        used = {joint for own in at for joint in _above(own, rig.parents)}
        self.joints = sorted(used)
        row = {joint: place for place, joint in enumerate(self.joints)}
        self.parents = [row.get(int(rig.parents[joint]), -1) for joint in self.joints]
        self.points = [row[joint] for joint in at]
        self.offsets = layer.animation.bone_vectors(layer.identity())[0, self.joints]
        self.steps, self.rate = steps, rate

    def __call__(self, points: Tensor) -> Tensor:
        """Points (F, P, 3) [m] of the pose that is found."""
        vectors = points.new_zeros(len(points), len(self.joints), 3, requires_grad=True)
        hips = points[:, self.points.index(0)].clone().requires_grad_()
        adam = torch.optim.Adam([vectors, hips], lr=self.rate)
        for _ in range(self.steps):
            adam.zero_grad()
            loss = (self._posed(vectors, hips) - points).square().sum((1, 2)).sum()
            loss.backward()
            adam.step()
        with torch.no_grad():
            return self._posed(vectors, hips)

    def _posed(self, vectors: Tensor, hips: Tensor) -> Tensor:
        own = axis_angle_to_matrix(vectors)
        turns, places = [own[:, 0]], [hips]
        for joint in range(1, len(self.joints)):
            above = self.parents[joint]
            places.append(places[above] + turns[above] @ self.offsets[joint])
            turns.append(turns[above] @ own[:, joint])
        return torch.stack(places, 1)[:, self.points]


def _above(joint: int, parents: np.ndarray) -> list[int]:
    found = []
    while joint > 0:
        found.append(joint)
        joint = int(parents[joint])
    return found


def main() -> None:
    """Fit poses both ways, then time them in turn."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=100, help="of Adam")
    parser.add_argument("--rate", type=float, default=0.1, help="of Adam")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--motion", action="store_true", help="the shipped clip, again and again")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    layer = SomaLayer("soma", lod="low")
    body, names = layer.identity(), list(layer.joint_names)
    turns, places = random_axis_angles(names, options.frames, np.random.default_rng(0)), None
    if options.motion:
        clip = load_clip()
        shown = np.arange(options.frames) % clip.frame_count
        turns, places = clip.rotations[shown], torch.as_tensor(clip.translation[shown])
    points = layer.points(layer.joints(body, torch.as_tensor(turns).float(), places), SET)
    inversion, adam = PointInversion(layer, SET), AdamFit(layer, options.steps, options.rate)

    def ours() -> Tensor:
        return inversion(points, body).point_error

    def theirs() -> Tensor:
        return (adam(points) - points).norm(dim=-1)

    errors = {name: 1e3 * fit() for name, fit in (("ours", ours), ("Adam", theirs))}
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in errors}
    for _ in range(options.rounds):
        for name, fit in (("ours", ours), ("Adam", theirs)):
            begun = time.process_time(), time.perf_counter()
            fit()
            spent[name].append((time.process_time() - begun[0], time.perf_counter() - begun[1]))
    ratio = statistics.median(a[0] / b[0] for a, b in zip(spent["Adam"], spent["ours"], strict=True))
    lines = [
        "| fit | mean, mm | max, mm | frames/s of processor time | frames/s | time |",
        "|---|---|---|---|---|---|",
    ]
    for name, error in errors.items():
        used, passed = (statistics.median(one[k] for one in spent[name]) for k in (0, 1))
        share = "1x" if name == "ours" else f"{ratio:.3g}x"
        lines.append(
            f"| {name} | {float(error.mean()):.3g} | {float(error.max()):.3g} | "
            f"{options.frames / used:,.0f} | {options.frames / passed:,.0f} | {share} |"
        )
    threads = f"{options.threads} thread" + ("s" if options.threads > 1 else "")
    adams = f"Adam: {options.steps} steps, rate {options.rate}"
    shown = "frames of the shipped clip" if options.motion else "random poses"
    lines.append(f"\n{options.frames} {shown}, {threads}; {adams}.")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
