"""Read SOMA motion files: the schema of this package, and the older files of the SOMA tools."""

from __future__ import annotations

import logging
from typing import Literal, cast

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.io.joint_order import CONTACT_JOINTS, USER_JOINTS
from soma_core.io.motion import Convention, Motion
from soma_core.io.npz_fields import NpzFields, check_rotations, say_overridden
from soma_core.io.rotation_vectors import degrees_doubt, in_radians
from soma_core.json_file import parse_json
from soma_core.topology.frames import ANY_UNIT, METRES_PER_UNIT

__all__ = ["LIKELY_CONTACT", "METRES_PER_UNIT", "SCHEMA_VERSION", "read_soma_npz"]

_log = logging.getLogger(__name__)

SCHEMA_VERSION = 1
"""Version of the motion schema that this package writes."""


LIKELY_CONTACT = 0.5
"""A contact that is stored as a probability counts from here on."""

_ROOT_TOLERANCE = 1e-4
"""Largest entry of |R_Root - I| accepted: Root is virtual, only rounding may move it."""


def read_soma_npz(
    fields: NpzFields,
    *,
    fps: float | None,
    unit: str | None,
    convention: Convention | None,
    angles: Literal["rad", "deg"] | None = None,
    columns: bool = False,
) -> Motion:
    """Read a motion whose rotations are stored under ``poses``.

    Files without ``schema_version`` are those of the SOMA tools: they hold neither frame rate nor rig
    revision, may list the virtual Root first, and rotation vectors written by the reference converters
    are doubled for angles up to 1e-3 rad (below what can be told apart from motion, so kept). With `columns`
    matrices are stored column by column, or vectors were made of such.

    Raises:
        InputError: a key is missing, has another layout, or contradicts another key.
    """
    _check_schema(fields)
    rotations = _rotations(fields, angles)
    rotations = rotations[:, _columns(fields, rotations)]
    rotations = np.swapaxes(rotations, -1, -2) if columns else rotations
    metres = _metres(fields, unit)
    translation = fields.numbers("transl", (len(rotations), 3)) * metres
    ours = "schema_version" in fields
    return Motion(
        rotations=rotations,
        translation=translation,
        fps=_frame_rate(fields, fps),
        joint_names=USER_JOINTS,
        convention=_convention(fields, convention),
        rig_revision=fields.text("rig_hash", ""),
        source=fields.text("source", "") or f"SOMA motion file {fields.path.name}",
        identity=_identity(fields),
        licence=fields.text("licence", ""),
        contacts=_contacts(fields, len(rotations)) if ours else None,
        skeleton=_skeleton(fields, metres) if ours else None,
        expression=_expression(fields, len(rotations)) if ours else None,
    )


def _contacts(fields: NpzFields, frames: int) -> np.ndarray | None:
    """Heels and toes on the ground, (frames, 4) bool; stored as truth or as how likely it is."""
    if "foot_contacts" not in fields:
        return None
    return fields.numbers("foot_contacts", (frames, len(CONTACT_JOINTS))) > LIKELY_CONTACT


def _expression(fields: NpzFields, frames: int) -> np.ndarray | None:
    """Coefficients of the face (frames, k) of the body's own model, where the file has them."""
    return fields.numbers("expression", (frames, "coefficients")) if "expression" in fields else None


def _skeleton(fields: NpzFields, metres: float) -> np.ndarray | None:
    """Offsets (77, 3) of the joints of the recorded body [m]; those that are unknown are NaN."""
    if "skeleton" not in fields:
        return None
    offsets = fields.raw("skeleton")
    if offsets.dtype.kind != "f" or offsets.shape != (len(USER_JOINTS), 3):
        raise fields.refuse(
            "skeleton",
            got=f"{offsets.dtype} of shape {offsets.shape}",
            expected=f"({len(USER_JOINTS)}, 3) numbers, NaN for unknown bones",
            fix="Store the offset of each joint from its parent in the T-pose, or leave the key out.",
        )
    return metres * offsets.astype(np.float64)


