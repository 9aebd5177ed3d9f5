"""Joints alone for other programs: NPZ and CSV of positions and rotations, and 2D keypoints of a camera."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.cache import atomic_write
from soma_core.errors import InputError
from soma_core.io.camera import Camera
from soma_core.io.joint_order import PARENT_NAMES
from soma_core.io.npz_parts import write_npz_parts
from soma_core.plugin.declaration import did_you_mean

__all__ = [
    "JointFrames",
    "JointPiece",
    "chosen_joints",
    "write_joints_csv",
    "write_joints_npz",
    "write_keypoints",
]

_SHOWN = 12
"""Names that a refusal lists."""

_COLUMNS = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")


class JointPiece(NamedTuple):
    """Some frames: world positions (f, J, 3) [m] and world rotations (f, J, 3, 3)."""

    positions: np.ndarray
    rotations: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class JointFrames:
    """Joints over time, ready for export; metres.

    Attributes:
        pieces: gives consecutive pieces of the frames, from the start each time it is called.
        frame_count: their number.
        names: of the joints.
        rest: the T-pose of the same body, one frame.
        fps: frames per second.
        up: upward axis of the world.
        source, licence: of the motion.
    """

    pieces: Callable[[], Iterator[JointPiece]]
    frame_count: int
    names: tuple[str, ...]
    rest: JointPiece
    fps: float
    up: str = "+y"
    source: str = ""
    licence: str = ""

    def quaternions(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Positions and quaternions wxyz (f, J, 4) of each piece, without sign flips between frames."""
        before = None
        for positions, rotations in self.pieces():
            turned = _wxyz(rotations, before)
            before = turned[-1]
            yield positions, turned


def chosen_joints(wanted: Sequence[str] | None, known: Sequence[str]) -> list[int]:
    """Places of the joints that are asked for, in the order asked; None for all.

    Raises:
        InputError: a name that is none, or one that comes twice.
    """
    if wanted is None:
        return list(range(len(known)))
    strange = [name for name in wanted if name not in known or list(wanted).count(name) > 1]
    if strange or not wanted:
        got = (
            (f"{strange[0]!r} twice" if strange[0] in known else repr(strange[0])) if strange else "no joint"
        )
        shown = list(known[:_SHOWN]) + [f"{len(known) - _SHOWN} more"] * (len(known) > _SHOWN)
        near = did_you_mean(strange[0].title(), known) if strange else ""
        raise InputError(
            "joints", got=got, expected=f"names among {', '.join(shown)}",
            fix=near or "Correct the name, or leave it out.",
        )  # fmt: skip
    return [known.index(name) for name in wanted]


def write_joints_npz(path: Path, joints: JointFrames) -> None:
    """Write an NPZ of joints; metres, quaternions wxyz, both in the world.

    ``positions`` (frames, J, 3), ``quaternions`` (frames, J, 4), ``t_pose_positions`` (J, 3) and
    ``t_pose_quaternions`` (J, 4) of the same body, ``joint_names``, ``parents`` (J,) as places in
    ``joint_names`` of the nearest joint above that is in the file, -1 for none, ``fps``, ``unit``,
    ``up_axis``, ``quaternion_order``, ``source``, ``licence``. All float32.
    """
    count = len(joints.names)
    values: dict[str, object] = {
        "positions": np.empty((0, count, 3), np.float32),
        "quaternions": np.empty((0, count, 4), np.float32),
        "t_pose_positions": joints.rest.positions[0].astype(np.float32),
        "t_pose_quaternions": _wxyz(joints.rest.rotations)[0].astype(np.float32),
        "joint_names": np.array(joints.names),
        "parents": np.array(_parents(joints.names), np.int32),
        "fps": float(joints.fps),
        "unit": "meters",
        "up_axis": joints.up[1:].upper(),
        "quaternion_order": "wxyz",
        "source": joints.source,
        "licence": joints.licence,
    }
    pieces = {
        name: functools.partial(_one_of, joints.quaternions, place)
        for place, name in enumerate(("positions", "quaternions"))
    }
    arrays = {name: np.asarray(value) for name, value in values.items()}
    write_npz_parts(path, arrays, pieces, count=joints.frame_count)


