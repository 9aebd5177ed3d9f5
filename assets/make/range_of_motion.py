"""Make the range-of-motion clip that ships in ``assets/motions``.

The clip is written here as angles at key times, interpolated smoothly, with the feet planted by
construction: no capture data is involved. ``python -m assets.make.range_of_motion FILE`` writes it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import scipy.interpolate
from scipy.spatial.transform import Rotation

from soma_core.io.joint_order import PARENT_NAMES, USER_JOINTS
from soma_core.io.motion import Motion
from soma_core.io.motion_files import write_motion
from soma_core.rig.skeleton import Rig

__all__ = ["FPS", "SECONDS", "range_of_motion"]

FPS = 30
SECONDS = 14.0

_Keys = tuple[tuple[float, float], ...]

# Angles in degrees at times in seconds, about the axes of the T-pose world (+X the body's left, +Y up, +Z
# forward). Every channel is zero at both ends. Names without a side are written for the left and mirrored:
# about X both sides turn alike, about Y and Z in opposite senses.
_MIRRORED: dict[str, _Keys] = {
    "Shoulder.z": ((0.4, 0), (1.4, 16), (1.7, 16), (2.8, -3), (8.0, -2), (12.8, -3)),
    "Shoulder.y": ((4.7, 0), (5.7, -10), (6.1, -10), (7.0, -4), (8.2, -4), (9.0, 0)),
    "Arm.z": (
        *((0.4, 0), (1.4, 64), (1.7, 64), (2.8, -70), (4.7, -72), (5.7, 34), (6.1, 34)),
        *((6.9, -16), (8.4, -16), (9.0, -68), (12.7, -70)),
    ),
    "Arm.y": (
        (0.4, 0),
        (1.5, -14),
        (2.8, 0),
        (4.7, 0),
        (5.7, -80),
        (6.1, -80),
        (6.9, -58),
        (8.4, -58),
        (9.0, 0),
    ),
    "ForeArm.y": (
        *((0.4, 0), (1.5, -12), (2.8, -14), (3.3, -112), (3.9, -112), (4.6, -14), (5.7, -10), (6.1, -10)),
        *((6.9, -64), (8.4, -64), (9.1, -16), (12.7, -14)),
    ),
    "ForeArm.x": ((2.8, 0), (3.4, -52), (4.0, -52), (4.5, 30), (5.1, 0)),
    "Hand.x": ((2.8, 0), (3.4, -22), (4.0, -22), (4.5, 14), (5.1, 0)),
    "Hand.z": ((0.4, 0), (1.5, 14), (2.8, -6), (3.4, -16), (4.2, 0), (12.7, -4)),
}
_CENTRAL: dict[str, _Keys] = {
    # squat: the pelvis tips forward, the back follows, the neck keeps the eyes ahead
    "Hips.x": ((4.8, 0), (5.8, 26), (6.1, 26), (7.0, 0)),
    "Spine1.x": ((0.4, 0), (1.5, -4), (2.6, 0), (4.8, 0), (5.8, 7), (6.1, 7), (7.0, 0)),
    "Spine2.x": ((0.4, 0), (1.5, -5), (2.6, 0), (4.8, 0), (5.8, 8), (6.1, 8), (7.0, 0)),
    "Chest.x": ((0.4, 0), (1.5, -5), (2.6, 0), (4.8, 0), (5.8, 3), (6.1, 3), (7.0, 0)),
    "Neck1.x": ((0.4, 0), (1.5, -6), (2.6, 0), (4.8, 0), (5.8, -10), (6.1, -10), (7.0, 0)),
    "Head.x": (
        *((0.4, 0), (1.5, -10), (2.6, 4), (3.6, 10), (4.6, 0), (5.8, -12), (6.1, -12), (7.0, 0)),
        *((12.4, 0), (12.75, 16), (13.1, 0)),
    ),
    # torso twist to the left, then to the right; the head leads
    "Spine1.y": ((6.8, 0), (7.35, 10), (7.5, 10), (8.25, -10), (8.4, -10), (9.0, 0)),
    "Spine2.y": ((6.8, 0), (7.38, 13), (7.5, 13), (8.28, -13), (8.4, -13), (9.0, 0)),
    "Chest.y": ((6.8, 0), (7.4, 15), (7.5, 15), (8.3, -15), (8.4, -15), (9.0, 0)),
    "Neck2.y": (
        *((6.7, 0), (7.25, 14), (7.5, 14), (8.15, -14), (8.4, -14), (9.0, 0)),
        *((11.4, 0), (11.8, 24), (12.2, -24), (12.6, 0)),
    ),
    "Head.y": (
        *((6.7, 0), (7.25, 20), (7.5, 20), (8.15, -20), (8.4, -20), (9.0, 0)),
        *((11.4, 0), (11.8, 34), (12.2, -34), (12.6, 0)),
    ),
    # side bend to the left with the right arm overhead, and back
    "Spine1.z": ((8.9, 0), (9.7, -9), (9.85, -9), (10.5, 0)),
    "Spine2.z": ((8.9, 0), (9.7, -11), (9.85, -11), (10.5, 0)),
    "Chest.z": ((8.9, 0), (9.7, -12), (9.85, -12), (10.5, 0)),
    "Neck1.z": ((8.9, 0), (9.7, -7), (9.85, -7), (10.5, 0)),
    "Head.z": ((8.9, 0), (9.7, -8), (9.85, -8), (10.5, 0)),
    "RightShoulder.z": ((8.9, 0), (9.7, -18), (9.85, -18), (10.5, 0)),
    "RightArm.z": ((8.9, 0), (9.7, -136), (9.85, -136), (10.5, 0)),
    "RightForeArm.z": ((8.9, 0), (9.7, -22), (9.85, -22), (10.5, 0)),
    # knee lifts: the weight goes over the standing foot first, the opposite arm swings forward
    "LeftLeg.z": ((9.9, 0), (10.4, 6), (11.0, 6), (11.4, -6), (12.0, -6), (12.5, 0)),
    "RightLeg.z": ((9.9, 0), (10.4, 6), (11.0, 6), (11.4, -6), (12.0, -6), (12.5, 0)),
    "LeftLeg.x": ((4.8, 0), (5.8, -84), (6.1, -84), (7.0, 0), (10.3, 0), (10.75, -86), (11.2, 0)),
    "LeftShin.x": ((4.8, 0), (5.8, 85), (6.1, 85), (7.0, 0), (10.3, 0), (10.75, 92), (11.2, 0)),
    "RightLeg.x": ((4.8, 0), (5.8, -84), (6.1, -84), (7.0, 0), (11.3, 0), (11.75, -86), (12.2, 0)),
    "RightShin.x": ((4.8, 0), (5.8, 85), (6.1, 85), (7.0, 0), (11.3, 0), (11.75, 92), (12.2, 0)),
    "LeftArm.x": ((10.2, 0), (10.75, 14), (11.25, 0), (11.75, -30), (12.3, 0)),
    "RightArm.x": ((10.2, 0), (10.75, -30), (11.25, 0), (11.75, 14), (12.3, 0)),
    "RightForeArm.y": ((10.2, 0), (10.75, 45), (11.25, 0)),
    "LeftForeArm.y": ((11.2, 0), (11.75, -45), (12.3, 0)),
    "LeftFoot.x": ((10.3, 0), (10.75, 22), (11.2, 0)),
    "RightFoot.x": ((11.3, 0), (11.75, 22), (12.2, 0)),
    "Jaw.x": ((1.0, 0), (1.6, 9), (2.4, 0)),
}
# One where the sole stays parallel to the ground whatever the leg does.
_PLANTED: dict[str, _Keys] = {
    "Left": ((10.3, 1), (10.75, 0), (11.2, 1)),
    "Right": ((11.3, 1), (11.75, 0), (12.2, 1)),
}
_STANCE_CHANGE = 11.25
"""Second at which the anchor passes from the right foot to the left; both are planted then."""

# How far the hand is closed (1 is a fist) and the fingers are spread (1 is wide).
_CURL: _Keys = (
    *((0.4, 0), (1.4, 0), (2.7, 0.22), (3.0, 0.25), (3.5, 1), (4.0, 1), (4.7, 0.2), (5.8, 0.08)),
    *((6.9, 0.75), (8.4, 0.75), (9.2, 0.25), (12.7, 0.22)),
)
_SPREAD: _Keys = ((0.4, 0), (1.2, 1), (1.8, 1), (2.6, 0))
_CURL_DEGREES = {"1": -3.0, "2": -74.0, "3": -88.0, "4": -52.0}
_SPREAD_DEGREES = {"Index": -9.0, "Middle": -2.0, "Ring": 6.0, "Pinky": 13.0}
_THUMB_DEGREES = {"1.z": -12.0, "1.y": 12.0, "2.y": 28.0, "3.y": 48.0}


def _curve(keys: _Keys, times: np.ndarray, ends: float = 0.0) -> np.ndarray:
    """Smooth values at `times`, at rest at both ends; monotone between keys, so that no limit is overshot."""
    knots = {0.0: ends} | dict(keys) | {SECONDS - 0.3: ends, SECONDS: ends}
    where = np.array(sorted(knots))
    values = np.array([knots[time] for time in where])
    return scipy.interpolate.PchipInterpolator(where, values)(times)


def _channels(times: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """Angles in degrees: joint -> axis -> values over time."""
    found: dict[str, dict[str, np.ndarray]] = {}

    def add(channel: str, values: np.ndarray) -> None:
        joint, axis = channel.split(".")
        axes = found.setdefault(joint, {})
        axes[axis] = axes.get(axis, 0) + values

    def add_both(channel: str, values: np.ndarray) -> None:
        add(f"Left{channel}", values)
        add(f"Right{channel}", values if channel.endswith("x") else -values)

    for channel, keys in _MIRRORED.items():
        add_both(channel, _curve(keys, times))
    for channel, keys in _CENTRAL.items():
        add(channel, _curve(keys, times))
    curl, spread = _curve(_CURL, times), _curve(_SPREAD, times)
    for finger, wide in _SPREAD_DEGREES.items():
        add_both(f"Hand{finger}2.y", wide * spread)
        for joint, closed in _CURL_DEGREES.items():
            add_both(f"Hand{finger}{joint}.z", closed * curl)
    for part, closed in _THUMB_DEGREES.items():
        add_both(f"HandThumb{part}", closed * curl)
    return found


def _rotations(times: np.ndarray) -> np.ndarray:
    """T-pose-relative rotations (frames, 77, 3, 3) float64: first about X, then Z, then Y."""
    rotations = np.tile(np.eye(3), (len(times), len(USER_JOINTS), 1, 1))
    for joint, axes in _channels(times).items():
        angles = np.stack([axes.get(axis, np.zeros(len(times))) for axis in "xzy"], axis=1)
        rotations[:, USER_JOINTS.index(joint)] = Rotation.from_euler("xzy", angles, degrees=True).as_matrix()
    for side, keys in _PLANTED.items():
        _level_sole(rotations, side, _curve(keys, times, ends=1.0))
    return rotations


def _level_sole(rotations: np.ndarray, side: str, amount: np.ndarray) -> None:
    """Turn the ankle so that it undoes what the leg does above it, as far as `amount` says."""
    leg, shin, foot = (USER_JOINTS.index(side + part) for part in ("Leg", "Shin", "Foot"))
    above = Rotation.from_matrix(rotations[:, 0] @ rotations[:, leg] @ rotations[:, shin])
    undo = Rotation.from_rotvec(-above.as_rotvec() * amount[:, None])
    rotations[:, foot] = undo.as_matrix() @ rotations[:, foot]


def _ankles(rig: Rig, rotations: np.ndarray) -> np.ndarray:
    """Positions of the left and right ankle relative to Hips [m], (2, frames, 3)."""
    positions = dict(zip(rig.joint_names, rig.t_pose_world[:, :3, 3], strict=True))
    found = []
    for side in ("Left", "Right"):
        turn, place, parent = rotations[:, 0], np.zeros((len(rotations), 3)), "Hips"
        for name in (side + part for part in ("Leg", "Shin", "Foot")):
            assert PARENT_NAMES[name] == parent
            place = place + turn @ (positions[name] - positions[parent])
            turn, parent = turn @ rotations[:, USER_JOINTS.index(name)], name
        found.append(place)
    return np.stack(found)


def _sole_height(rig: Rig) -> float:
    """Height of the lowest vertex of the template in the T-pose [m]."""
    matrices = rig.t_pose_world @ np.linalg.inv(rig.bind_world)
    rest = np.concatenate([rig.bind_shape, np.ones((len(rig.bind_shape), 1))], axis=1)
    heights = rig.weights * (rest @ matrices[:, 1].T)
    return float(np.asarray(heights.sum(axis=1)).min())


def range_of_motion(rig: Rig) -> Motion:
    """Make the clip for the canonical `rig`: deterministic, 30 fps, T-pose at both ends, sole on y = 0.

    The Hips follow from the legs: the standing ankle keeps its place, and the standing foot its angle.
    """
    times = np.arange(round(SECONDS * FPS) + 1) / FPS
    rotations = _rotations(times)
    left, right = _ankles(rig, rotations)
    standing = np.where((times < _STANCE_CHANGE)[:, None], right - right[0], left - left[0])
    hips = rig.t_pose_world[rig.joint_names.index("Hips"), :3, 3] - [0, _sole_height(rig), 0]
    return Motion(
        rotations=rotations,
        translation=hips - standing,
        fps=FPS,
        joint_names=USER_JOINTS,
        rig_revision=rig.revision,
        # Part of the shipped bytes: where this module was when the clip was made.
        source="SOMA Core range of motion, made by soma_core.tasks.range_of_motion",
        licence="Apache-2.0",
    )


def main(path: str) -> None:
    """Write the clip for the shipped rig to `path`."""
    from soma_core.rig.canonical import load_canonical

    write_motion(range_of_motion(load_canonical()[1]), Path(path), rotation_repr="rotvec")


if __name__ == "__main__":
    main(*sys.argv[1:])