def _check_schema(fields: NpzFields) -> None:
    if "schema_version" not in fields:
        return
    version = fields.number("schema_version")
    if version != SCHEMA_VERSION:
        raise fields.refuse(
            "schema_version",
            got=f"{version:g}",
            expected=SCHEMA_VERSION,
            fix="Read it with the release of soma-body-core that wrote it, or update this one.",
        )
    up_axis = fields.text("up_axis")
    if up_axis.upper() != "Y":
        raise fields.refuse(
            "up_axis", got=repr(up_axis), expected="'Y'", fix="Rotate the motion to +Y up first."
        )
    meaning = fields.text("root_translation")
    if meaning != "hips_world_position":
        raise fields.refuse(
            "root_translation",
            got=repr(meaning),
            expected="'hips_world_position'",
            fix="Store the world position of Hips, not an offset.",
        )


def _rotations(fields: NpzFields, angles: Literal["rad", "deg"] | None) -> np.ndarray:
    """Matrices (frames, joints, 3, 3) float64, stored as such or as rotation vectors."""
    stored = fields.raw("poses")
    default = "matrix" if stored.ndim == 4 else "rotvec"
    kind = fields.text("rotation_repr", default)
    if kind not in ("rotvec", "matrix"):
        raise fields.refuse(
            "rotation_repr", got=repr(kind), expected="'rotvec' or 'matrix'", fix="Convert the rotations."
        )
    if kind == "matrix":
        matrices = fields.numbers("poses", ("frames", "77 or 78", 3, 3))
        check_rotations(f"{fields.path}: poses", matrices)
        if angles == "deg":
            raise fields.refuse(
                "poses", got="rotation matrices", expected="vectors, for angles=deg", fix="Leave angles out."
            )
        return matrices
    vectors = in_radians(fields.path, fields.numbers("poses", ("frames", "77 or 78", 3)), angles)
    doubt = None if angles else degrees_doubt(vectors)
    if doubt:
        _log.warning("%s: %s", fields.path.name, doubt)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def _columns(fields: NpzFields, rotations: np.ndarray) -> list[int]:
    """Column of each user joint in the file, found by name where names are stored."""
    count = rotations.shape[1]
    names = fields.texts("joint_names") if "joint_names" in fields else ()
    if len(names) == count + 1 and names[0] == "Root":
        names = names[1:]
    names = names or {77: USER_JOINTS, 78: ("Root", *USER_JOINTS)}.get(count, ())
    missing = [name for name in USER_JOINTS if name not in names]
    if count not in (77, 78) or len(names) != count or missing:
        lost = " Hips is not among them: it was dropped on writing (keep_root)." if "Hips" in missing else ""
        raise fields.refuse(
            "poses",
            got=f"{count} joints and {len(names)} names that start with {names[:2]}.{lost}",
            expected="the 77 joints of the skeleton, or those and Root",
            fix="Export the motion again with all joints (keep_root=True with 77 joints).",
        )
    if names[0] == "Root":
        _check_root(fields, rotations[:, 0])
    return [names.index(name) for name in USER_JOINTS]


def _check_root(fields: NpzFields, root: np.ndarray) -> None:
    moved = np.abs(root - np.eye(3)).max(axis=(1, 2))
    if moved.max() > _ROOT_TOLERANCE:
        raise fields.refuse(
            "poses",
            got=f"a rotated Root (|R - I| = {moved.max():.3g} in frame {int(moved.argmax())})",
            expected="the identity for Root, which is virtual",
            fix="Put the global rotation and position into Hips.",
        )


def _metres(fields: NpzFields, unit: str | None) -> float:
    own = fields.text("unit", "")
    if unit is not None and own and ANY_UNIT.get(own) != ANY_UNIT.get(unit):
        say_overridden(fields.path, "unit", given=unit, own=own)
    name = unit if unit is not None else own
    if name not in ANY_UNIT:
        raise fields.refuse(
            "unit",
            got=repr(name) if name else "no unit",
            expected=" or ".join(map(repr, METRES_PER_UNIT)),
            fix="Pass unit=m, cm or mm (motion_unit= to soma animate).",
        )
    return ANY_UNIT[name]


