"""Questions to what was read: what no body does, and the setting that mends it. None of them ends a run."""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.inversion.diagnosis import leaning
from soma_core.io.amass import SmplMotion
from soma_core.io.motion import Motion
from soma_core.io.rotation_vectors import degrees_doubt
from soma_core.io.vertex_sequence import UpAxis
from soma_core.motion.movement import of_movement
from soma_core.motion.options import SIGNED, ConvertOptions
from soma_core.motion.posed_input import world_axes
from soma_core.motion.source_skeleton import likely_unit
from soma_core.plugin.spec import BackendSpec, Unit
from soma_core.rig import load_canonical
from soma_core.topology.frames import METRES

__all__ = [
    "Names",
    "heard",
    "of_motion",
    "of_params",
    "of_path",
    "of_rate",
    "of_smpl",
    "say",
    "unused_settings",
]

_log = logging.getLogger(__name__)

_RATES = (2.0, 2000.0)
"""Frame rates [1/s] of what moves: slow videos of a webcam, fast cameras; below 1/5 lies a frame time."""

_FRAME_TIME = 0.2
"""Longest time between frames of what is called a motion [s]."""

_HIGH = 10.0
"""Lowest height of the hips in a clip [m]: stairs, trees and trampolines begin on the ground. Along the
ground a person may be anywhere."""

_LOW, _NEAR = (0.0002, 0.02), 0.05
"""Heights of hips [m] as they are in another unit, metres taken for millimetres or centimetres, and how far a
body then is from the origin at most. A body that lies has its hips at 0.08 m; one that is kept at the origin,
or measured from its first frame, has exact zeros or goes below."""

_HIPS = (0.05, 1.5)
"""Lowest heights of hips in a clip [m]: from a newborn that lies to a giant who stands."""

_ADULT = (0.75, 1.2)
"""Heights of an adult's hips [m], where a child's in centimetres are an adult's in inches."""

_SPAN, _LEAP, _USUAL = 0.5, 10.0, 12.5
"""Half a second [s], how far nobody gets in it or in less [m], and the speed of the best sprinters [m/s]."""

_AT_ONCE, _FEW = 0.6, 5
"""Share of that way in one step that makes it a leap, as from one recording to the next, and the frames of a
clip in which that can be told."""

_STEP, _FASTEST = 3.0, 40.0
"""A step from one frame to the next that is a leap, however slow the rest is [m], and its speed [m/s]."""

_STILL = 0.002
"""Speed [m/s] below which hips do not stay, of a person who stands; 0 is that of a single pose."""

_SMALLER: tuple[Unit, ...] = ("cm", "mm")

_LEGS = (0.1, 1.5)
"""Thigh and shin together [m]: 0.15 of a newborn, 1.2 of the tallest."""

_ONE_BODY = 0.5
"""How far the coefficients of one body may differ from frame to frame, in standard deviations."""

_FAR = 0.5
"""How far beyond its range a parameter is questioned, in widths of it: from 6 for coefficients in -3 to 3."""


@dataclass(frozen=True, kw_only=True)
class Names:
    """What the settings are called that mend a reading; empty where there is none.

    `turns` are those of its rotations, and `to` the command that has them, where it is another.
    """

    unit: str = "unit"
    fps: str = "fps"
    ups: Collection[str] = field(default_factory=lambda: tuple(SIGNED))
    turns: Collection[str] = ()
    to: str = ""


def say(source: str, doubts: Collection[str]) -> None:
    """Warn of what is doubtful about a file."""
    for doubt in doubts:
        _log.warning("%s: %s", source, doubt)


@contextmanager
def heard() -> Iterator[list[str]]:
    """Collect what this package warns of in this thread, for a report; handlers get it as before."""
    said: list[str] = []
    handler = logging.Handler(logging.WARNING)
    here = threading.get_ident()

    def note(record: logging.LogRecord) -> None:
        if record.thread == here and record.getMessage() not in said:
            said.append(record.getMessage())

    handler.emit = note  # type: ignore[method-assign]
    logger = logging.getLogger("soma_core")
    logger.addHandler(handler)
    try:
        yield said
    finally:
        logger.removeHandler(handler)


def of_smpl(motion: SmplMotion) -> list[str]:
    """What is doubtful about a motion of the SMPL family: its angles, axes, lengths, speed and frame rate."""
    degrees, face = degrees_doubt(motion.rotations), _of_face(motion.expression)
    if degrees:
        return [degrees, *of_rate(motion.fps), *face]  # where the body points is not known
    upward = Rotation.from_rotvec(motion.rotations[:, 0]).apply([0, 1, 0])
    lies = _of_axes(upward, motion.up, Names().ups)
    path = lies or of_path(motion.translation, motion.fps, up=motion.up, what="trans")
    return of_rate(motion.fps) + path + face


def _of_face(expression: np.ndarray | None) -> list[str]:
    """What becomes of the coefficients of a face."""
    if expression is None:
        return []
    return [
        f"its expressions, {expression.shape[1]} coefficients, are left out: this skeleton has a jaw alone; "
        "a fitted motion.npz keeps them for to=smplx"
    ]


