"""Feet that stay where they stand: legs bent by inverse kinematics, smoothly in and out of each contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from soma_core.io.joint_order import CONTACT_JOINTS
from soma_core.io.motion import Motion
from soma_core.motion.ground import LOW, SLOW, FootTrack
from soma_core.rig.skeleton import Rig

__all__ = ["Limb", "lock_feet"]

_EASE_SECONDS = 0.2
"""How long a foot takes from its own path to a pinned one, and back."""

_STRETCH = 0.995
"""Part of its length that a leg is stretched to at most, where the motion did not stretch it further."""

_DEEPEST = 0.05
"""How far the Hips may sink so that legs reach, in heights of the body; then a foot is let slide."""

_STRAIGHT = 0.05
"""A knee that lies less far out of the leg's line than this part of the thigh counts as nearly straight."""

_UNBENT = np.radians(15)
"""Further bend [rad] over which a knee that was bent the wrong way comes round."""


def lock_feet(
    motion: Motion,
    transforms: np.ndarray,
    track: FootTrack,
    contacts: np.ndarray,
    *,
    rig: Rig,
    floor: float,
) -> Motion:
    """Pin heels and toes in contact, by the hips, knees and ankles of the legs.

    Each contact is held where it is on average, its sole on the floor if it is near. Feet between contacts
    keep their own path, and knees the side that they bend to. Where a leg does not reach, the Hips sink, and
    a foot in the air sinks with them, though not to the floor.

    Args:
        motion: rotations and path of the Hips [m] of the body that was posed.
        transforms: (frames, J, 4, 4) its world transforms [m].
        track: its feet.
        contacts: (frames, 4) in the order of ``CONTACT_JOINTS``.
        rig: the skeleton.
        floor: height of the floor [m].
    """
    pins = [
        _pin(
            track.joints[:, index], track.soles[:, index], contacts[:, index], motion.fps, track.height, floor
        )
        for index in range(len(CONTACT_JOINTS))
    ]
    goals = [_foot_goal(track.joints[:, 2 * side :], *pins[2 * side : 2 * side + 2]) for side in (0, 1)]
    legs = [
        Limb(transforms, rig, [side + part for part in ("Leg", "Shin", "Foot")]) for side in ("Left", "Right")
    ]
    drops = [leg.drop(ankle) for leg, (ankle, _) in zip(legs, goals, strict=True)]
    drop = _smooth_drop(np.maximum(*drops), motion.fps, _DEEPEST * track.height)
    rotations = motion.rotations.astype(np.float64)
    for side, (leg, (ankle, turn)) in enumerate(zip(legs, goals, strict=True)):
        held = np.maximum(pins[2 * side][1], pins[2 * side + 1][1])
        above = np.maximum(track.soles[:, 2 * side : 2 * side + 2].min(axis=1) - floor, 0)
        follows = (1 - held) * drop * above / np.maximum(above + drop, 1e-9)
        leg.lower(drop)
        leg.reach(ankle - follows[:, None] * [0, 1, 0], turn)
        leg.store(rotations, absolute=motion.convention == "absolute_local")
    path = motion.translation - drop[:, None] * [0, 1, 0]
    return replace(motion, rotations=rotations, translation=path)


