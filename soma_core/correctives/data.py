"""Clips to learn from, split by clip, and their lessons: streamed from a cache on disk."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from soma_core.cache import atomic_write, content_key
from soma_core.correctives.features import PoseFeatures
from soma_core.correctives.poses import mirror_rotations, random_rotations
from soma_core.correctives.teacher import Clip, Teacher
from soma_core.errors import InputError
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["SPLITS", "Batch", "ClipPlan", "LessonStore", "Split", "plan_clips", "split_clips"]

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")

_CM_PER_M = 100.0


@dataclass(frozen=True, kw_only=True)
class ClipPlan:
    """Which clips there are.

    Attributes:
        random_clips: clips of random poses.
        hanging_clips: clips of random poses with hanging arms.
        poses: poses in each of them.
        motions: name -> rotations (n, J - 1, 3, 3) of motions, thinned out already.
        seed: of the random poses.
    """

    random_clips: int
    hanging_clips: int
    poses: int
    motions: Mapping[str, np.ndarray]
    seed: int


def plan_clips(plan: ClipPlan, names: Sequence[str]) -> list[Clip]:
    """Make the clips: random ones, then motions.

    Clip i depends on the seed and on i alone.

    Raises:
        InputError: fewer than three clips, which cannot be split.
    """
    clips = []
    for kind, count in (("random", plan.random_clips), ("hanging", plan.hanging_clips)):
        for index in range(count):
            seed = [plan.seed, index] if kind == "random" else [plan.seed, index, 1]
            random = np.random.default_rng(seed)
            rotations = random_rotations(names, plan.poses, random, hanging=kind == "hanging")
            number = index if kind == "random" else plan.random_clips + index
            clips.append(Clip(name=f"{kind} {plan.seed}/{index}", rotations=rotations, seed=number))
    for number, (name, rotations) in enumerate(plan.motions.items(), start=len(clips)):
        clips.append(Clip(name=name, rotations=rotations, seed=number))
    if len(clips) < len(SPLITS):
        raise InputError(
            "data",
            got=f"{len(clips)} clips",
            expected="at least 3: one to train on, one to stop by, one to test on",
            fix="Raise data.random_clips, or name motions in data.motions.",
        )
    return clips


def split_clips(clips: Sequence[Clip], *, held_out: float, seed: int) -> dict[Split, list[Clip]]:
    """Split by clip: the share `held_out` each for validation and test, at least one clip."""
    order = np.random.default_rng(seed).permutation(len(clips))
    each = max(1, round(held_out * len(clips)))
    parts = {"test": order[:each], "validation": order[each : 2 * each], "train": order[2 * each :]}
    return {name: [clips[index] for index in sorted(parts[name])] for name in SPLITS}


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Poses to learn from.

    Attributes:
        features: (B, J, 6) float32.
        offsets: (B, v, 3) [m] float32.
    """

    features: Tensor
    offsets: Tensor

    def part(self, chosen: slice | np.ndarray) -> Batch:
        """Some of the poses."""
        return Batch(features=self.features[chosen], offsets=self.offsets[chosen])


class LessonStore:
    """Lessons on disk, taught when they are first needed; offsets in half precision, centimetres.

    Args:
        folder: where they are kept; safe to delete.
        teacher: who teaches those that are missing.
        mesh, rig: the canonical body at the mid LOD.
    """

    def __init__(self, folder: Path, teacher: Teacher, mesh: CanonicalMesh, rig: Rig) -> None:
        self.key = teacher.key
        self._folder, self._teacher = folder / teacher.key, teacher
        self._names, self._mirror = rig.user_joint_names, mesh.mirror
        self._features = PoseFeatures(rig, dtype=torch.float32, device="cpu")

    def _path(self, clip: Clip) -> Path:
        return self._folder / f"{content_key(clip.name, clip.seed, clip.rotations)}.npz"

    def missing(self, clips: Iterable[Clip]) -> list[Clip]:
        """Those that have yet to be taught."""
        return [clip for clip in clips if not self._path(clip).is_file()]

    def teach(self, clip: Clip) -> None:
        """Teach one clip and keep the lesson."""
        lesson = self._teacher.teach(clip)
        rotations = lesson.rotations.astype(np.float32)
        offsets = (_CM_PER_M * lesson.offsets).astype(np.float16)
        atomic_write(self._path(clip), lambda path: np.savez(path, rotations=rotations, offsets=offsets))

    def read(self, clip: Clip, vertices: np.ndarray, *, mirrored: bool = False) -> Batch:
        """The lesson of a clip for some vertices; `mirrored` adds the mirror image of every pose.

        The canonical body is symmetric, so the offsets of a mirrored pose are those of the partners.
        """
        with np.load(self._path(clip), allow_pickle=False) as file:
            rotations, offsets = file["rotations"], file["offsets"]
        kept = [offsets[:, vertices]]
        if mirrored:
            rotations = np.concatenate([rotations, mirror_rotations(rotations, self._names)])
            kept.append(offsets[:, self._mirror[vertices]] * np.array([-1, 1, 1], np.float16))
        metres = torch.from_numpy(np.concatenate(kept)).float() / _CM_PER_M
        return Batch(features=self._features(torch.from_numpy(rotations).float()), offsets=metres)

    def batches(
        self,
        clips: Sequence[Clip],
        size: int,
        random: np.random.Generator,
        vertices: np.ndarray,
        *,
        mirrored: bool = False,
        pool: int = 8,
    ) -> Iterator[Batch]:
        """Stream shuffled batches of `size` poses: clips in random order, `pool` of them mixed at a time.

        Memory holds one pool; a pool's remainder joins the next, and the last one is dropped, so that
        every batch has the same size.
        """
        order = random.permutation(len(clips))
        rest: list[Batch] = []
        for start in range(0, len(order), pool):
            found = [
                self.read(clips[index], vertices, mirrored=mirrored) for index in order[start : start + pool]
            ]
            pooled = _joined([*rest, *found])
            shuffled = random.permutation(len(pooled.features))
            whole = len(shuffled) // size * size
            for first in range(0, whole, size):
                yield pooled.part(shuffled[first : first + size])
            rest = [pooled.part(shuffled[whole:])]


def _joined(batches: Sequence[Batch]) -> Batch:
    return Batch(
        features=torch.cat([batch.features for batch in batches]),
        offsets=torch.cat([batch.offsets for batch in batches]),
    )
