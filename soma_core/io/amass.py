"""Motions of the SMPL family in the layouts of AMASS: pose parameters, not vertices; metres, +Z up."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np

from soma_core.cache import atomic_arrays
from soma_core.errors import InputError
from soma_core.io.npz_fields import NpzFields, open_npz, say_overridden
from soma_core.io.vertex_sequence import UpAxis

__all__ = [
    "SMPL_JOINTS",
    "Gender",
    "SmplMotion",
    "SmplName",
    "holds_smpl_motion",
    "read_amass",
    "write_amass",
]

SmplName = Literal["smpl", "smplh", "smplx"]
Gender = Literal["neutral", "male", "female"]

SMPL_JOINTS: dict[SmplName, int] = {"smpl": 24, "smplh": 52, "smplx": 55}
"""Joints of each model, whose names are those of the backends."""

_PARTS = {"root_orient": 3, "pose_body": 63, "pose_jaw": 3, "pose_eye": 6, "pose_hand": 90}
"""Keys that SMPL-X files split the pose into, in the order of the joints, and their widths."""

_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
_SECONDS, _MODEL = "mocap_time_length", "surface_model_type"
_COUNTED, _LASTING = 1.5, 0.02
"""Frames, and share of them, that a duration may be off by: ends that were cut, rates that were rounded."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class SmplMotion:
    """A motion of SMPL, SMPL-H or SMPL-X.

    Attributes:
        model: which of them; also the name of its backend.
        rotations: (frames, J, 3) local axis-angle vectors [rad], the pelvis first; zero is the T-pose with
            flat hands.
        translation: (frames, 3) added to every posed vertex [m]; not the place of the pelvis, which is this
            plus its rest position.
        betas: (k,) shape coefficients.
        gender: of the model that the shape belongs to.
        fps: frames per second.
        up: upward axis of the world: ``+z`` in AMASS.
        source: where it came from.

    Raises:
        InputError: a shape, a value, the gender or the frame rate cannot be a motion.
    """

    model: SmplName
    rotations: np.ndarray
    translation: np.ndarray
    betas: np.ndarray
    gender: Gender
    fps: float
    up: UpAxis = "+z"
    source: str = ""

    def __post_init__(self) -> None:
        """Check everything, and keep single precision."""
        for name in ("rotations", "translation", "betas"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float32))
        for name, value, among in (
            ("model", self.model, get_args(SmplName)),
            ("gender", self.gender, get_args(Gender)),
            ("up", self.up, get_args(UpAxis)),
        ):
            if value not in among:
                expected = "one of " + ", ".join(map(repr, among))
                raise InputError(name, got=repr(value), expected=expected, fix="Correct the name.")
        frames = len(self.rotations) if self.rotations.ndim else 0
        _expect("rotations", self.rotations, (max(frames, 1), SMPL_JOINTS[self.model], 3))
        _expect("translation", self.translation, (frames, 3))
        _expect("betas", self.betas, (self.betas.size,))
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise InputError("fps", got=self.fps, expected="a positive number", fix="Give the frame rate.")

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.rotations)


