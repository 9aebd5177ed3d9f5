"""Another skeleton in metres and upright: its size, its axes, and its spine and neck."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from soma_core.errors import InputError
from soma_core.io.skeleton_motion import SkeletonMotion
from soma_core.topology.frames import METRES, METRIC

__all__ = ["Placed", "chains", "legs_and_trunk", "likely_unit", "placed", "tail", "unit_vector"]

_log = logging.getLogger(__name__)

_UNITS = (
    *((name, METRES[name], 0.55, 1.4) for name in METRIC),
    ("inch", METRES["inch"], 0.7, 1.05),
    ("ft", METRES["ft"], 0.7, 1.05),
    ("units of 56 mm, as CMU's", METRES["inch"] / 0.45, 0.7, 1.05),
    *((name, METRES[name], 0.2, 2.0) for name in METRIC),
)
"""Units and the legs, thigh and shin, that speak for them [m]; the first that fits is taken.

Children under six in centimetres have legs like adults in inches, who are more."""

_ANY_LEGS = (0.15, 2.0)
"""Legs [m] that leave a unit standing which the file tells."""

_STANDING = 0.5
"""Cosine under which legs at rest do not hang below a trunk: the pose is none of a human."""


_UPRIGHT = 0.7
"""Cosine between the mean direction of trunks and an axis that they are said to stand along."""


_AXES = {
    "+y": np.eye(3),
    "-y": np.diag([1.0, -1, -1]),
    "+z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "+x": np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]),
    "-x": np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]),
}
"""Turns that bring an upward axis to +y."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A source in metres and with +Y up.

    Attributes:
        source: the motion.
        metres: length of its unit.
        up: its upward axis as it was.
        turn: (3, 3) that brought it upright.
        standing: whether its rest pose is one of a human.
    """

    source: SkeletonMotion
    metres: float
    up: str
    turn: np.ndarray
    standing: bool


def chains(source: SkeletonMotion, match: dict[str, int]) -> tuple[list[int], list[int]]:
    """Joints of spine and neck, told by their place between Hips, shoulders and head.

    Neck1 is taken out of `match`: it is the first of the neck.
    """
    hips, first = match["Hips"], match.pop("Neck1", None)
    arms = [
        joint
        for side in ("Left", "Right")
        if (joint := match.get(f"{side}Shoulder", match.get(f"{side}Arm"))) is not None
    ]
    ways = [_way(source.parents, hips, joint) for joint in arms]
    top = match.get("Head", first)
    if top is None:
        shared = [joint for joint in (ways[0] if ways else []) if all(joint in way for way in ways)]
        return shared, []
    way = _way(source.parents, hips, top) + ([top] if top == first else [])
    if first in way:
        cut = way.index(first)
    else:
        cut = max(
            (way.index(joint) + 1 for other in ways for joint in other if joint in way), default=len(way)
        )
    return way[:cut], way[cut:]


def _way(parents: np.ndarray, above: int, joint: int) -> list[int]:
    """Joints between two of one chain, from the upper one down."""
    found: list[int] = []
    parent = int(parents[joint])
    while parent >= 0 and parent != above:
        found.append(parent)
        parent = int(parents[parent])
    return found[::-1] if parent == above else []


def tail(source: SkeletonMotion, joint: int) -> np.ndarray | None:
    """From a joint to the end of its bone at rest, where the file or its only child tells."""
    if source.ends is not None and np.isfinite(source.ends[joint]).all() and np.any(source.ends[joint]):
        return np.asarray(source.ends[joint])
    children = np.flatnonzero(source.parents == joint)
    return source.rest[children[0]] - source.rest[joint] if len(children) == 1 else None


def placed(source: SkeletonMotion, match: Mapping[str, int], *, unit: str | None, up: str | None) -> Placed:
    """Bring a source to metres and upright.

    Raises:
        InputError: a size that fits no unit.
    """
    metres = METRES[unit] if unit in METRES else _metres(source, match)  # type: ignore[index]
    legs, trunk = legs_and_trunk(source, match)
    standing = bool(np.all(legs @ trunk < -_STANDING))
    up = up or source.up
    if up is None:
        rising = trunk - legs.mean(axis=0) if standing else _mean_trunk(source, match)
        axis = int(np.abs(rising).argmax())
        up = ("+" if rising[axis] > 0 else "-") + "xyz"[axis]
    up = up if up[0] in "+-" else f"+{up}"
    turn = _AXES[up]
    if standing:
        _warn_mirrored(source, match)
    _warn_lying(source, turn @ unit_vector(_mean_trunk(source, match)), turn)
    return Placed(
        source=source.placed(turn, metres, "+y"), metres=metres, up=up, turn=turn, standing=standing
    )


def _warn_mirrored(source: SkeletonMotion, match: Mapping[str, int]) -> None:
    """Say so where toes at rest point backwards, as left and right have it."""
    rest, found = source.rest, 0.0
    _, trunk = legs_and_trunk(source, match)
    if {"LeftLeg", "RightLeg"} <= set(match):
        left = rest[match["LeftLeg"]] - rest[match["RightLeg"]]
        for foot, toe in (("LeftFoot", "LeftToeBase"), ("RightFoot", "RightToeBase")):
            if foot in match and toe in match:
                ahead = unit_vector(np.cross(left, trunk))
                found += float(ahead @ unit_vector(rest[match[toe]] - rest[match[foot]]))
    if found < -_STANDING:
        _log.warning(
            "%s: its toes point backwards, if left is left: the names of the sides are exchanged, which "
            "swap_sides=true (or mapping=FILE) mends, or it has axes of a left hand",
            source.source,
        )  # fmt: skip


def legs_and_trunk(source: SkeletonMotion, match: Mapping[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the thighs (1 or 2, 3), and from the legs to head and arms, at rest."""
    thighs = []
    for side in ("Left", "Right"):
        if f"{side}Leg" in match:
            joint, shin = match[f"{side}Leg"], match.get(f"{side}Shin")
            bone = source.rest[shin] - source.rest[joint] if shin is not None else tail(source, joint)
            thighs.append(np.zeros(3) if bone is None else unit_vector(bone))
    legs = np.array(thighs)
    tops = [source.rest[match[f"{side}Leg"]] for side in ("Left", "Right") if f"{side}Leg" in match]
    high = [source.rest[match[name]] for name in ("Head", "LeftArm", "RightArm") if name in match]
    return legs, unit_vector(np.mean(high, axis=0) - np.mean(tops, axis=0)) if high else -legs.mean(axis=0)


