"""Clips to learn from, split by clip, and their lessons: streamed from a cache on disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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

__all__ = ["SPLITS", "Batch", "ClipPlan", "LessonStore", "Split", "Taught", "split_clips"]

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")

_CM_PER_M = 100.0


@dataclass(frozen=True, kw_only=True)
class ClipPlan:
    """Which clips of random poses there are.

    Attributes:
        random_clips: clips of random poses.
        hanging_clips: clips of random poses with hanging arms.
        poses: poses in each of them.
        seed: of the random poses.
    """

    random_clips: int
    hanging_clips: int
    poses: int
    seed: int

    def __len__(self) -> int:
        """Number of clips."""
        return self.random_clips + self.hanging_clips

    def clip(self, number: int, names: Sequence[str]) -> Clip:
        """Make a clip; it depends on the seed and on its number alone."""
        hanging = number >= self.random_clips
        index = number - self.random_clips if hanging else number
        random = np.random.default_rng([self.seed, index, 1] if hanging else [self.seed, index])
        rotations = random_rotations(names, self.poses, random, hanging=hanging)
        kind = "hanging" if hanging else "random"
        return Clip(name=f"{kind} {self.seed}/{index}", rotations=rotations, seed=number)


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


@dataclass(frozen=True, kw_only=True)
class Taught:
    """A clip whose lesson a store holds, without its poses.

    Attributes:
        name: of the clip.
        part_of: clips with one such name stay together when data is split.
        key: of the lesson.
        poses: how many there are.
    """

    name: str
    part_of: str
    key: str
    poses: int


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

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.npz"

    def teach(self, clip: Clip) -> Taught:
        """Teach one clip and keep the lesson, unless it was kept before."""
        key = content_key(clip.name, clip.seed, clip.rotations)
        if not self._path(key).is_file():
            lesson = self._teacher.teach(clip)
            rotations = lesson.rotations.astype(np.float32)
            offsets = (_CM_PER_M * lesson.offsets).astype(np.float16)
            atomic_write(self._path(key), lambda path: np.savez(path, rotations=rotations, offsets=offsets))
        part_of = clip.part_of or clip.name
        return Taught(name=clip.name, part_of=part_of, key=key, poses=len(clip.rotations))

    def rotations(self, clip: Taught) -> np.ndarray:
        """T-pose-relative rotations (n, J, 3, 3) of a lesson's poses."""
        with np.load(self._path(clip.key), allow_pickle=False) as file:
            found: np.ndarray = file["rotations"]
        return found

    def read(self, clip: Taught, vertices: np.ndarray, *, mirrored: bool = False) -> Batch:
        """The lesson of a clip for some vertices; `mirrored` adds the mirror image of every pose.

        The canonical body is symmetric, so the offsets of a mirrored pose are those of the partners.
        """
        with np.load(self._path(clip.key), allow_pickle=False) as file:
            rotations, offsets = file["rotations"], file["offsets"]
        kept = [offsets[:, vertices]]
        if mirrored:
            rotations = np.concatenate([rotations, mirror_rotations(rotations, self._names)])
            kept.append(offsets[:, self._mirror[vertices]] * np.array([-1, 1, 1], np.float16))
        metres = torch.from_numpy(np.concatenate(kept)).float() / _CM_PER_M
        return Batch(features=self._features(torch.from_numpy(rotations).float()), offsets=metres)

    def batches(
        self,
        clips: Sequence[Taught],
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


def split_clips(clips: Sequence[Taught], *, held_out: float, seed: int) -> dict[Split, list[Taught]]:
    """Split by clip: the share `held_out` each for validation and test, at least one clip.

    Raises:
        InputError: fewer than three clips, which cannot be split.
    """
    whole = list(dict.fromkeys(clip.part_of for clip in clips))
    if len(whole) < len(SPLITS):
        raise InputError(
            "data",
            got=f"{len(whole)} clips",
            expected="at least 3: one to train on, one to stop by, one to test on",
            fix="Raise data.random_clips, or name motions in data.motions.",
        )
    order = np.random.default_rng(seed).permutation(len(whole))
    each = max(1, round(held_out * len(whole)))
    parts = {"test": order[:each], "validation": order[each : 2 * each], "train": order[2 * each :]}
    homes = {whole[index]: name for name, part in parts.items() for index in part}
    return {name: [clip for clip in clips if homes[clip.part_of] == name] for name in SPLITS}
