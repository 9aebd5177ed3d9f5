"""The rest pose of another skeleton against the T-pose of this one: a turn for each joint."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.io.joint_order import PARENT_NAMES, USER_JOINTS
from soma_core.motion.source_skeleton import Placed, legs_and_trunk, tail, unit_vector
from soma_core.rig.skeleton import Rig

__all__ = ["Alignment", "align", "own_alignment"]

_BENT = 0.1
"""Mean sine of the bend of a knee or elbow that tells its axis."""

_LOW = 0.5
"""Share of frames whose toes are lowest, and of these the share that moves least: there a foot stands."""

_STEADY, _SLOPES = np.radians(8), np.radians((2, 50))
"""Spread of the middle half of those frames, and slopes from ankle to toes, of a foot that stands flat."""

_CLOSE = np.cos(np.radians(15))
_SAME_POSE = np.cos(np.radians(5))

_NEXT = {
    "Shoulder": "Arm",
    "Arm": "ForeArm",
    "ForeArm": "Hand",
    "Leg": "Shin",
    "Shin": "Foot",
    "Foot": "ToeBase",
}
_KNUCKLES = ("Middle2", "Index2", "Ring2", "Pinky2")


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Turns (3, 3) that bring the T-pose of this skeleton to the rest pose of another.

    Attributes:
        turns: by the names of joints here; spine and neck by their joint there.
        along: joint of spine or neck there -> its turn.
        kind: of the other's rest pose, in words.
        slopes: foot -> angle [degrees] by which its line from ankle to toes is left off the other's, for the
            sake of the sole.
    """

    turns: Mapping[str, np.ndarray]
    along: Mapping[int, np.ndarray]
    kind: str
    slopes: Mapping[str, float] = field(default_factory=dict)

    def chain(self, joints: Sequence[int]) -> list[np.ndarray]:
        """Turns of the joints of spine or neck."""
        return [self.along[joint] for joint in joints]


def own_alignment(
    found: Placed, match: Mapping[str, int], spine: Sequence[int], neck: Sequence[int], rig: Rig
) -> Alignment | None:
    """Turns of a file under this skeleton's own names: its rest pose is one of three that are known exactly.

    None where it is another: bones are then matched as for any skeleton.
    """
    source = found.source
    joints = {name: place for place, name in enumerate(source.names) if name in USER_JOINTS}
    orient, bind = rig.t_pose_world[:, :3, :3], rig.bind_world[:, :3, :3]
    back = np.swapaxes(orient, -1, -2)
    poses = {
        "T-pose": np.broadcast_to(np.eye(3), orient.shape),
        "bind pose": bind @ back,
        "axes of the joints": found.turn @ back,
    }
    index = {name: place for place, name in enumerate(rig.joint_names)}
    bones = [(name, above) for name in joints if (above := PARENT_NAMES[name]) in joints]
    at = np.array([[joints[name], joints[above]] for name, above in bones]).reshape(-1, 2)
    there = source.rest[at[:, 0]] - source.rest[at[:, 1]]
    own = np.array([[index[name], index[above]] for name, above in bones]).reshape(-1, 2)
    here = rig.t_pose_world[own[:, 0], :3, 3] - rig.t_pose_world[own[:, 1], :3, 3]
    for kind, turns in poses.items():
        cosines = [
            unit_vector(turns[above] @ bone) @ unit_vector(other)
            for (_, above), bone, other in zip(own, here, there, strict=True)
        ]
        if len(bones) and np.median(cosines) > _SAME_POSE:
            along = {joint: turns[index[source.names[joint]]] for joint in (*spine, *neck)}
            return Alignment(turns={name: turns[index[name]] for name in match}, along=along, kind=kind)
    return None


def align(
    found: Placed,
    match: Mapping[str, int],
    spine: Sequence[int],
    neck: Sequence[int],
    turns: np.ndarray,
    rest: Mapping[str, np.ndarray],
    *,
    by: str = "bones",
) -> Alignment:
    """Turns of every joint that was found, from the root down: the shortest way for each bone in turn.

    Args:
        found: the source.
        match: joints here -> joints there.
        spine: joints there.
        neck: joints there.
        turns: (frames, J, 3, 3) of the source's joints since its rest pose.
        rest: joint positions of the T-pose here [m].
        by: ``limbs``: in a human rest pose, only arms, legs and fingers are matched; ``soles``: all but the
            slope of feet.
    """
    return _Aligner(found, match, turns, rest, by=by).align(spine, neck)