def _mean_trunk(source: SkeletonMotion, match: Mapping[str, int]) -> np.ndarray:
    """Where the trunk rises to on average over some frames."""
    step = max(source.frame_count // 100, 1)
    high = [match[name] for name in ("Head", "LeftArm", "RightArm") if name in match]
    low = [match[name] for name in ("LeftFoot", "RightFoot", "LeftShin", "RightShin") if name in match]
    positions = source.positions()[::step]
    begin = positions[:, low].mean(axis=1) if low else positions[:, match["Hips"]]
    end = positions[:, high].mean(axis=1) if high else positions[:, match["Hips"]]
    return np.asarray((end - begin).mean(axis=0))


def _warn_lying(source: SkeletonMotion, rising: np.ndarray, turn: np.ndarray) -> None:
    """Say so where trunks stand along another axis than the world is taken to have."""
    axis = int(np.abs(rising).argmax())
    if abs(rising[axis]) < _UPRIGHT or (axis == 1 and rising[1] > 0):
        return
    stands = turn.T @ (np.sign(rising[axis]) * np.eye(3)[axis])
    place = int(np.abs(stands).argmax())
    _log.warning(
        "%s: the body %s in most frames; if not so, pass up=%s%s",
        source.source,
        "is upside down" if axis == 1 else "lies",
        "" if stands[place] > 0 else "-",
        "xyz"[place],
    )


def unit_vector(vector: np.ndarray) -> np.ndarray:
    """The direction of a vector; zero stays zero."""
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))


def likely_unit(legs: float) -> tuple[str, float] | None:
    """Name and length [m] of the unit that a person's thigh and shin are `legs` in; None where none is."""
    fitting = ((name, metres) for name, metres, least, most in _UNITS if least <= legs * metres <= most)
    return next(fitting, None)


def _metres(source: SkeletonMotion, match: Mapping[str, int]) -> float:
    """Length of the unit, told by the legs."""
    lengths = []
    for side in ("Left", "Right"):
        joints = [match[side + part] for part in ("Leg", "Shin", "Foot") if side + part in match]
        if not joints:
            continue
        bones = np.linalg.norm(np.diff(source.rest[joints], axis=0), axis=1)
        end = tail(source, joints[-1])
        known = len(bones) == 2
        lengths.append(
            bones.sum()
            if known or end is None
            else 2 * np.linalg.norm(end)
            if not len(bones)
            else bones.sum() + np.linalg.norm(end)
        )
    legs = float(np.mean(lengths))
    if source.metres is not None and _ANY_LEGS[0] <= legs * source.metres <= _ANY_LEGS[1]:
        return source.metres
    told = likely_unit(legs)
    if told is not None:
        name, metres = told
        _log.log(
            logging.INFO if name in METRIC and source.metres is None else logging.WARNING,
            "%s: legs of %.3g are read as %s, %.2f m; unit= says another",
            source.source,
            legs,
            name,
            legs * metres,
        )
        return metres
    raise InputError(
        f"{source.source}: unit",
        got=f"legs of {legs:.3g}",
        expected=f"{_ANY_LEGS[0]} to {_ANY_LEGS[1]} m in m, cm, mm, inches or feet",
        fix="Pass unit=m, cm, mm, inch or ft.",
    )