def _expect(argument: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or not np.isfinite(array).all():
        got = f"shape {array.shape}" if array.shape != shape else "NaN or infinity"
        raise InputError(
            argument, got=got, expected=f"finite numbers of shape {shape}", fix="Give one row a frame."
        )


def holds_smpl_motion(fields: NpzFields) -> bool:
    """Tell whether the keys of a file are those of a motion of the SMPL family."""
    return "trans" in fields and ("poses" in fields or "pose_body" in fields)


def read_amass(
    path: str | Path,
    *,
    fps: float | None = None,
    gender: Gender | None = None,
    up: UpAxis | None = None,
) -> SmplMotion:
    """Read an ``.npz`` of AMASS: SMPL-H (``poses`` of 156 values), SMPL-X (parts, or 165), also SMPL (72).

    Soft-tissue coefficients (``dmpls``) and markers are not read.

    Args:
        path: the file. Nothing in it is executed; keys that are not needed are ignored.
        fps: frame rate; overrides the file's own.
        gender: of the body; overrides the file's own.
        up: upward axis of the world; ``+z`` unless told otherwise, the files do not say.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or no NPZ.
        InputError: a key is missing or holds what a motion cannot have.
    """
    with open_npz(path) as fields:
        poses = _poses(fields)
        model = next(name for name, count in SMPL_JOINTS.items() if 3 * count == poses.shape[1])
        _question_model(fields, model)
        return SmplMotion(
            model=model,
            rotations=poses.reshape(len(poses), -1, 3),
            translation=fields.numbers("trans", (len(poses), 3)),
            betas=_betas(fields, len(poses)),
            gender=_asked_gender(fields, gender) or _gender(fields),
            fps=_rate(fields, len(poses), fps),
            up=up or "+z",
            source=fields.path.name,
        )


def _poses(fields: NpzFields) -> np.ndarray:
    """Axis-angle values of all joints, (frames, 72, 156 or 165)."""
    if "pose_body" in fields:
        rows = fields.numbers("pose_body", ("frames", _PARTS["pose_body"]))
        parts = [fields.numbers(key, (len(rows), width)) for key, width in _PARTS.items()]
        poses = np.concatenate(parts, axis=1)
    else:
        poses = fields.numbers("poses", ("frames", "72, 156 or 165"))
    widths = {3 * count: name for name, count in SMPL_JOINTS.items()}
    if poses.shape[1] not in widths or not len(poses):
        raise fields.refuse(
            "poses",
            got=f"shape {poses.shape}",
            expected=", ".join(f"{width} values ({name})" for width, name in widths.items()) + " a frame",
            fix="Export all joints as axis-angle vectors, hands included.",
        )
    return poses


def _betas(fields: NpzFields, frames: int) -> np.ndarray:
    """One row of coefficients; files that repeat it for every frame are accepted."""
    single = fields.raw("betas").ndim == 1
    rows = np.atleast_2d(fields.numbers("betas", ("k",) if single else ("1 or frames", "k")))
    if len(rows) not in (1, frames) or np.ptp(rows, axis=0).max(initial=0) > 0:
        raise fields.refuse(
            "betas",
            got=f"{len(rows)} rows" + (" that differ" if len(rows) == frames else ""),
            expected="one row of shape coefficients",
            fix="Write one file a body.",
        )
    return rows[0]


def _question_model(fields: NpzFields, model: SmplName) -> None:
    """Warn where the betas of a file were fitted with another model than its poses are for."""
    own = (
        fields.texts(_MODEL)[0].lower() if _MODEL in fields and fields.raw(_MODEL).dtype.kind in "SU" else ""
    )
    if own.replace("+", "") in ("", model):
        return
    mend = (
        "keep only its files (..._2020) in the folder SMPLX"
        if "locked" in own
        else f"poses are those of {model}"
    )
    _log.warning(
        "%s: the betas belong to the model %r (%s), which is not %s; %s",
        fields.path.name, own, _MODEL, model, mend,
    )  # fmt: skip


def _asked_gender(fields: NpzFields, gender: Gender | None) -> Gender | None:
    """The gender that is asked for; a warning where the file's betas belong to another."""
    if gender is not None and "gender" in fields and fields.raw("gender").dtype.kind in "SU":
        own = fields.text("gender").lower()
        if own in get_args(Gender) and own != gender:
            say_overridden(
                fields.path, "gender", given=gender, own=f"{own}, whose betas are another body there"
            )
    return gender


def _gender(fields: NpzFields) -> Gender:
    name = fields.text("gender").lower()
    if name not in get_args(Gender):
        raise fields.refuse(
            "gender",
            got=repr(name),
            expected=" or ".join(map(repr, get_args(Gender))),
            fix="Pass gender=neutral, male or female.",
        )
    return cast("Gender", name)


def _rate(fields: NpzFields, frames: int, fps: float | None) -> float:
    """The frame rate that is asked for, else the file's; a warning where the file contradicts either."""
    found = {key: fields.number(key) for key in _RATES if key in fields}
    if fps is not None:
        say_overridden(fields.path, "fps", given=float(fps), own=next(iter(found.values()), float(fps)))
        return float(fps)
    seconds = fields.number(_SECONDS) if _SECONDS in fields else 0.0
    key = next((key for key in found if _lasts(frames, found[key], seconds)), next(iter(found), None))
    if key is None:
        raise fields.refuse(
            _RATES[0],
            got="no frame rate",
            expected="frames per second",
            fix="Pass fps=120 (or the true rate).",
        )
    rate = found[key]
    if rate <= 0:
        raise fields.refuse(
            key, got=f"{rate:g}", expected="a positive number", fix="Pass fps=120 (the true rate)."
        )
    others = [f"{name}={other:g}" for name, other in found.items() if not np.isclose(other, rate, rtol=1e-3)]
    if seconds > 0 and not _lasts(frames, rate, seconds):
        others.append(f"{_SECONDS}={seconds:g}, which {frames} frames last at {frames / seconds:.4g}")
    if others:
        _log.warning(
            "%s: %s=%g is taken for the frame rate, against %s; pass fps= for another",
            fields.path.name, key, rate, " and ".join(others),
        )  # fmt: skip
    return rate


def _lasts(frames: int, rate: float, seconds: float) -> bool:
    """Whether so many frames last about so long; a file may count one more or one less."""
    return abs(frames - seconds * rate) <= max(_COUNTED, _LASTING * frames)


def write_amass(
    motion: SmplMotion, path: str | Path, *, extra: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write `motion` in the layout of AMASS, atomically.

    SMPL-X files get ``poses`` and its parts and ``mocap_frame_rate``, the others ``poses`` and
    ``mocap_framerate``, as those of AMASS do.

    Args:
        motion: what to write; its world is kept as it is, +Z up is what other tools expect.
        path: the NPZ file.
        extra: further arrays under names of their own.

    Raises:
        InputError: a name that the layout has already, or an array of Python objects.
    """
    poses = motion.rotations.reshape(motion.frame_count, -1)
    values: dict[str, object] = {
        "poses": poses, "trans": motion.translation, "betas": motion.betas, "gender": motion.gender,
        _MODEL: motion.model,
    }  # fmt: skip
    if motion.model == "smplx":
        ends = np.cumsum(list(_PARTS.values()))
        values |= {
            key: poses[:, end - width : end] for (key, width), end in zip(_PARTS.items(), ends, strict=True)
        }
        values |= {"mocap_frame_rate": motion.fps, _SECONDS: motion.frame_count / motion.fps}
        values["num_betas"] = len(motion.betas)
    else:
        values["mocap_framerate"] = motion.fps
    for name, array in (extra or {}).items():
        if name in values or np.asarray(array).dtype.hasobject:
            got = f"{name!r}, which the layout has" if name in values else f"Python objects under {name!r}"
            raise InputError(
                "extra", got=got, expected="plain arrays under other names", fix="Rename or leave it out."
            )
    arrays = {name: np.asarray(value) for name, value in (values | dict(extra or {})).items()}
    atomic_arrays(Path(path), arrays)