def _frame_rate(fields: NpzFields, fps: float | None) -> float:
    if fps is not None:
        if "fps" in fields:
            say_overridden(fields.path, "fps", given=fps, own=fields.number("fps"))
        return float(fps)
    if "fps" not in fields:
        raise fields.refuse(
            "fps",
            got="no frame rate",
            expected="frames per second",
            fix="Pass fps=30, the true rate (motion_fps= to soma animate).",
        )
    return fields.number("fps")


def _convention(fields: NpzFields, convention: Convention | None) -> Convention:
    """What zero means, from the first of: the argument, our key, the flags of the SOMA tools."""
    if convention is not None:
        return convention
    if "convention" in fields:
        return cast("Convention", fields.text("convention"))
    has_orient = "joint_orient" in fields
    relative = not fields.number("absolute_pose") if "absolute_pose" in fields else has_orient
    if relative != has_orient:
        raise fields.refuse(
            "absolute_pose",
            got=f"absolute_pose={not relative} {'with' if has_orient else 'without'} joint_orient",
            expected="joint_orient exactly when poses are T-pose-relative",
            fix="Say which by soma convert convention=t_pose_relative or absolute_local.",
        )
    return "t_pose_relative" if relative else "absolute_local"


def _identity(fields: NpzFields) -> dict[str, object]:
    """Backend name and parameters, as far as the file tells."""
    found: dict[str, object]
    backend = fields.text("identity_model_type", "")
    if not backend:
        return {}
    if "identity_params" in fields:
        found = {"backend": backend, "params": _params(fields), **_rest(fields)}
        if "identity_options" in fields:
            given = _parsed(fields, "identity_options")
            # Whether a model file is trusted, and so may run code, is no stranger's to say.
            found["options"] = {name: value for name, value in given.items() if name != "trust"}
        return found
    found = {"backend": backend}
    for key in ("identity_coeffs", "scale_params"):
        if key in fields and fields.raw(key).dtype.kind == "f":
            found[key] = fields.raw(key).astype(np.float32)
    return found


def _params(fields: NpzFields) -> dict[str, object]:
    """Values of the parameters by their names, finite numbers."""
    params = _parsed(fields, "identity_params")
    for name, value in params.items():
        try:
            numbers = np.asarray(value, np.float64)
        except (ValueError, TypeError):
            numbers = np.array(np.nan)
        if not np.isfinite(numbers).all():
            raise fields.refuse(
                "identity_params", got=f"{name} = {value!r:.60}", expected="finite numbers",
                fix=f"Correct {name}, or leave the identity out and pass backend=NAME.",
            )  # fmt: skip
    return params


def _rest(fields: NpzFields) -> dict[str, object]:
    """A rest shape (v, 3) [m] that no parameters describe."""
    if "identity_rest" not in fields:
        return {}
    rest = fields.raw("identity_rest")
    fits = rest.dtype.kind == "f" and rest.ndim == 2 and rest.shape[1] == 3
    if not fits or not np.isfinite(rest).all():
        raise fields.refuse(
            "identity_rest",
            got="NaN or infinity" if fits else f"{rest.dtype} of shape {rest.shape}",
            expected="vertices (v, 3) [m] as finite floating point numbers",
            fix="Write the rest shape on the canonical mesh.",
        )
    return {"rest": rest.astype(np.float32)}


def _parsed(fields: NpzFields, key: str) -> dict[str, object]:
    text = fields.text(key)
    try:
        return dict(parse_json(text))
    except (ValueError, TypeError) as error:
        raise fields.refuse(
            key,
            got=repr(text[:40]),
            expected="a JSON object",
            fix=f"Write valid JSON ({error}).",
        ) from error
