"""A motion on the canonical skeleton, independent of any identity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Literal

import numpy as np

from soma_core.errors import InputError, check_type
from soma_core.io.joint_order import CONTACT_JOINTS

__all__ = ["Convention", "Motion", "check_motion"]

Convention = Literal["t_pose_relative", "absolute_local"]


_MOST_FPS = 10_000
"""Frames per second that a motion may have; windows in seconds would have no end of frames."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Joint rotations over time.

    Attributes:
        rotations: (frames, 77, 3, 3) float32 matrices, user-joint order (Hips first).
        translation: (frames, 3) float32 Hips world position [m], +Y up; it replaces the rest position.
        fps: frames per second.
        joint_names: 77 names.
        convention: ``t_pose_relative`` (zero is the T-pose) or ``absolute_local``.
        rig_revision: revision of the rig the rotations were made for, empty if unknown.
        source: where the motion came from.
        identity: optional backend name and parameters it was recorded with, ``options`` of the backend if
            there were any, and under ``rest`` a rest shape (v, 3) [m] on the canonical mesh if no parameters
            describe it.
        licence: licence or terms of the motion, empty if unknown.
        contacts: (frames, 4) whether ``CONTACT_JOINTS`` stand on the ground: left heel, left toes, right
            heel, right toes; None if unknown.
        skeleton: (77, 3) float32 from the parent to each joint in the T-pose [m], of the body that was
            recorded; NaN for a joint whose bone is unknown, None if all are.
        expression: (frames, k) float32 coefficients of the face of the body's own model, which this skeleton
            has only a jaw for; None without.

    Raises:
        InputError: a shape, a value, the frame rate or the convention cannot be a motion.
    """

    rotations: np.ndarray
    translation: np.ndarray
    fps: float
    joint_names: tuple[str, ...]
    convention: Convention = "t_pose_relative"
    rig_revision: str = ""
    source: str = ""
    identity: Mapping[str, object] = field(default_factory=dict)
    licence: str = ""
    contacts: np.ndarray | None = None
    skeleton: np.ndarray | None = None
    expression: np.ndarray | None = None

    def __post_init__(self) -> None:
        check_type("identity", self.identity, Mapping, fix="Give {} where none is known.")
        if len(set(self.joint_names)) < len(self.joint_names):
            raise InputError(
                "joint_names", got="a name twice", expected="one for each joint", fix="Name each once."
            )
        rotations = np.asarray(self.rotations, np.float32)
        translation = np.asarray(self.translation, np.float32)
        object.__setattr__(self, "rotations", rotations)
        object.__setattr__(self, "translation", translation)
        frames = len(rotations) if rotations.ndim else 0
        _expect("rotations", rotations, (frames, len(self.joint_names), 3, 3))
        _expect("translation", translation, (frames, 3))
        self._check_recorded(frames)
        if frames == 0:
            raise InputError("rotations", got="0 frames", expected="at least one", fix="Give a longer clip.")
        if not (isinstance(self.fps, Real) and 0 < self.fps <= _MOST_FPS):
            raise InputError(
                "fps",
                got=repr(self.fps),
                expected=f"a positive number, at most {_MOST_FPS:,}",
                fix="Give the frame rate in frames per second.",
            )
        if self.convention not in ("t_pose_relative", "absolute_local"):
            raise InputError(
                "convention",
                got=repr(self.convention),
                expected="'t_pose_relative' or 'absolute_local'",
                fix="Say which zero the rotations have.",
            )

    def _check_recorded(self, frames: int) -> None:
        """Bring what is known of the recorded body to its types."""
        if self.contacts is not None:
            contacts = np.asarray(self.contacts, bool)
            _expect("contacts", contacts, (frames, len(CONTACT_JOINTS)))
            object.__setattr__(self, "contacts", contacts)
        if self.expression is not None:
            expression = np.asarray(self.expression, np.float32)
            _expect("expression", expression, (frames, expression.shape[-1] if expression.ndim else 0))
            object.__setattr__(self, "expression", expression)
        if self.skeleton is not None:
            skeleton = np.asarray(self.skeleton, np.float32)
            _expect("skeleton", np.nan_to_num(skeleton, nan=0.0), (len(self.joint_names), 3))
            object.__setattr__(self, "skeleton", skeleton)

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.rotations)

    def cut(self, frames: slice | np.ndarray) -> Motion:
        """Some of the frames, with all that is kept of each; the frame rate stays.

        Args:
            frames: a slice, or numbers of frames.
        """
        names = ("rotations", "translation", "contacts", "expression")
        kept = {name: value for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **{name: value[frames] for name, value in kept.items()})


def check_motion(motion: object) -> None:
    """Refuse (InputError) what is no motion on this skeleton."""
    check_type("motion", motion, Motion, fix="Read one: soma_core.motion.read(path), or convert(path).")


def _expect(argument: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    """Refuse another shape and values that are not finite."""
    if array.shape != shape:
        raise InputError(
            argument,
            got=f"shape {array.shape}",
            expected=f"shape {shape}",
            fix="Give one entry per frame and joint.",
        )
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        raise InputError(
            argument,
            got=f"{array[tuple(bad[0])]} at index {tuple(map(int, bad[0]))}",
            expected="finite numbers",
            fix="Remove or interpolate the damaged frames.",
        )
