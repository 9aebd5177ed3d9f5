"""Body parameters of GEM-X, which estimates motions of this skeleton from videos."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.io.data_files import DataFile
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.motion import Motion
from soma_core.io.npz_fields import NpzFields, check_rotations

__all__ = ["GEM_X_KEYS", "gem_x_motion", "gem_x_parts", "gem_x_result", "holds_gem_x"]

GEM_X_KEYS = ("global_orient", "body_pose", "transl", "identity_coeffs", "scale_params")
"""Of one body: ``body_params_global`` of a result, in a world with +y up, holds them."""

_BODY = len(USER_JOINTS) - 1
_MOVING, _KEPT = GEM_X_KEYS[:3], GEM_X_KEYS[3:]


def gem_x_parts(fields: NpzFields) -> dict[str, np.ndarray] | None:
    """Arrays of a body of GEM-X in a file; None where ``body_pose`` is of another skeleton, or missing."""
    if not set(_MOVING) <= set(fields.names):
        return None
    parts = {name: fields.raw(name) for name in GEM_X_KEYS if name in fields}
    return parts if holds_gem_x(parts) else None


def gem_x_result(file: DataFile) -> dict[str, np.ndarray] | None:
    """Arrays of the bodies in a result of GEM-X, in the world where it has that; None in other files."""
    top = file.content if isinstance(file.content, dict) else {}
    for node in (top.get("body_params_global"), top.get("body_params_incam"), top):
        if not isinstance(node, dict) or not set(_MOVING) <= set(node):
            continue
        shapes = {name: file.shape(node[name]) for name in GEM_X_KEYS if name in node}
        if all(shapes.values()):
            parts = {name: file.array(node[name]) for name in shapes}
            return parts if holds_gem_x(parts) else None
    return None


def holds_gem_x(parts: Mapping[str, np.ndarray]) -> bool:
    """Tell whether named arrays are a body of GEM-X: all joints but the Hips in ``body_pose``."""
    if not set(_MOVING) <= set(parts):
        return False
    frames = math.prod(parts["transl"].shape[:-1])
    return (
        parts["transl"].ndim > 1
        and frames > 0
        and parts["body_pose"].size in (3 * _BODY * frames, 9 * _BODY * frames)
    )


def gem_x_motion(
    parts: Mapping[str, np.ndarray], *, path: Path, fps: float | None, person: str | None = None,
    columns: bool = False,
) -> Motion:  # fmt: skip
    """Make a motion of the parameters of one body (metres, +Y up; rotations relative to the T-pose).

    Args:
        parts: arrays of ``GEM_X_KEYS``, (frames, ...), or with a leading axis of people; rotations as
            axis-angle or matrices.
        path: where they are from, for messages.
        fps: frame rate of the video, which results do not tell.
        person: whose, from ``0``; needed where there are several.
        columns: whether matrices are stored column by column.

    Raises:
        InputError: no frame rate, or parameters that are no motion.
    """
    if fps is None:
        raise InputError(
            f"{path}: fps", got="no frame rate", expected="that of the video",
            fix="Pass fps=30 (or the true rate).",
        )  # fmt: skip
    people, frames = math.prod(parts["transl"].shape[:-2]), parts["transl"].shape[-2]
    known = [str(number) for number in range(people)]
    if person not in known and (person is not None or people != 1):
        raise InputError(
            f"{path}: person", got=f"{person or 'none'} of {people} people",
            expected=f"one of {', '.join(known)}", fix="Pass person=0, or another of these numbers.",
        )  # fmt: skip

    def rows(key: str, count: int) -> np.ndarray:
        values = np.asarray(parts[key])
        if values.dtype.kind not in "fiu" or values.size % (people * count) or not np.isfinite(values).all():
            raise InputError(
                f"{path}: {key}", got=f"shape {values.shape}, dtype {values.dtype}",
                expected=f"finite numbers of {people} people and {count} frames",
                fix="Cut the damaged frames.",
            )  # fmt: skip
        return values.astype(np.float64).reshape(people, count, -1)[int(person or 0)]

    identity: dict[str, object] = {"backend": "mhr"}
    for key in _KEPT:
        if key in parts:
            means = rows(key, math.prod(parts[key].shape[:-1]) // people or 1).mean(axis=0, keepdims=True)
            identity[key] = means.astype(np.float32)
    turns = [
        _matrices(rows(key, frames), count, f"{path}: {key}")
        for key, count in (("global_orient", 1), ("body_pose", _BODY))
    ]
    rotations = np.concatenate(turns, axis=1)
    return Motion(
        rotations=np.swapaxes(rotations, -1, -2) if columns else rotations,
        translation=rows("transl", frames),
        fps=float(fps),
        joint_names=USER_JOINTS,
        source=f"GEM-X result {path.name}",
        identity=identity if len(identity) > 1 else {},
    )


def _matrices(rows: np.ndarray, joints: int, argument: str) -> np.ndarray:
    """Rotations (frames, joints, 3, 3) of rows that hold axis-angle vectors or matrices."""
    if rows.shape[1] == 3 * joints:
        matrices: np.ndarray = Rotation.from_rotvec(rows.reshape(-1, 3)).as_matrix()
        return matrices.reshape(len(rows), joints, 3, 3)
    if rows.shape[1] != 9 * joints:
        raise InputError(
            argument, got=f"{rows.shape[1]} numbers a frame", expected=f"{3 * joints} or {9 * joints}",
            fix=f"Give axis-angle vectors or matrices of {joints} joints.",
        )  # fmt: skip
    turned = rows.reshape(len(rows), joints, 3, 3)
    check_rotations(argument, turned)
    return turned