def of_motion(motion: Motion, names: Names | None = None) -> list[str]:
    """The same about a motion on this skeleton, and the lengths of its legs where the file tells them."""
    names = names or Names(ups=())
    hips = motion.rotations[:, 0].astype(np.float64)
    if motion.convention == "absolute_local":
        hips = hips @ load_canonical("mid")[1].t_pose_world[1, :3, :3].T
    lies = _of_axes(hips[:, :, 1], "+y", names.ups)
    path = of_path(motion.translation, motion.fps, up="+y", what="the path of the Hips", names=names)
    legs = _of_legs(motion, names)
    moves = of_movement(
        motion, unit=names.unit, fps=names.fps, turns=names.turns, to=names.to,
        path=not (lies or legs), told=[] if lies else path,
    )  # fmt: skip
    return of_rate(motion.fps, names) + _of_persons(motion) + legs + (lies + moves)


def of_rate(fps: float, names: Names | None = None) -> list[str]:
    """What is doubtful about a frame rate: a frame time in its place, or in another unit."""
    name = (names or Names()).fps
    if fps <= _FRAME_TIME:
        return [
            f"{fps:.4g} frames a second would be one in {1 / fps:.3g} s; if that is a frame time, "
            f"pass {name}={1 / fps:.6g}"
        ]
    if fps > _RATES[1]:
        return [f"{fps:g} frames a second are more than cameras take; pass {name}=30 (the true rate)"]
    return []


def _of_axes(upward: np.ndarray, up: UpAxis, ups: Collection[str]) -> list[str]:
    """Whether a body lies or stands on its head on the whole, by its upward directions (frames, 3)."""
    axes = world_axes(up)
    found = leaning(upward @ axes.T, axes)
    if found is None:
        return []
    mend = (
        f"pass up={found.along}" if found.along in ups else "the world of the file has not +y up, as it must"
    )
    return [f"{found.sentence}; if that is not its pose, {mend}"]


def of_path(
    places: np.ndarray, fps: float, *, up: UpAxis, what: str, names: Names | None = None
) -> list[str]:
    """What is doubtful about where a body is, and how fast it moves.

    Args:
        places: (frames, 3) of the hips [m].
        fps: frames per second.
        up: upward axis.
        what: whose places these are.
        names: of the settings that mend it.
    """
    names, places = names or Names(), np.asarray(places, np.float64)
    height = (places @ world_axes(up).T)[:, 1]
    lowest, furthest = float(np.abs(height).min()), float(np.linalg.norm(places, axis=1).max())
    if _LOW[0] < height.min() and height.max() < _LOW[1] and furthest < _NEAR:
        return [
            f"{what} puts the hips {1e3 * float(np.median(height)):.3g} mm above the ground, where none are; "
            f"pass {names.unit}=m, cm or mm as they are stored, unless they were divided twice"
        ]
    told, units = [], []
    if lowest > _HIGH and (height.min() > 0 or height.max() < 0):
        units = _units_of_height(lowest, _pace(places, fps))
        side = "above" if height[0] > 0 else "below"
        told = [f"puts the body {lowest:.4g} m or more {side} the ground"] if units else []
    speed, leap = _fastest(places, fps)
    if speed and leap is None:
        told.append(f"moves it at up to {speed:,.4g} m/s")
    rate = "" if units else f", and if the frame rate is wrong, {names.fps}=30 (the true rate)"
    units = units or [unit for unit in _SMALLER if speed * METRES[unit] < _USUAL] or ["cm"]
    inches = _ADULT[0] < lowest * METRES["inch"] < _ADULT[1] and units[0] == "cm"
    also = f" (or in inches, {names.unit}=inch)" if inches else ""
    mend = f"if the lengths are in {units[0]}{also}, pass {names.unit}={units[0]}{rate}"
    found = [f"{what} {' and '.join(told)}; {mend}"] if told else []
    if leap is not None:
        cut = "if two recordings follow each other there, cut the file"
        found.append(f"{what} leaps at frame {leap}; {cut}")
    return found


