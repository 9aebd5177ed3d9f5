"""Motions of the SMPL family in the layouts of AMASS: pose parameters, not vertices; metres, +Z up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.cache import atomic_arrays
from soma_core.errors import InputError
from soma_core.io.vertex_sequence import UpAxis

__all__ = [
    "SMPL_JOINTS",
    "Gender",
    "SmplMotion",
    "SmplName",
    "write_amass",
    "write_smplx",
]

SmplName = Literal["smpl", "smplh", "smplx"]
Gender = Literal["neutral", "male", "female"]

SMPL_JOINTS: dict[SmplName, int] = {"smpl": 24, "smplh": 52, "smplx": 55}
"""Joints of each model, whose names are those of the backends."""

_PARTS = {"root_orient": 3, "pose_body": 63, "pose_jaw": 3, "pose_eye": 6, "pose_hand": 90}
"""Keys that SMPL-X files split the pose into, in the order of the joints, and their widths."""

_HANDS = {"left_hand_pose": 45, "right_hand_pose": 45}
_SMPLX_PARTS: dict[SmplName, dict[str, int]] = {
    "smpl": {"global_orient": 3, "body_pose": 69},
    "smplh": {"global_orient": 3, "body_pose": 63, **_HANDS},
    "smplx": {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3, **_HANDS},
}
"""Arguments of each model in its own code, in the order of the joints, and their widths."""

_EXPRESSIONS = 10

_SECONDS = "mocap_time_length"


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
        up: upward axis of the world: ``+z`` in AMASS, ``-y`` in a camera.
        about: what the root rotation turns about, before the translation: the pelvis, or the origin of the
            model as EasyMocap has it.
        camera_turns: (frames, 3) axis-angle vectors [rad] of the camera that the motion was brought into the
            world by, about the origin; the root has turned by them. None for none.
        flat_hands: whether zero is a flat hand; False: the model's mean hand.
        hand_components: (frames, 2 n) coefficients of the model's own components of both hands, left first,
            which its fingers turn by as well; None for none.
        expression: (frames, k) coefficients of the face of SMPL-X; None where there are none.
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
    about: Literal["pelvis", "origin"] = "pelvis"
    camera_turns: np.ndarray | None = None
    flat_hands: bool = True
    hand_components: np.ndarray | None = None
    expression: np.ndarray | None = None
    source: str = ""

    def __post_init__(self) -> None:
        """Check everything, and keep single precision."""
        for name in ("rotations", "translation", "betas"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float32))
        for name, value, among in (
            ("model", self.model, get_args(SmplName)),
            ("gender", self.gender, get_args(Gender)),
            ("up", self.up, get_args(UpAxis)),
            ("about", self.about, ("pelvis", "origin")),
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

    def about_pelvis(self, pelvis: np.ndarray) -> np.ndarray:
        """Translation (frames, 3) [m] beside a root that turns about the pelvis.

        Args:
            pelvis: (3,) where it is at rest [m], which the file does not tell.
        """
        turns = self.rotations[:, 0] if self.about == "origin" else self.camera_turns
        if turns is None:
            return self.translation
        return np.asarray(self.translation + Rotation.from_rotvec(turns).apply(pelvis) - pelvis, np.float32)


def _expect(argument: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or not np.isfinite(array).all():
        got = f"shape {array.shape}" if array.shape != shape else "NaN or infinity"
        raise InputError(
            argument, got=got, expected=f"finite numbers of shape {shape}", fix="Give one row a frame."
        )


def write_amass(
    motion: SmplMotion, path: str | Path, *, extra: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write `motion` in the layout of AMASS, atomically.

    SMPL-X files get ``poses`` and its parts, ``mocap_frame_rate`` and, with a face that moves,
    ``expressions``; the others ``poses`` and
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
        "surface_model_type": motion.model,
    }  # fmt: skip
    if motion.model == "smplx":
        ends = np.cumsum(list(_PARTS.values()))
        values |= {
            key: poses[:, end - width : end] for (key, width), end in zip(_PARTS.items(), ends, strict=True)
        }
        values |= {"mocap_frame_rate": motion.fps, _SECONDS: motion.frame_count / motion.fps}
        values["num_betas"] = len(motion.betas)
        if motion.expression is not None:
            values["expressions"] = motion.expression
    else:
        values["mocap_framerate"] = motion.fps
    _write(path, values, extra)


def write_smplx(
    motion: SmplMotion, path: str | Path, *, extra: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write `motion` under the names that the models' own code takes, atomically.

    ``global_orient`` (frames, 3), ``body_pose`` (frames, 69 for SMPL, else 63), ``transl`` (frames, 3),
    ``betas`` (1, k); for SMPL-X ``jaw_pose``, ``leye_pose``, ``reye_pose`` and ``expression``
    (frames, k); with hands ``left_hand_pose`` and ``right_hand_pose`` (frames, 45). ``flat_hand_mean`` and
    ``use_pca`` say how a model has to be made for them; also ``gender``, ``fps``, ``surface_model_type``.

    Args:
        motion: what to write; its world is kept as it is.
        path: the NPZ file.
        extra: further arrays under names of their own.

    Raises:
        InputError: as :func:`write_amass`.
    """
    poses = motion.rotations.reshape(motion.frame_count, -1)
    values: dict[str, object] = {}
    end = 0
    for name, width in _SMPLX_PARTS[motion.model].items():
        values[name] = poses[:, end : end + width]
        end += width
    values |= {"transl": motion.translation, "betas": motion.betas[None]}
    if motion.model == "smplx":
        still = np.zeros((motion.frame_count, _EXPRESSIONS), np.float32)
        values["expression"] = still if motion.expression is None else motion.expression
    if motion.model != "smpl":
        values |= {"flat_hand_mean": True, "use_pca": False}
    values |= {"gender": motion.gender, "surface_model_type": motion.model, "fps": motion.fps}
    _write(path, values, extra)


def _write(path: str | Path, values: dict[str, object], extra: Mapping[str, np.ndarray] | None) -> None:
    """Write the values of a layout and what is beside it."""
    for name, array in (extra or {}).items():
        if name in values or np.asarray(array).dtype.hasobject:
            got = f"{name!r}, which the layout has" if name in values else f"Python objects under {name!r}"
            raise InputError(
                "extra", got=got, expected="plain arrays under other names", fix="Rename or leave it out."
            )
    arrays = {name: np.asarray(value) for name, value in (values | dict(extra or {})).items()}
    atomic_arrays(Path(path), arrays)
