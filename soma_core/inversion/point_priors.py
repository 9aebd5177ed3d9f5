"""What is known of a person's joints when only points are seen: where they rest, and how far they turn."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from soma_core.geometry.rotations import axis_angle_to_matrix

__all__ = ["JOINTS", "JointPrior", "JointRange"]


@dataclass(frozen=True, kw_only=True)
class JointRange:
    """How a joint is expected to turn from the T-pose.

    Attributes:
        rest: rotation vector [degrees] that it is expected at, in the axes of the world at T-pose.
        axis: of the first of the three spreads, in the same axes: what a hinge turns about.
        spread: standard deviations [degrees] about `axis`, and about every axis across it.
        pace: usual angular acceleration [rad/s^2] in a motion.
        flexes: whether the joint is a hinge that bends the limb towards positive angles about `axis`.
        posture: how far a trunk is off the T-pose at rest differs between people and makers of motions.
            ``tells``: the mean turn in a motion says what share of `rest` it has; ``follows``: the joint then
            has the same share of its own.
    """

    rest: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    spread: tuple[float, float] = (20.0, 20.0)
    pace: float = 20.0
    flexes: bool = False
    posture: Literal["", "tells", "follows"] = ""


def _joints() -> dict[str, JointRange]:
    """Pattern -> range of the left side and the middle."""
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    return {
        r"Spine1": JointRange(rest=(5, 0, 0), axis=y, spread=(6, 10), pace=8, posture="tells"),
        r"Spine2": JointRange(rest=(-3, 0, 0), axis=y, spread=(6, 8), pace=6, posture="tells"),
        r"Chest": JointRange(rest=(13, 0, 0), axis=y, spread=(8, 9), pace=8, posture="tells"),
        r"Neck1": JointRange(axis=y, spread=(10, 10), pace=10),
        r"Neck2": JointRange(rest=(-4, 0, 0), axis=y, spread=(10, 6), pace=8),
        r"Head": JointRange(rest=(-9, 0, 0), axis=y, spread=(15, 10), pace=12),
        r"Jaw": JointRange(axis=x, spread=(6, 3)),
        r"LeftEye": JointRange(rest=(-11, -4, 0), axis=x, spread=(6, 6)),
        r"LeftShoulder": JointRange(rest=(12, -8, -6), axis=x, spread=(8, 10), pace=14, posture="follows"),
        r"LeftArm": JointRange(rest=(0, -12, -55), axis=x, spread=(20, 40), pace=25),
        r"LeftForeArm": JointRange(rest=(0, -45, 0), axis=(0, -1, 0), spread=(40, 3), flexes=True),
        r"LeftHand": JointRange(rest=(-8, -7, 4), axis=x, spread=(30, 20)),
        r"LeftHand(Index|Middle|Ring|Pinky)1": JointRange(axis=z, spread=(4, 4)),
        r"LeftHand(Index|Middle|Ring|Pinky)2": JointRange(rest=(0, 0, -20), axis=z, spread=(30, 8)),
        r"LeftHand(Index|Middle|Ring|Pinky)3": JointRange(rest=(0, 0, -20), axis=z, spread=(30, 4)),
        r"LeftHand(Index|Middle|Ring|Pinky)4": JointRange(rest=(0, 0, -13), axis=z, spread=(30, 4)),
        r"LeftHandThumb\d": JointRange(rest=(2, 6, -5), axis=x, spread=(15, 20)),
        r"LeftLeg": JointRange(rest=(-16, 6, 6), axis=y, spread=(12, 30), pace=25),
        r"LeftShin": JointRange(rest=(32, 0, 0), axis=x, spread=(35, 3), pace=40, flexes=True),
        r"LeftFoot": JointRange(rest=(-10, 3, -4), axis=y, spread=(10, 15), pace=45),
        r"LeftToeBase": JointRange(rest=(-4, -2, 2), axis=x, spread=(12, 3), pace=30),
    }


JOINTS: Mapping[str, JointRange] = _joints()
"""Ranges by a pattern of the joint's name; the right side mirrors the left."""


@dataclass(frozen=True, kw_only=True)
class JointPrior:
    """Expected turns of all joints.

    Attributes:
        ranges: joint name or pattern -> range; the first that fits counts.
        mirrored: also for ``Right...`` what ``Left...`` says, mirrored.
    """

    ranges: Mapping[str, JointRange] = field(default_factory=lambda: JOINTS)

    def range_of(self, name: str) -> JointRange | None:
        """Range of a joint."""
        for pattern, found in self.ranges.items():
            if re.fullmatch(pattern, name):
                return found
        if not name.startswith("Right"):
            return None
        left = self.range_of("Left" + name.removeprefix("Right"))
        return None if left is None else _mirrored(left)

    def of(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Rest rotations (J, 3, 3), and matrices L (J, 3, 3) of the pull [1/rad^2].

        A turn by a small angle w from the rest costs ``w^T (tr(L) I - L) w``, which is the inverse of the
        squared spread about each axis.
        """
        import torch

        rest, pull = np.tile(np.eye(3), (len(names), 1, 1)), np.zeros((len(names), 3, 3))
        for row, name in enumerate(names):
            found = self.range_of(name)
            if found is None:
                continue
            vector = torch.tensor(np.radians(found.rest))
            rest[row] = axis_angle_to_matrix(vector).numpy()
            axis = np.asarray(found.axis, float) / np.linalg.norm(found.axis)
            about, across = 1 / np.radians(found.spread) ** 2
            along = max(across - about / 2, 0)
            pull[row] = along * np.outer(axis, axis) + about / 2 * (np.eye(3) - np.outer(axis, axis))
        return rest, pull

    def paces(self, names: Sequence[str]) -> np.ndarray:
        """Usual angular accelerations (J,) [rad/s^2]."""
        found = [self.range_of(name) or JointRange() for name in names]
        return np.array([one.pace for one in found])

    def postures(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Which joints (J,) tell of the posture, and which follow it."""
        found = [(self.range_of(name) or JointRange()).posture for name in names]
        return {kind: np.array(found) == kind for kind in ("tells", "follows")}

    def hinges(self, names: Sequence[str]) -> dict[int, np.ndarray]:
        """Joint -> unit axis about which it bends the limb."""
        found = {row: self.range_of(name) for row, name in enumerate(names)}
        return {
            row: np.asarray(one.axis, float) / np.linalg.norm(one.axis)
            for row, one in found.items() if one is not None and one.flexes
        }  # fmt: skip


def _mirrored(left: JointRange) -> JointRange:
    """The range of the other side: turns mirror as axial vectors, x stays, y and z change their sign."""
    flip = np.array([1.0, -1.0, -1.0])
    rest, axis = (tuple((flip * np.array(one)).tolist()) for one in (left.rest, left.axis))
    return replace(left, rest=rest, axis=axis)