class _Aligner:
    """Turns under way; arguments as for `align`."""

    def __init__(
        self,
        found: Placed,
        match: Mapping[str, int],
        turns: np.ndarray,
        rest: Mapping[str, np.ndarray],
        *,
        by: str,
    ) -> None:
        self._source, self._standing = found.source, found.standing
        self._match, self._turns, self._rest = match, turns, rest
        self._limbs, self._soles = by == "limbs" and found.standing, by == "soles"
        self._found: dict[str, np.ndarray] = {}
        self._along: dict[int, np.ndarray] = {}
        self._slopes: dict[str, float] = {}

    def align(self, spine: Sequence[int], neck: Sequence[int]) -> Alignment:
        self._found["Hips"] = self._hips(spine)
        after = [*neck[:1], *[self._match[name] for name in ("Head",) if name in self._match]][:1]
        last = self._chain(("Spine1", "Spine2", "Chest", "Neck1"), spine, after, self._match["Hips"], "Hips")
        self._found["Chest"] = self._along.get(last, self._found["Hips"])
        head = [self._match["Head"]] if "Head" in self._match else []
        self._chain(("Neck1", "Neck2", "Head"), neck, head, last, "Chest")
        for name in USER_JOINTS:
            if name in self._match and name not in self._found:
                self._found[name] = self._joint(name, last)
        kind = "standing" if self._standing else "bones along axes"
        return Alignment(turns=self._found, along=self._along, kind=kind, slopes=self._slopes)

    def _hips(self, spine: Sequence[int]) -> np.ndarray:
        """The nearest turn by quarters that puts left and up where they are at rest."""
        rest, match = self._source.rest, self._match
        legs = {side: rest[match[f"{side}Leg"]] for side in ("Left", "Right") if f"{side}Leg" in match}
        middle = legs["Left"] + legs["Right"] if len(legs) == 2 else 2 * rest[match["Hips"]]
        left = legs.get("Left", middle / 2) - legs.get("Right", middle / 2)
        thigh, trunk = legs_and_trunk(self._source, match)
        up = trunk - thigh.mean(axis=0)
        if not self._standing and spine:
            up = rest[spine[0]] - middle / 2
        left, up = unit_vector(left), unit_vector(up)
        return max(_quarter_turns(), key=lambda turn: 2 * turn[:, 0] @ left + turn[:, 1] @ up)

    def _chain(
        self, targets: tuple[str, ...], joints: Sequence[int], after: Sequence[int], above: int, start: str
    ) -> int:
        """Turns of spine or neck; returns its last joint there, or `above` where there is none."""
        here = np.array([self._rest[name] for name in targets])
        places = np.linspace(0, len(targets) - 1, len(joints) + 1)
        here = np.stack([np.interp(places, np.arange(len(targets)), column) for column in here.T], -1)
        turn = self._along.get(above, self._found[start])
        for number, joint in enumerate(joints):
            following = joints[number + 1] if number + 1 < len(joints) else next(iter(after), None)
            bone = here[number + 1] - here[number]
            there = None if following is None else self._source.rest[following] - self._source.rest[joint]
            if not self._limbs:
                turn = self._turned(turn, bone, there, above, joint, parent_turn=turn)
            self._along[joint] = turn
            above = joint
        return above

    def _turned(
        self,
        turn: np.ndarray,
        bone: np.ndarray,
        there: np.ndarray | None,
        above: int,
        joint: int,
        *,
        parent_turn: np.ndarray,
    ) -> np.ndarray:
        """Turn a bone here the shortest way to that there; the twist by quarters, unless it rests upright."""
        if there is None or not np.any(there):
            return turn
        turn = _shortest(turn @ bone, there) @ turn
        if self._standing:
            return turn
        between = np.swapaxes(self._turns[:, above] @ parent_turn, -1, -2) @ self._turns[:, joint] @ turn
        quarter = np.round(_twist(between.mean(axis=0), unit_vector(bone)) / (np.pi / 2)) * np.pi / 2
        return np.asarray(turn @ _about(unit_vector(bone), -quarter))

    def _joint(self, name: str, chest: int) -> np.ndarray:
        """Turn of a joint of limbs, hands or head."""
        parent = PARENT_NAMES[name]
        while parent in PARENT_NAMES and parent not in self._found:
            parent = PARENT_NAMES[parent]
        above = chest if parent == "Chest" else self._match.get(parent, self._match["Hips"])
        turn, bones = self._found[parent], self._bones(name)
        trunk = ("Head", "ToeBase", "Shoulder", "Foot") if self._limbs else ("Head", "ToeBase")
        if name == "Head" and not self._standing:
            return self._head(above, turn)
        if self._soles and name.endswith("ToeBase"):
            return self._toes(name, turn)
        if name.endswith(trunk) and self._standing:
            return self._found["Hips"]
        if bones is None:
            return turn
        hinge = None if self._standing else self._hinge(name)
        if hinge is not None:
            return _frame(unit_vector(bones[1]), hinge[1]) @ _frame(unit_vector(bones[0]), hinge[0]).T
        turn = self._turned(turn, bones[0], bones[1], above, self._match[name], parent_turn=turn)
        return turn @ self._slope(name, bones) if self._soles and name.endswith("Foot") else turn

    def _slope(self, name: str, bones: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Turn of a foot in T-pose from the slope that a foot has there on the ground to its own.

        Ankles lie at other heights above the sole: the direction from ankle to toes says nothing of the sole.
        """
        there = bones[1] if self._standing else self._standing_foot(name)
        if there is None:
            return np.eye(3)
        ahead = unit_vector(bones[0] * [1, 0, 1])
        sloped = np.hypot(there[0], there[2]) * ahead + [0, there[1], 0]
        if not np.any(sloped):
            return np.eye(3)
        turn = _shortest(sloped, bones[0])
        self._slopes[name] = float(np.degrees(Rotation.from_matrix(turn).magnitude()))
        return turn

    def _standing_foot(self, name: str) -> np.ndarray | None:
        """From ankle to toes where a foot stands flat; None without such frames."""
        found = self._flat(name)
        return None if found is None else np.array([np.cos(found[1]), -np.sin(found[1]), 0])

    def _flat(self, name: str) -> tuple[np.ndarray, float] | None:
        """Frames in which a foot is low and still, and the slope of its line there, their middle.

        None where these are no frames of a foot that stands flat: the direction of its bone is all there is.
        """
        toe = name.replace("Foot", "ToeBase")
        if not {name, toe} <= set(self._match):
            return None
        positions = self._source.positions(self._turns)
        ankle, ball = positions[:, self._match[name]], positions[:, self._match[toe]]
        speed = np.linalg.norm(np.gradient(ball, axis=0), axis=1) if len(ball) > 1 else np.zeros(1)
        low = ball[:, 1] <= np.quantile(ball[:, 1], _LOW)
        still = low & (speed <= np.quantile(speed[low], _LOW))
        bone = (ball - ankle)[still]
        slopes = np.arctan2(-bone[:, 1], np.hypot(bone[:, 0], bone[:, 2]))
        first, slope, last = np.quantile(slopes, (0.25, 0.5, 0.75))
        if last - first > _STEADY or not _SLOPES[0] < slope < _SLOPES[1]:
            return None
        return still, float(slope)

    def _toes(self, name: str, turn: np.ndarray) -> np.ndarray:
        """Turn of toes: where their foot stands flat, they lie as they rest here."""
        foot = name.replace("ToeBase", "Foot")
        found = None if self._standing else self._flat(foot)
        if found is None:
            return turn
        toes, ankles = (self._turns[found[0], self._match[each]] for each in (name, foot))
        between = Rotation.from_matrix(np.swapaxes(toes, -1, -2) @ ankles)
        return np.asarray(between.mean().as_matrix() @ turn)

    def _head(self, above: int, turn: np.ndarray) -> np.ndarray:
        """The turn by quarters that has people look ahead on average: no bone tells how a head is held."""
        between = np.swapaxes(self._turns[:, above] @ turn, -1, -2) @ self._turns[:, self._match["Head"]]
        mean = between.mean(axis=0)
        return max(_quarter_turns(), key=lambda quarter: float(np.trace(mean @ quarter)))

    def _bones(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """The bone of a joint here and there, at rest."""
        for target in _following(name):
            if target in self._match:
                there = self._source.rest[self._match[target]] - self._source.rest[self._match[name]]
                return (self._rest[target] - self._rest[name], there) if np.any(there) else None
        end = None if name.endswith(("Hand", "Shoulder")) else tail(self._source, self._match[name])
        target = next(iter(_following(name)), None)
        return None if end is None or target is None else (self._rest[target] - self._rest[name], end)

    def _hinge(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Axis that a knee or elbow bends about, here and there; None where it hardly bends."""
        side, part = ("Left", name[4:]) if name.startswith("Left") else ("Right", name[5:])
        upper = {"Leg": "Leg", "Shin": "Leg", "Arm": "Arm", "ForeArm": "Arm"}.get(part)
        if upper is None:
            return None
        first, second = side + upper, side + _NEXT[upper]
        bones = [self._bones(each) if each in self._match else None for each in (first, second)]
        if bones[0] is None or bones[1] is None:
            return None
        between = (
            np.swapaxes(self._turns[:, self._match[first]], -1, -2) @ self._turns[:, self._match[second]]
        )
        axis = np.cross(unit_vector(bones[0][1]), between @ unit_vector(bones[1][1]))
        if name == second:
            axis = (np.swapaxes(between, -1, -2) @ axis[..., None])[..., 0]
        mean = axis.mean(axis=0)
        if np.linalg.norm(mean) < _BENT:
            return None
        there = unit_vector(mean)
        nearest = np.sign(there) * (np.abs(there) == np.abs(there).max())
        here = np.array([1.0, 0, 0]) if upper == "Leg" else np.array([0, -1.0 if side == "Left" else 1.0, 0])
        return here, nearest if there @ nearest > _CLOSE else there


def _following(name: str) -> list[str]:
    """Joints here that the bone of a joint may lead to, the first choice first."""
    for side in ("Left", "Right"):
        if name == f"{side}Hand":
            return [name + knuckle for knuckle in _KNUCKLES]
        if name.removeprefix(side) in _NEXT and name.startswith(side):
            return [side + _NEXT[name.removeprefix(side)]]
    if "Hand" not in name or name.endswith("End"):
        return []
    return [next(child for child, parent in PARENT_NAMES.items() if parent == name)]


def _quarter_turns() -> list[np.ndarray]:
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return found


def _frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Axes (3, 3) in columns: the first direction, what is left of the second, and the third."""
    across = unit_vector(second - (second @ first) * first)
    return np.stack([first, across, np.cross(first, across)], -1)


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    return np.asarray(Rotation.from_rotvec(angle * axis).as_matrix())


def _shortest(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The smallest rotation from one direction to another; half a turn goes about the most upright axis."""
    a, b = unit_vector(first), unit_vector(second)
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -0.9999:
        side = np.eye(3)[np.abs(a).argmin()]
        return _about(unit_vector(np.cross(a, side)), np.pi)
    return (
        _about(unit_vector(axis), float(np.arctan2(np.linalg.norm(axis), cosine)))
        if np.any(axis)
        else np.eye(3)
    )


def _twist(matrix: np.ndarray, axis: np.ndarray) -> float:
    """Angle about `axis` of the rotation nearest to a mean of rotations."""
    u, _, vt = np.linalg.svd(matrix)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    moved = _shortest(turn @ axis, axis) @ turn  # what is left without the swing turns about the axis
    side = _frame(axis, np.eye(3)[np.abs(axis).argmin()])
    return float(np.arctan2((moved @ side[:, 1]) @ side[:, 2], (moved @ side[:, 1]) @ side[:, 1]))
