"""Read a motion of the SMPL family under the names of whatever tool wrote it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.io.amass import Gender, SmplMotion, SmplName
from soma_core.io.data_files import DataFile, open_data
from soma_core.io.frame_gaps import fill_gaps, kept_frames
from soma_core.io.rotation_shapes import RotationLayout
from soma_core.io.smpl_bodies import (
    FoundBody,
    choose_body,
    find_bodies,
    holds_poses,
    no_bodies,
    people_in,
    shown_names,
)
from soma_core.io.smpl_camera import camera_beside, in_world
from soma_core.io.smpl_names import RATES
from soma_core.io.smpl_parts import BodyParts
from soma_core.io.smpl_pose import SmplPose, read_pose

__all__ = ["SmplChoices", "people_of", "read_amass", "read_smpl", "smpl_layout"]

_log = logging.getLogger(__name__)

_STANDS = 0.7
"""Cosine between the mean upward direction of a body and an axis, from which on it stands along it."""

_GENDERS = {"m": "male", "f": "female", "n": "neutral"} | {name: name for name in get_args(Gender)}
_VIDEO = 30.0
"""Frame rate of most videos [1/s]."""

_SAME_RATE = 2e-3
"""Relative difference of frame rates that are the same, as 29.97 and 30 are."""

_OF_AMASS = {"trans", "mocap_framerate", "mocap_frame_rate"}
"""Keys of files whose world has +z up, as AMASS has it."""

_COUNTED, _LASTING = 1.5, 0.02
"""Frames, and share of them, that a duration may be off by: ends that were cut, rates that were rounded."""

_SAME_BODY = 1e-4
"""Largest spread of coefficients [standard deviations] that is rounding, not another body."""


@dataclass(frozen=True, kw_only=True)
class SmplChoices:
    """What a file does not say, and which of several things in it is read.

    Attributes:
        fps, gender, up, betas, model: override the file's own.
        person: whose motion; None: of the only one.
        coordinates: ``world`` or ``camera``; None: the world where there is one.
        betas_from: how one body is made of shapes for each frame.
        rotation_layout: of quaternions, ``wxyz`` or ``xyzw``, and of 6D rotations, ``rows`` or ``columns``.
        flat_hand_mean: whether zero is a flat hand; None: as the file says, or flat.
        gaps: ``interpolate`` or ``drop`` frames that are missing or NaN.
        longest_gap: that is interpolated [s].
    """

    fps: float | None = None
    gender: Gender | None = None
    up: Literal["+y", "+z", "-y", "-z"] | None = None
    betas: Sequence[float] | None = None
    model: SmplName | None = None
    person: str | None = None
    coordinates: Literal["world", "camera"] | None = None
    betas_from: Literal["mean", "median", "first"] = "mean"
    rotation_layout: RotationLayout | None = None
    flat_hand_mean: bool | None = None
    gaps: Literal["interpolate", "drop"] = "interpolate"
    longest_gap: float = 1.0


def smpl_layout(path: str | Path, *, readable: bool = False) -> Literal["amass", "smpl"] | None:
    """``amass`` or ``smpl`` for a file with poses of the SMPL family; None for others.

    Args:
        path: the file.
        readable: whether names alone do not count, only poses that can be read.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or not what its suffix says.
    """
    with open_data(path) as file:
        if not find_bodies(file) and (readable or not holds_poses(file)):
            return None
        names = set(file.content) if isinstance(file.content, dict) else set()
        if "trans" in names and names & {"poses", "pose_body"} and file.path.suffix.lower() == ".npz":
            return "amass"
        return "smpl"


def people_of(path: str | Path) -> list[str]:
    """Whose motions a file holds; one empty name where it holds one motion.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or not what its suffix says.
    """
    with open_data(path) as file:
        return people_in(find_bodies(file))


def read_amass(
    path: str | Path,
    *,
    fps: float | None = None,
    gender: Gender | None = None,
    up: Literal["+y", "+z"] | None = None,
) -> SmplMotion:
    """Read an ``.npz`` of AMASS: SMPL-H (``poses`` of 156 values), SMPL-X (parts, or 165), also SMPL (72).

    Soft-tissue coefficients (``dmpls``) and markers are not read; :func:`read_smpl` has more choices.

    Args:
        path: the file. Nothing in it is executed; keys that are not needed are ignored.
        fps: frame rate; overrides the file's own.
        gender: of the body; overrides the file's own.
        up: upward axis of the world; ``+z`` unless told otherwise, the files do not say.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or no NPZ.
        InputError: a key is missing or holds what a motion cannot have.
    """
    return read_smpl(path, SmplChoices(fps=fps, gender=gender, up=up))


def read_smpl(path: str | Path, choices: SmplChoices | None = None) -> SmplMotion:
    """Read a motion of the SMPL family: AMASS, video estimators, data sets; ``.npz .npy .pkl .pt``.

    Poses may be whole or in parts, under the names of :mod:`soma_core.io.smpl_names` and nested; rotations as
    axis-angle vectors, matrices, quaternions or 6D. What is taken for granted is said in the log.

    Args:
        path: the file. Nothing in it is executed; names that are not needed are ignored.
        choices: between people, spaces and readings.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or not what its suffix says.
        InputError: no pose, several people, or a value that a motion cannot have.
    """
    choices = choices or SmplChoices()
    with open_data(path) as file:
        bodies = find_bodies(file)
        if not bodies:
            raise no_bodies(file)
        camera, space = camera_beside(file, bodies), choices.coordinates
        if camera is not None and space == "world":
            space = None  # by the path of the camera
        body = choose_body(file, bodies, person=choices.person, space=space)
        _say_choice(file, bodies, body)
        return _Reading(file, body, choices, None if space == "camera" else camera).motion()


def _say_choice(file: DataFile, bodies: Sequence[FoundBody], body: FoundBody) -> None:
    spaces = [other.space for other in bodies if other.person == body.person]
    tool = f"read as a file of {body.tool.name}" if body.tool else "read"
    whose = f", person {body.person}" if body.person else ""
    if len(spaces) > 1:
        space = body.space or next(name for name in ("world", "camera") if name not in spaces)
        other = "camera" if space == "world" else "world"
        told = file.path.name, tool, whose, space, other
        _log.info("%s: %s%s: motion in the %s; coordinates=%s for the other", *told)
    elif body.tool or whose:
        _log.info("%s: %s%s", file.path.name, tool, whose)


def _lasts(frames: int, rate: float, seconds: float) -> bool:
    """Whether so many frames last about so long; a file may count one more or one less."""
    return abs(frames - seconds * rate) <= max(_COUNTED, _LASTING * frames)


class _Reading:
    """One body of a file on its way to a motion."""

    def __init__(self, file: DataFile, body: FoundBody, choices: SmplChoices, camera: Path | None) -> None:
        self._file, self._body, self._choices, self._camera = file, body, choices, camera
        self._parts = BodyParts(file, body)
        self._tool = body.tool

    def motion(self) -> SmplMotion:
        choices = self._choices
        pose = read_pose(self._parts, model=choices.model, layout=choices.rotation_layout)
        fps = self._rate(pose.frames)
        translation = self._translation(pose.frames)
        numbers = self._parts.frame_numbers(pose.frames)
        whole = np.isfinite(pose.rotations).all(axis=(1, 2)) & np.isfinite(translation).all(axis=1)
        unseen = "trans" if np.isfinite(pose.rotations).all() and "trans" in self._parts else pose.leading
        rows, times = kept_frames(whole, numbers, self._parts.where(unseen))
        turned, path = pose.rotations[rows], translation[rows]
        if self._camera is not None:
            turned, path = in_world(self._camera, turned, path, rows if numbers is None else numbers[rows])
            _log.info("%s: in the world by %s; or coordinates=camera", self._file.path.name, self._camera)
        face = self._parts.expression(pose.frames) if pose.model == "smplx" else np.zeros((pose.frames, 0))
        moving = np.concatenate([path, pose.hands[rows], face[rows]], axis=1)
        turned, moving = self._without_gaps(turned, moving, times, fps, len(whole))
        rotations = turned[:, : pose.rotations.shape[1]]
        flat = choices.flat_hand_mean
        return SmplMotion(
            model=pose.model, rotations=rotations, translation=moving[:, :3], betas=self._betas(pose),
            gender=self._gender(), fps=fps, up=self._up(rotations),
            about=self._tool.about if self._tool else "pelvis",
            camera_turns=None if self._camera is None else turned[:, -1],
            flat_hands=self._parts.flag("flat", default=not pose.hands.size) if flat is None else flat,
            hand_components=moving[:, 3 : 3 + pose.hands.shape[1]],
            expression=moving[:, moving.shape[1] - face.shape[1] :] if face.any() else None,
            source=self._file.path.name,
        )  # fmt: skip

    def _say(self, text: str, *values: object) -> None:
        _log.warning(f"%s: {text}", self._file.path.name, *values)

    def _rate(self, frames: int) -> float:
        """The frame rate that is asked for, else the file's, else the tool's; said where they contradict."""
        found = {part: self._parts.number(part) for part in RATES if part in self._parts}
        asked = self._choices.fps
        own = next(iter(found.values()), asked)
        if asked is not None:
            if own is not None and abs(asked - own) > _SAME_RATE * own:
                self._say("fps=%g is taken in place of the file's own, %g", asked, own)
            return float(asked)
        if not found:
            return self._usual_rate()
        seconds = self._parts.number("seconds") if "seconds" in self._parts else 0.0
        part = next((part for part in found if _lasts(frames, found[part], seconds)), next(iter(found)))
        rate = found[part]
        if not (np.isfinite(rate) and rate > 0):
            raise self._parts.refuse(
                part, got=f"{rate:g}", expected="a positive number", fix="Pass fps=120 (the true rate)."
            )
        others = [
            f"{self._parts.key(name)}={other:g}"
            for name, other in found.items()
            if abs(other - rate) > 1e-3 * rate
        ]
        if seconds > 0 and not _lasts(frames, rate, seconds):
            others.append(
                f"{self._parts.key('seconds')}={seconds:g}, which {frames} frames last at "
                f"{frames / seconds:.4g}"
            )
        if others:
            key = self._parts.key(part)
            self._say(
                "%s=%g is taken for the frame rate, against %s; pass fps= for another",
                key,
                rate,
                " and ".join(others),
            )
        return rate

    def _usual_rate(self) -> float:
        """That of the tool, where the file has none."""
        tool = self._tool
        if tool is None or (tool.fps is None and tool.gender is None):
            raise self._parts.refuse(
                "rate",
                got="no frame rate",
                expected="frames per second",
                fix="Pass fps=120 (or the true rate).",
            )
        rate = tool.fps or _VIDEO
        self._say("no frame rate in the file, %g is taken; pass fps= for another", rate)
        return rate

    def _gender(self) -> Gender:
        if self._choices.gender:
            own = self._parts.text("gender").lower() if "gender" in self._parts else ""
            other = _GENDERS.get(own, self._choices.gender) != self._choices.gender
            if other and self._choices.betas is None:
                told = "gender=%s is taken in place of %s, whose betas are another body"
                self._say(told, self._choices.gender, own)
            return self._choices.gender
        if "gender" in self._parts:
            name = self._parts.text("gender")
            if name.lower() not in _GENDERS:
                raise self._parts.refuse(
                    "gender", got=repr(name), expected=" or ".join(map(repr, get_args(Gender))),
                    fix="Pass gender=neutral, male or female.",
                )  # fmt: skip
            return cast("Gender", _GENDERS[name.lower()])
        if self._tool and self._tool.gender:
            return cast("Gender", self._tool.gender)
        raise self._parts.refuse(
            "gender", got=f"only the keys {shown_names(self._file)}", expected="a key 'gender'",
            fix="Pass gender=neutral, male or female.",
        )  # fmt: skip

    def _translation(self, frames: int) -> np.ndarray:
        """Translation (frames, 3) in metres; zero where the file has none."""
        if "trans" in self._parts:
            values = self._parts.rows("trans", frames, 3)
            if "scaling" in self._parts:  # AIST++ keeps the body's size, and its path in units of it
                scale = self._parts.number("scaling")
                if not (np.isfinite(scale) and scale > 0):
                    raise self._parts.refuse(
                        "scaling", got=f"{scale:g}", expected="a positive number", fix="Fetch the file again."
                    )
                values = values / scale
            return values
        what = "only a crop's camera, which is no length" if "camera" in self._parts else "no translation"
        self._say("%s in the file: the body stays at the origin", what)
        return np.zeros((frames, 3))

    def _betas(self, pose: SmplPose) -> np.ndarray:
        if self._choices.betas is not None:
            return np.asarray(self._choices.betas, np.float64)
        if "betas" not in self._parts:
            if self._tool and self._tool.no_betas:
                return np.zeros(10)
            raise self._parts.refuse(
                "betas", got="none", expected="shape coefficients",
                fix=f"Pass betas=[{','.join('0' * 10)}] for the mean shape, or the true ones.",
            )  # fmt: skip
        rows = self._parts.betas(pose.frames)
        most = self._tool.most_betas if self._tool else None
        if most is not None and rows.shape[1] > most:
            self._say("shapes of %d numbers: those behind the first %d are not read", rows.shape[1], most)
            rows = rows[:, :most]
        rows = rows[np.isfinite(rows).all(axis=1)]
        if not len(rows):
            raise self._parts.refuse(
                "betas",
                got="NaN or infinity",
                expected="finite numbers",
                fix="Pass betas=[0,0,0] or the true ones.",
            )
        if np.ptp(rows, axis=0).max(initial=0) <= _SAME_BODY:
            return rows[0]
        how = str(self._choices.betas_from)
        self._say(
            "betas of %d frames differ by up to %.2g: their %s is the body; betas_from=mean, median or first",
            len(rows), np.ptp(rows, axis=0).max(), how,
        )  # fmt: skip
        if how == "first":
            return rows[0]
        return np.asarray(np.median(rows, axis=0) if how == "median" else rows.mean(axis=0))

    def _without_gaps(
        self, rotations: np.ndarray, translation: np.ndarray, times: np.ndarray, fps: float, rows: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Every frame from the first seen to the last, as the options say, and what was done about it."""
        steps = np.diff(times)
        missing, longest = int((steps - 1).sum()), int(steps.max(initial=1) - 1)
        outside = rows - len(times) - (missing if "frames" not in self._parts else 0)
        if outside > 0 and "frames" not in self._parts:
            self._say("%d frames at the ends are NaN and left out", outside)
        if not missing:
            return rotations, translation
        if self._choices.gaps == "drop":
            self._say("%d missing frames are left out, so that the motion jumps there", missing)
            return rotations, translation
        if longest > self._choices.longest_gap * fps:
            at = int(times[steps.argmax()])
            raise InputError(
                f"{self._file.path}: frames",
                got=f"{longest} frames missing ({longest / fps:.3g} s) after frame {at}",
                expected=f"gaps of at most longest_gap={self._choices.longest_gap:g} s",
                fix=f"Pass longest_gap={np.ceil(100 * longest / fps) / 100:g} to fill it, or gaps=drop.",
            )  # fmt: skip
        self._say(
            "%d missing frames are interpolated, at most %d in a row; gaps=drop leaves them out",
            missing,
            longest,
        )
        filled, (path,) = fill_gaps(rotations, [translation], times)
        return filled, path

    def _up(self, rotations: np.ndarray) -> Any:
        """Upward axis: as asked for, of a camera, of the tool's world, or how the body stands."""
        if self._choices.up:
            return self._choices.up
        if self._body.space == "camera" and self._camera is None:
            _log.info("%s: camera axes, +y down: turned upright; up= for another axis", self._file.path.name)
            return "-y"
        amass = {self._parts.key(part) for part in ("trans", *RATES) if part in self._parts} & _OF_AMASS
        if self._tool is None and (amass or "trans" not in self._parts):
            return "+z"
        if self._tool and self._tool.up:
            return self._tool.up
        upward = Rotation.from_rotvec(rotations[:, 0]).apply([0, 1, 0]).mean(axis=0)
        axis = 1 + int(np.abs(upward[1:]).argmax())
        sign = "+" if upward[axis] > 0 else "-"
        found = f"{sign}{'xyz'[axis]}" if abs(upward[axis]) > _STANDS else "+y"
        self._say(
            "the file does not say its axes: %s is taken for up, as the body stands; up= for another", found
        )
        return found