def _pace(places: np.ndarray, fps: float) -> float:
    """Usual speed from frame to frame [m/s]; 0 for a single frame."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return float(np.median(steps)) * fps if len(steps) else 0.0


def _units_of_height(height: float, pace: float) -> list[Unit]:
    """Units in which a height is one of hips; none where a body would move less than a living one."""
    units = [unit for unit in _SMALLER if _HIPS[0] < height * METRES[unit] < _HIPS[1]]
    if pace == 0:
        return units or ["cm"]
    return [unit for unit in units if pace * METRES[unit] > _STILL]


def _fastest(places: np.ndarray, fps: float) -> tuple[float, int | None]:
    """Speed [m/s] over half a second that nobody reaches, or 0; and the frame of a leap that makes it so."""
    span = min(max(round(_SPAN * fps), 1), len(places) - 1)
    if span < 1:
        return 0.0, None
    lags = sorted({1, max(span // 4, 1), max(span // 2, 1), span})  # a body may swing back within the longest
    ways = {lag: np.linalg.norm(places[lag:] - places[:-lag], axis=1) for lag in lags}
    lag = max(lags, key=lambda each: float(ways[each].max()))
    far, leap = float(ways[lag].max()), int(ways[1].argmax()) + 1
    step = float(ways[1].max())
    if far <= _LEAP and step > _STEP and step * fps > _FASTEST and len(places) >= _FEW:
        return step * fps, leap
    if far <= _LEAP:
        return 0.0, None
    at_once = len(places) >= _FEW and ways[1][leap - 1] > _AT_ONCE * far
    return far * fps / lag, leap if at_once else None


def _of_persons(motion: Motion) -> list[str]:
    """Whether a file of the SOMA tools holds the bodies of several persons, a row of coefficients a frame."""
    rows = np.atleast_2d(np.asarray(motion.identity.get("identity_coeffs", 0.0), np.float64))
    if np.ptp(rows, axis=0).max() <= _ONE_BODY:
        return []
    return [
        "identity_coeffs differ from frame to frame; if it holds several persons, cut the file between them"
    ]


def _of_legs(motion: Motion, names: Names) -> list[str]:
    """Whether the legs of a file's own skeleton are those of a person."""
    skeleton = motion.skeleton
    if skeleton is None:
        return []
    bones = [f"{side}{bone}" for side in ("Left", "Right") for bone in ("Shin", "Foot")]
    lengths = np.linalg.norm([skeleton[motion.joint_names.index(name)] for name in bones], axis=1)
    legs = float(lengths.sum() / 2)
    if not np.isfinite(legs) or _LEGS[0] < legs < _LEGS[1]:
        return []
    unit = likely_unit(legs)
    name = unit[0] if unit is not None and unit[0] in METRES else "m, cm, mm, inch or ft as they are stored"
    mend = f"pass {names.unit}={name}"
    return [f"its legs are {legs:.3g} m long; if the lengths are in another unit, {mend}"]


def of_params(spec: BackendSpec, params: Mapping[str, Any], *, setting: str = "backend.params.") -> list[str]:
    """Parameters of a body far outside the ranges that its backend declares, called as `setting` has them."""
    told = []
    for parameter in spec.params:
        if parameter.name not in params:
            continue
        low, high = parameter.range
        try:
            values = np.asarray(params[parameter.name], np.float64).reshape(-1)
        except (TypeError, ValueError):
            continue  # no numbers, which the backend refuses
        beyond = np.maximum(values - high, low - values)
        if values.size and beyond.max() > _FAR * (high - low):
            worst = values[int(beyond.argmax())]
            meaning = f" ({parameter.description})" if parameter.description else ""
            told.append(
                f"{setting}{parameter.name}={worst:g} is far outside the range of {spec.name}, {low:g} to "
                f"{high:g}{meaning}; `soma backends show {spec.name}` lists all ranges"
            )
    return told


_SMPL, _KEPT = frozenset({"amass", "smpl"}), frozenset({"soma", "kimodo"})

_APPLY: dict[str, frozenset[str]] = dict.fromkeys(
    ("gender", "most_betas", "betas", "betas_from", "model", "coordinates",
     "flat_hand_mean", "gaps", "longest_gap", "carry"), _SMPL,
) | {
    "person": _SMPL | _KEPT,
    "rotation_layout": _SMPL | _KEPT,
    "swap_sides": _SMPL | _KEPT | {"skeleton"},
    "angles": _SMPL | {"soma", "skeleton"},
    "convention": frozenset({"soma"}),
    "up": _SMPL | {"sam3d", "skeleton"},
    "axes": _SMPL | {"sam3d", "skeleton"},
    "identity": frozenset({"sam3d"}),
    "mapping": frozenset({"skeleton"}),
    "root": frozenset({"skeleton"}),
    "match": _SMPL | {"skeleton"},
    "refine": _SMPL | {"skeleton"},
}  # fmt: skip
"""Settings that not every file takes, and the layouts that do."""

_LAYOUTS = _SMPL | _KEPT | {"sam3d", "skeleton"}


def unused_settings(path: Path, layout: str, options: ConvertOptions, *, refuse: bool) -> None:
    """Refuse settings that change nothing about a file of this layout, or say so.

    Args:
        path, layout: the file.
        options: all that was asked for.
        refuse: for one file; in a folder others may take a setting that this one does not.

    Raises:
        InputError: a setting that does not apply.
    """
    sought = None if options.identity.method == "known" else str(options.identity.method)
    plain = ConvertOptions()
    given: dict[str, object] = {name: getattr(options, name) for name in _APPLY}
    given["identity"] = sought and "unknown"
    for name, value in given.items():
        usual = None if name == "identity" else getattr(plain, name)
        if value == usual or layout in _APPLY[name] or layout not in _LAYOUTS:
            continue
        if refuse:
            raise InputError(
                f"{path.name}: {name}", got=value, expected=f"none: a {layout} file has no use for it",
                fix=f"Leave {name} out.",
            )  # fmt: skip
        say(path.name, [f"{name}={value} is not used: a {layout} file has no use for it"])