def _pin(
    points: np.ndarray, soles: np.ndarray, on: np.ndarray, fps: float, height: float, floor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Way (frames, 3) [m] of a point to where it is pinned, and how much it is, (frames,) from 0 to 1."""
    frames, ease = len(points), max(round(_EASE_SECONDS * fps), 1)
    total, weight = np.zeros((frames, 3)), np.zeros(frames)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
    for start, stop in edges.reshape(-1, 2):
        run = slice(start, stop)
        target = points[run].mean(axis=0)
        level = np.median(soles[run])
        target[1] = np.median(points[run, 1] - soles[run]) + (
            floor if abs(level - floor) < LOW * height else level
        )
        change = target - points[run]
        total[run], weight[run] = change, 1.0
        for edge, inner, frame, step in ((0, 1, start, -1), (-1, -2, stop - 1, 1)):
            slope = change[edge] - change[inner] if len(change) > 1 else np.zeros(3)
            slope *= min(1.0, SLOW * height / fps / max(float(np.linalg.norm(slope)), 1e-12))
            outside = _until_contact(on, frame + step * np.arange(1, ease + 1))
            time = np.arange(1, len(outside) + 1)
            share = (1 + np.cos(np.pi * time / (ease + 1))) / 2
            total[outside] += share[:, None] * (change[edge] + slope * time[:, None])
            weight[outside] += share
    scale = np.maximum(weight, 1e-12)
    return total / scale[:, None], np.minimum(weight, 1.0)


def _until_contact(on: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Of consecutive frames, those inside the clip and before the next contact."""
    inside = frames[(frames >= 0) & (frames < len(on))]
    return inside[: int(np.argmax(on[inside])) if on[inside].any() else None]


def _foot_goal(
    joints: np.ndarray, heel: tuple[np.ndarray, np.ndarray], toe: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Where an ankle goes (frames, 3) [m], and the turn of its foot in the world (frames, 3, 3).

    A foot that is pinned at one end moves as a whole; pinned at both it is turned to meet both directions,
    and what its length leaves over is shared.
    """
    ankle, ball = joints[:, 0], joints[:, 1]
    (heel_way, heel_held), (toe_way, toe_held) = ((way, held[:, None]) for way, held in (heel, toe))
    there = ankle + heel_held * heel_way + (1 - heel_held) * toe_held * toe_way
    ahead = ball + toe_held * toe_way + (1 - toe_held) * heel_held * heel_way
    turn = _shortest_arc(ball - ankle, ahead - there)
    half = (turn @ (ball - ankle)[..., None])[..., 0] / 2
    return (there + ahead) / 2 - half, turn


class Limb:
    """One leg or arm of a posed body, frame by frame; world rotations and places in float64.

    Hip, knee and ankle of an arm are its shoulder, elbow and wrist.

    Args:
        transforms: (frames, J, 4, 4) of the body.
        rig: the canonical rig.
        joints: names of the three joints.
    """

    def __init__(self, transforms: np.ndarray, rig: Rig, joints: Sequence[str]) -> None:
        self.rig = rig
        self.joints = [rig.joint_names.index(name) for name in joints]
        arm = {"LeftArm": [0.0, 1, 0], "RightArm": [0.0, -1, 0]}
        self.bends_about = np.array(arm.get(joints[0], [-1.0, 0, 0]))  # in the T-pose +x is the body's left
        self.hips = transforms[:, rig.parents[self.joints[0]], :3, :3].astype(np.float64)
        moved = transforms[:, self.joints].astype(np.float64)
        self.turned = [moved[:, index, :3, :3] for index in range(3)]
        self.hip, self.knee, self.ankle = (moved[:, index, :3, 3] for index in range(3))
        self.thigh = np.linalg.norm(self.knee - self.hip, axis=1)
        self.shin = np.linalg.norm(self.ankle - self.knee, axis=1)
        own = np.linalg.norm(self.ankle - self.hip, axis=1)
        self.longest = np.maximum(_STRETCH * (self.thigh + self.shin), own)

    def drop(self, ankle: np.ndarray) -> np.ndarray:
        """How far the hip must sink (frames,) [m] for the ankle to get there."""
        way = ankle - self.hip
        level = way[:, 0] ** 2 + way[:, 2] ** 2
        reach = np.sqrt(np.maximum(self.longest**2 - level, 0))
        return np.maximum(-way[:, 1] - reach, 0)

    def lower(self, drop: np.ndarray) -> None:
        """Let the leg sink as it is."""
        sunk = drop[:, None] * [0, 1, 0]
        self.hip, self.knee, self.ankle = self.hip - sunk, self.knee - sunk, self.ankle - sunk

    def reach(self, ankle: np.ndarray, turn: np.ndarray) -> None:
        """Bend the knee, turn the leg about the hip until the ankle is there, and turn the foot in the world.

        A knee that the motion bends the wrong way is bent back step by step with what is asked of it, so
        that it does not flip; the ankle then misses by less than a thousandth of the leg.
        """
        line, far = _unit(self.ankle - self.hip)
        way, wanted = _unit(ankle - self.hip)
        axis, side = self._hinge(line)
        own = side * self._bend(far)
        longest = np.where(side < 0, far, self.longest)
        bend = self._bend(np.clip(wanted, np.abs(self.thigh - self.shin), longest))
        more = np.clip((bend - np.abs(own)) / _UNBENT, 0, 1)
        bend -= (np.abs(own) - own) * (1 - more) ** 2 * (1 + 2 * more)
        shin = Rotation.from_rotvec((own - bend)[:, None] * axis).as_matrix()
        bent = self.knee + (shin @ (self.ankle - self.knee)[..., None])[..., 0]
        about_hip = _shortest_arc(bent - self.hip, way)
        self.turned = [about_hip @ self.turned[0], about_hip @ shin @ self.turned[1], turn @ self.turned[2]]

    def _bend(self, far: np.ndarray) -> np.ndarray:
        """Angle [rad] of the knee, zero for a straight leg, whose ends lie so far apart."""
        cosine = (far**2 - self.thigh**2 - self.shin**2) / np.maximum(2 * self.thigh * self.shin, 1e-12)
        return np.arccos(np.clip(cosine, -1, 1))

    def _hinge(self, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Axis (frames, 3) that a knee bends about, and 1 where it does, -1 where it is bent the wrong way.

        A knee that is nearly straight tells no axis; there it is the one that the thigh has in the T-pose.
        """
        rest = self.rig.t_pose_world[self.joints[0], :3, :3]
        across = (self.turned[0] @ rest.T) @ self.bends_about
        across = _unit(across - (across * line).sum(axis=1, keepdims=True) * line)[0]
        plane = np.cross(line, self.knee - self.hip)
        side = np.where((plane * across).sum(axis=1) < 0, -1.0, 1.0)
        missing = np.clip(_STRAIGHT * self.thigh - np.linalg.norm(plane, axis=1), 0, None)
        return _unit(side[:, None] * plane + missing[:, None] * across)[0], side

    def store(self, rotations: np.ndarray, *, absolute: bool) -> None:
        """Write the local rotations of the limb into those of a motion (frames, 77, 3, 3)."""
        parent = self.hips
        for joint, world in zip(self.joints, self.turned, strict=True):
            local = np.swapaxes(parent, -1, -2) @ world
            if not absolute:
                above = self.rig.t_pose_world[self.rig.parents[joint], :3, :3]
                local = above @ local @ self.rig.t_pose_world[joint, :3, :3].T
            rotations[:, joint - 1] = local
            parent = world


def _smooth_drop(needed: np.ndarray, fps: float, deepest: float) -> np.ndarray:
    """A smooth way of the Hips (frames,) [m] that is nowhere above what is needed, up to the deepest."""
    reach = max(round(_EASE_SECONDS * fps), 1)
    held = maximum_filter1d(np.minimum(needed, deepest), 2 * reach + 1, mode="nearest")
    return gaussian_filter1d(held, reach / 2, mode="nearest", truncate=2.0)


def _unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) and lengths (n,)."""
    lengths = np.linalg.norm(vectors, axis=1)
    return vectors / np.maximum(lengths, 1e-12)[:, None], lengths


def _shortest_arc(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Smallest rotations (n, 3, 3) that turn directions (n, 3) into others."""
    (source, _), (target, _) = _unit(source), _unit(target)
    cosine = (source * target).sum(axis=1)
    quaternions = np.concatenate([np.cross(source, target), 1 + cosine[:, None]], axis=1)
    quaternions[np.linalg.norm(quaternions, axis=1) < 1e-9] = [1, 0, 0, 0]
    return Rotation.from_quat(quaternions).as_matrix()