def _one_of(pieces: Callable[[], Iterator[tuple[np.ndarray, ...]]], place: int) -> Iterator[np.ndarray]:
    return (piece[place] for piece in pieces())


def write_joints_csv(path: Path, joints: JointFrames) -> None:
    """Write a CSV of joints, one row a frame; metres, quaternions wxyz, both in the world.

    Columns: ``frame``, ``time_s``, ``fps``, ``up``, then for each joint ``NAME_x_m``, ``NAME_y_m``,
    ``NAME_z_m``, ``NAME_qw``, ``NAME_qx``, ``NAME_qy``, ``NAME_qz``. Nine digits, which float32 holds.
    """
    columns = [f"{name}_{column}" for name in joints.names for column in _COLUMNS]
    row = f"%d,%.9g,{joints.fps:.9g},{joints.up}" + ",%.9g" * len(columns) + "\n"

    def write(temporary: Path) -> None:
        number = 0
        with open(temporary, "w", encoding="utf-8", newline="") as stream:
            stream.write(",".join(["frame", "time_s", "fps", "up", *columns]) + "\n")
            for positions, quaternions in joints.quaternions():
                values = np.concatenate((positions, quaternions), -1).astype(np.float32)
                for frame in values.reshape(len(values), -1).tolist():
                    stream.write(row % (number, number / joints.fps, *frame))
                    number += 1

    atomic_write(path, write)


def write_keypoints(path: Path, joints: JointFrames, camera: Camera) -> None:
    """Write an NPZ of joints as a camera sees them.

    ``keypoints`` (frames, J, 2) [px], x to the right and y down from the upper left corner, ``depth``
    (frames, J) [m] along the view, ``visible`` (frames, J) bool: before the camera, and inside the picture
    where its size is known; nothing hides a joint. Keypoints that are not before the camera are NaN.
    ``joint_names``, ``fps``, ``intrinsics`` (3, 3), ``extrinsics`` (1 or frames, 4, 4) world to camera.
    """
    if len(camera.extrinsics) not in (1, joints.frame_count):
        raise InputError(
            "camera.extrinsics", got=f"{len(camera.extrinsics)} matrices",
            expected=f"one, or one for each of the {joints.frame_count} frames",
            fix="Give one matrix for a camera that stands.",
        )  # fmt: skip

    def seen() -> Iterator[tuple[np.ndarray, ...]]:
        start = 0
        for positions, _ in joints.pieces():
            yield camera.project(positions, start)
            start += len(positions)

    count = len(joints.names)
    values: dict[str, object] = {
        "keypoints": np.empty((0, count, 2), np.float32),
        "depth": np.empty((0, count), np.float32),
        "visible": np.empty((0, count), bool),
        "joint_names": np.array(joints.names),
        "fps": float(joints.fps),
        "intrinsics": camera.intrinsics,
        "extrinsics": camera.extrinsics,
        "source": joints.source,
    }
    pieces = {name: functools.partial(_one_of, seen, place) for place, name in enumerate(list(values)[:3])}
    arrays = {name: np.asarray(value) for name, value in values.items()}
    write_npz_parts(path, arrays, pieces, count=joints.frame_count)


def _parents(names: tuple[str, ...]) -> list[int]:
    """Place in `names` of the nearest joint above each that is among them; -1 where there is none."""
    found = []
    for name in names:
        above = PARENT_NAMES[name]
        while above in PARENT_NAMES and above not in names:
            above = PARENT_NAMES[above]
        found.append(names.index(above) if above in names else -1)
    return found


def _wxyz(rotations: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """Quaternions wxyz (f, J, 4) of matrices, each on the side of the one before it."""
    flat = Rotation.from_matrix(rotations.reshape(-1, 3, 3).astype(np.float64)).as_quat(
        canonical=True, scalar_first=True
    )
    turned = flat.reshape(*rotations.shape[:2], 4)
    first = turned[:1] if before is None else before[None]
    behind = np.concatenate((first, turned[:-1]))
    # A sign that flips between neighbours flips all that follows.
    signs = np.cumprod(np.where((turned * behind).sum(-1) < 0, -1.0, 1.0), axis=0)
    return turned * signs[..., None]
