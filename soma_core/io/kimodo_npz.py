"""Read kimodo motions: 77 joints, or the reduced skeleton of 30 joints."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.io.joint_order import KIMODO_30_JOINTS, USER_JOINTS, nearest_ancestors
from soma_core.io.motion import Motion
from soma_core.io.npz_fields import NpzFields, check_rotations
from soma_core.topology.frames import ANY_UNIT

__all__ = ["KIMODO_FPS", "read_kimodo_npz"]

KIMODO_FPS = 30.0
"""Frame rate of the format: it is not stored in the files."""

_ORDERS = {77: USER_JOINTS, 30: KIMODO_30_JOINTS}


def read_kimodo_npz(fields: NpzFields, *, fps: float | None, unit: str | None = None) -> Motion:
    """Read a kimodo motion (metres, +Y up, +Z forward; rotations relative to the T-pose).

    The local rotation of a joint is the transposed world rotation of its nearest stored ancestor times
    its own. Joints that the file does not hold stay at rest, and so do the finger ends of the reduced
    skeleton, which hang directly on the hand.

    Raises:
        InputError: neither local nor world rotations are there, or a key has another layout.
    """
    key = "local_rot_mats" if "local_rot_mats" in fields else "global_rot_mats"
    stored = fields.numbers(key, ("frames", "30 or 77", 3, 3))
    frames, count = stored.shape[:2]
    if count not in _ORDERS:
        raise fields.refuse(
            key, got=f"{count} joints", expected="30 or 77 joints", fix="Export it on the SOMA skeleton."
        )
    check_rotations(f"{fields.path}: {key}", stored)
    names = _ORDERS[count]
    local = stored if key == "local_rot_mats" else _local_rotations(stored, names)
    rotations = np.tile(np.eye(3), (frames, len(USER_JOINTS), 1, 1))
    for index, name in enumerate(names):
        if count == len(USER_JOINTS) or not name.endswith("End"):
            rotations[:, USER_JOINTS.index(name)] = local[:, index]
    return Motion(
        rotations=rotations,
        translation=_hips(fields, frames, count) * ANY_UNIT[unit or "m"],
        fps=KIMODO_FPS if fps is None else float(fps),
        joint_names=USER_JOINTS,
        source=f"kimodo motion {fields.path.name}",
    )


def _local_rotations(world: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Pose-relative local rotations, put back on SO(3) in float64."""
    local = world.copy()
    for index, ancestor in enumerate(nearest_ancestors(names)):
        if ancestor >= 0:
            local[:, index] = np.swapaxes(world[:, ancestor], -1, -2) @ world[:, index]
    return Rotation.from_matrix(local.reshape(-1, 3, 3)).as_matrix().reshape(local.shape)


def _hips(fields: NpzFields, frames: int, count: int) -> np.ndarray:
    """World position of Hips [m], (frames, 3)."""
    if "root_positions" in fields:
        return fields.numbers("root_positions", (frames, 3))
    return fields.numbers("posed_joints", (frames, count, 3))[:, 0]
