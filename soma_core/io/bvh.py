"""Write BVH: any skeleton's joints as Euler angles, its rest pose as the pose of zeros."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from soma_core.cache import atomic_write
from soma_core.errors import InputError
from soma_core.geometry.euler import euler_from_matrices
from soma_core.io.bvh_file import read_bvh
from soma_core.io.motion import Motion
from soma_core.io.skeleton_motion import SkeletonMotion, soma_skeleton
from soma_core.rig.skeleton import Rig
from soma_core.topology.frames import METRES

__all__ = ["read_bvh", "write_bvh"]

EulerOrder = Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]
_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
_ROWS = 1024
_SHORTEST = 0.01
"""Length [m] of an end that no bone tells: programs draw nothing for an end of no length."""


def write_bvh(
    motion: SkeletonMotion | Motion,
    path: str | Path,
    *,
    rig: Rig | None = None,
    bind_world: np.ndarray | None = None,
    joints: Literal[77, 78] = 77,
    order: EulerOrder = "ZXY",
    rest: Literal["t_pose", "bind"] = "t_pose",
    unit: Literal["m", "cm", "mm", "inch", "ft"] = "cm",
) -> None:
    """Write a motion as BVH, atomically; angles in degrees, continuous over the frames.

    Args:
        motion: of any skeleton, or on this one, which needs `rig`.
        path: the file.
        rig: the canonical rig, for a motion on this skeleton.
        bind_world: (78, 4, 4) bind transforms of the body [m], as ``Identity.bind_world[0]``; None for the
            rig's own body.
        joints: 78 puts the still Root above Hips.
        order: of the rotation channels; the first is applied last.
        rest: what the angles are zero at: the T-pose, or the bind pose of the rig.
        unit: of lengths; BVH does not say, and most programs take centimetres.

    Raises:
        InputError: a choice that is none, or a motion on this skeleton without its rig.
    """
    for name, value, among in (
        ("order", order, _ORDERS),
        ("rest", rest, ("t_pose", "bind")),
        ("unit", unit, METRES),
        ("joints", joints, (77, 78)),
    ):
        if value not in among:
            expected = "one of " + ", ".join(map(str, among))
            raise InputError(name, got=repr(value), expected=expected, fix="Correct it.")
    if isinstance(motion, Motion):
        if rig is None:
            raise InputError("rig", got="none", expected="the canonical rig", fix="Pass load_canonical()[1].")
        bind = np.asarray(rig.bind_world if bind_world is None else bind_world, np.float64)
        motion = soma_skeleton(motion, rig, bind)
        if rest == "bind":
            orient = np.swapaxes(rig.t_pose_world[1:, :3, :3], -1, -2)
            motion = motion.rebased(bind[1:, :3, 3], bind[1:, :3, :3] @ orient)
        motion = _with_root(motion) if joints == 78 else motion
    atomic_write(Path(path), lambda temporary: _write(motion, temporary, order, 1 / METRES[unit]))


def _with_root(motion: SkeletonMotion) -> SkeletonMotion:
    """The same under a Root that stays at the origin."""
    frames = motion.frame_count
    still = np.broadcast_to(np.eye(3), (frames, 1, 3, 3))
    return replace(
        motion,
        names=("Root", *motion.names),
        parents=np.concatenate([[-1], motion.parents + 1]),
        rest=np.concatenate([np.zeros((1, 3)), motion.rest]),
        rotations=np.concatenate([still, motion.rotations], axis=1),
        root=np.zeros((frames, 3)),
        ends=None if motion.ends is None else np.concatenate([np.full((1, 3), np.nan), motion.ends]),
        moves={1: motion.root, **{joint + 1: bone for joint, bone in motion.moves.items()}},
    )


def _depth_first(motion: SkeletonMotion) -> SkeletonMotion:
    """The same with each joint directly followed by those below it, as a hierarchy is written."""
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(motion.parents):
        children.setdefault(int(parent), []).append(joint)
    order, waiting = [], [0]
    while waiting:
        order.append(waiting.pop())
        waiting.extend(reversed(children.get(order[-1], [])))
    place = np.argsort(order)
    return replace(
        motion,
        names=tuple(motion.names[joint] for joint in order),
        parents=np.array([-1, *place[motion.parents[order[1:]]]]),
        rest=motion.rest[order],
        rotations=motion.rotations[:, order],
        ends=None if motion.ends is None else motion.ends[order],
        moves={int(place[joint]): bone for joint, bone in motion.moves.items()},
    )


def _write(motion: SkeletonMotion, path: Path, order: str, scale: float) -> None:
    motion, columns, formats = _depth_first(motion), [], []
    place = f"%.{7 + round(2 - np.log10(scale))}f"  # to the nanometre
    for joint in range(len(motion.names)):
        if joint == 0 or joint in motion.moves:
            columns.append(scale * (motion.moves[joint] if joint else motion.root))
            formats += [place] * 3
        columns.append(np.degrees(euler_from_matrices(motion.rotations[:, joint], order)))
        formats += ["%.7f"] * 3
    with open(path, "w", encoding="utf-8", newline="\n") as stream:
        stream.write("HIERARCHY\n")
        stream.writelines(f"{line}\n" for line in _hierarchy(motion, order, scale))
        stream.write(f"MOTION\nFrames: {motion.frame_count}\nFrame Time: {1 / motion.fps:.9g}\n")
        row = " ".join(formats) + "\n"
        for start in range(0, motion.frame_count, _ROWS):
            block = np.concatenate([column[start : start + _ROWS] for column in columns], axis=1)
            stream.writelines(row % tuple(values) for values in block.tolist())


def _hierarchy(motion: SkeletonMotion, order: str, scale: float) -> Iterator[str]:
    """Lines of the joints, which stand depth first."""
    rotations = " ".join(f"{letter}rotation" for letter in order)
    depth: list[int] = []
    for joint, parent in enumerate(motion.parents):
        depth.append(0 if parent < 0 else depth[parent] + 1)
        yield from (
            "  " * level + "}" for level in range(depth[joint - 1] if joint else -1, depth[joint] - 1, -1)
        )
        indent = "  " * depth[joint]
        offset = motion.rest[joint] - (motion.rest[parent] if parent >= 0 else 0)
        moved = "3 " if joint and joint not in motion.moves else "6 Xposition Yposition Zposition "
        yield f"{indent}{'JOINT' if joint else 'ROOT'} {motion.names[joint].replace(' ', '_')}"
        yield indent + "{"
        yield f"{indent}  OFFSET {_numbers(scale * offset)}"
        yield f"{indent}  CHANNELS {moved}{rotations}"
        if not (motion.parents == joint).any():
            yield f"{indent}  End Site"
            yield f"{indent}  {{"
            yield f"{indent}    OFFSET {_numbers(scale * _end(motion, joint, offset))}"
            yield f"{indent}  }}"
    yield from ("  " * level + "}" for level in range(depth[-1], -1, -1))


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.9f}" for value in values)


def _end(motion: SkeletonMotion, joint: int, bone: np.ndarray) -> np.ndarray:
    """Where the bone of a joint without children ends: as told, else a little further the same way."""
    if motion.ends is not None and np.isfinite(motion.ends[joint]).all():
        return np.asarray(motion.ends[joint])
    length = float(np.linalg.norm(bone))
    direction = bone / length if length > 0 else np.array([0.0, 1.0, 0.0])
    return np.asarray(direction * max(0.3 * min(length, 0.1), _SHORTEST))
