"""Read and write motion files; the layout of a file is told from its keys."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.cache import atomic_arrays
from soma_core.errors import InputError
from soma_core.io.data_files import DATA_SUFFIXES, open_data
from soma_core.io.gem_x import gem_x_motion, gem_x_parts, gem_x_result
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.kimodo_npz import read_kimodo_npz
from soma_core.io.motion import Convention, Motion, check_motion
from soma_core.io.npz_fields import check_rotations, open_npz
from soma_core.io.npz_parts import write_npz_parts
from soma_core.io.soma_npz import SCHEMA_VERSION, read_soma_npz

__all__ = ["check_rig", "read_motion", "samples_of", "write_motion", "write_motion_parts"]

_LONG = {
    "poses": "rotations",
    "transl": "translation",
    "foot_contacts": "contacts",
    "expression": "expression",
}
"""Keys of a file that hold an entry a frame, and the field of a motion that they come from."""


def samples_of(path: str | Path) -> int:
    """How many motions a file on this skeleton holds: samples of kimodo, people of GEM-X; else 1.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or no NPZ.
    """
    if Path(path).suffix.lower() in DATA_SUFFIXES[1:]:
        with open_data(path) as file:
            parts = gem_x_result(file)
    else:
        with open_npz(path) as fields:
            stored = [fields.raw(key) for key in ("local_rot_mats", "global_rot_mats") if key in fields]
            if stored:
                return len(stored[0]) if stored[0].ndim > 4 else 1
            parts = gem_x_parts(fields)
    return 1 if parts is None else math.prod(parts["transl"].shape[:-2])


def read_motion(
    path: str | Path,
    *,
    fps: float | None = None,
    unit: str | None = None,
    convention: Convention | None = None,
    person: str | None = None,
    angles: Literal["rad", "deg"] | None = None,
    columns: bool = False,
) -> Motion:
    """Read a motion from an NPZ file: our schema, the SOMA tools' files, kimodo's or GEM-X's.

    Args:
        path: the file. Nothing in it is executed; keys that are not needed are ignored.
        fps: frame rate; needed where the file has none (SOMA tools, GEM-X). kimodo files count as 30.
        unit: ``m``, ``cm``, ``mm``, or ``meters`` and so on; overrides the file's own.
        convention: what zero means; overrides the file's own.
        person: which of the samples of kimodo or the people of GEM-X, from ``0``.
        angles: unit of rotation vectors; None for radians.
        columns: whether matrices are stored column by column, or vectors were made of such.

    Returns:
        The motion in metres, +Y up, 77 joints with Hips first.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or no NPZ.
        InputError: the layout is unknown, or a key is missing or holds what a motion cannot have.
    """
    if Path(path).suffix.lower() in DATA_SUFFIXES[1:]:
        with open_data(path) as file:
            parts = gem_x_result(file)
            if parts is not None:
                return gem_x_motion(parts, path=file.path, fps=fps, person=person, columns=columns)
    with open_npz(path) as fields:
        if "global_rot_mats" in fields or "local_rot_mats" in fields:
            return read_kimodo_npz(fields, fps=fps, unit=unit, person=person, columns=columns)
        if "schema_version" in fields or ("poses" in fields and "transl" in fields):
            return read_soma_npz(
                fields, fps=fps, unit=unit, convention=convention, angles=angles, columns=columns
            )
        parts = gem_x_parts(fields)
        if parts is not None:
            return gem_x_motion(parts, path=fields.path, fps=fps, person=person, columns=columns)
        raise fields.refuse(
            "layout",
            got=f"the keys {', '.join(fields.names) or '(none)'}",
            expected="'poses' and 'transl' (SOMA), 'global_rot_mats' (kimodo), or 'body_pose' (GEM-X)",
            fix=f"soma convert input={fields.path} brings motions of other tools to this skeleton.",
        )


def write_motion(
    motion: Motion,
    path: str | Path,
    *,
    rotation_repr: Literal["matrix", "rotvec"] = "matrix",
    joint_orient: np.ndarray | None = None,
) -> None:
    """Write `motion` in our schema, atomically; the SOMA tools' keys are part of it.

    Args:
        motion: what to write; metres, +Y up.
        path: the NPZ file.
        rotation_repr: ``matrix`` is exact to float32; ``rotvec`` is a third of the size and exact to
            about 1e-6 rad.
        joint_orient: (77, 3, 3) world rotations of the T-pose of the motion's rig. The SOMA tools expect
            them beside T-pose-relative rotations; our reader does not need them.

    Raises:
        InputError: the joints are not the 77 user joints in order, or a matrix is no rotation.
    """
    check_motion(motion)
    _check_joints(motion)
    check_rotations("motion.rotations", motion.rotations.astype(np.float64))
    arrays = _arrays(motion, rotation_repr)
    if joint_orient is not None and motion.convention == "t_pose_relative":
        arrays["joint_orient"] = np.asarray(joint_orient, np.float32)
    atomic_arrays(Path(path), arrays)


def write_motion_parts(
    parts: Callable[[], Iterator[Motion]],
    path: str | Path,
    *,
    frame_count: int,
    joint_orient: np.ndarray | None = None,
) -> None:
    """Write a motion that is too long to hold, atomically; the file is that of ``write_motion``.

    Args:
        parts: gives consecutive pieces of the motion, from the start each time it is called; the first one
            tells frame rate, identity and the rest.
        path: the NPZ file.
        frame_count: frames of all pieces together.
        joint_orient: as in ``write_motion``.

    Raises:
        InputError: as in ``write_motion``, or the pieces do not add up.
    """
    first = next(parts())
    _check_joints(first)
    arrays = _arrays(first, "matrix")
    if joint_orient is not None and first.convention == "t_pose_relative":
        arrays["joint_orient"] = np.asarray(joint_orient, np.float32)
    pieces = {name: functools.partial(_pieces, parts, name) for name in _LONG if name in arrays}
    write_npz_parts(path, arrays, pieces, count=frame_count)


def _pieces(parts: Callable[[], Iterator[Motion]], name: str) -> Iterator[np.ndarray]:
    """One array of every piece, checked."""
    for part in parts():
        if name == "poses":
            check_rotations("motion.rotations", part.rotations.astype(np.float64))
        yield getattr(part, _LONG[name])


def _check_joints(motion: Motion) -> None:
    if tuple(motion.joint_names) != USER_JOINTS:
        raise InputError(
            "motion.joint_names",
            got=f"{len(motion.joint_names)} names that start with {motion.joint_names[:2]}",
            expected="the 77 user joints, Hips first",
            fix="Order the joints like soma_core.io.USER_JOINTS.",
        )


def _arrays(motion: Motion, rotation_repr: str) -> dict[str, np.ndarray]:
    """The keys of the schema; text is stored as unicode arrays, never as objects."""
    poses = motion.rotations
    if rotation_repr == "rotvec":
        vectors = Rotation.from_matrix(poses.reshape(-1, 3, 3).astype(np.float64)).as_rotvec()
        poses = vectors.reshape(*poses.shape[:2], 3).astype(np.float32)
    values = {
        "schema_version": SCHEMA_VERSION,
        "poses": poses,
        "transl": motion.translation,
        "rotation_repr": rotation_repr,
        "convention": motion.convention,
        "absolute_pose": motion.convention == "absolute_local",
        "joint_names": np.array(motion.joint_names),
        "keep_root": False,
        "fps": float(motion.fps),
        "unit": "meters",
        "up_axis": "Y",
        "root_translation": "hips_world_position",
        "rig_hash": motion.rig_revision,
        "source": motion.source,
        "licence": motion.licence,
    }
    recorded = {
        "foot_contacts": motion.contacts, "skeleton": motion.skeleton, "expression": motion.expression
    }  # fmt: skip
    values |= _identity(motion.identity) | {name: kept for name, kept in recorded.items() if kept is not None}
    return {name: np.asarray(value) for name, value in values.items()}


def _identity(identity: Mapping[str, object]) -> dict[str, object]:
    """Identity keys: the backend, its parameters by name, and the same numbers in one row."""
    if not identity:
        return {}
    params = identity.get("params", {})
    if not isinstance(params, Mapping):
        raise InputError(
            "motion.identity",
            got=type(params).__name__,
            expected="a mapping under 'params'",
            fix="Name the values.",
        )
    plain = {name: np.asarray(value, np.float64).tolist() for name, value in params.items()}
    row = np.concatenate([np.empty(0), *(np.ravel(value) for value in plain.values())])[None]
    found: dict[str, object] = {
        "identity_model_type": str(identity.get("backend", "")),
        "identity_coeffs": np.asarray(identity.get("identity_coeffs", row), np.float32),
    }
    if "params" in identity:  # files of the SOMA tools name no parameters
        found["identity_params"] = json.dumps(plain, sort_keys=True)
    if identity.get("options"):
        found["identity_options"] = json.dumps(identity["options"], sort_keys=True)
    for name, key in (("rest", "identity_rest"), ("scale_params", "scale_params")):
        if name in identity:
            found[key] = np.asarray(identity[name], np.float32)
    return found


def check_rig(motion: Motion, revision: str) -> bool:
    """Tell whether `motion` was made for the rig `revision`; an unknown rig counts as the same.

    Relative rotations mean nearly the same on every revision, so another rig is only reported (False).

    Raises:
        InputError: absolute rotations of another rig, which would bend every joint.
    """
    made_for, here = (name.split("-")[0][:16] for name in (motion.rig_revision, revision))
    same = not made_for or not here or made_for == here
    if not same and motion.convention == "absolute_local":
        raise InputError(
            "motion.rig_revision",
            got=made_for,
            expected=here,
            fix="Convert it to T-pose-relative rotations with the rig it was made for.",
        )
    return same
