"""Motions of any skeleton on this one: turns are carried over against both rest poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError, check_type
from soma_core.io.joint_names import match_joints
from soma_core.io.joint_order import PARENT_NAMES, USER_JOINTS
from soma_core.io.motion import Motion
from soma_core.io.skeleton_motion import SkeletonMotion
from soma_core.motion.rest_poses import align, own_alignment
from soma_core.motion.source_skeleton import chains, placed
from soma_core.rig import load_canonical

__all__ = ["Retargeted", "retarget"]

_MATCHES = ("bones", "soles", "limbs")
_SPINE, _NECK = ("Spine1", "Spine2", "Chest"), ("Neck1", "Neck2")


@dataclass(frozen=True, kw_only=True, eq=False)
class Retargeted:
    """A motion that was carried over from another skeleton.

    Attributes:
        motion: on this skeleton.
        report: which joint became which, what was left behind, unit, axes, and the scale of the path.
        source: the other skeleton's motion in metres, +Y up.
    """

    motion: Motion
    report: Mapping[str, Any]
    source: SkeletonMotion


def retarget(
    source: SkeletonMotion,
    *,
    mapping: Mapping[str, str] | None = None,
    unit: str | None = None,
    up: str | None = None,
    match: Literal["bones", "soles", "limbs"] | str = "soles",
) -> Retargeted:
    """Carry the motion of another skeleton over to this one.

    A joint keeps its change of world orientation since the rest pose, after the rest poses are brought
    together: each bone of this skeleton is first turned, from where its parent's went, by the shortest way to
    the direction of the other's bone at rest, so that bones point the same way in every frame. Where a
    rest pose is no human pose (all bones along one axis), the twist about a bone comes from the bends of
    knees and elbows. Spines of another number of joints share out their turn; others stay at rest.

    The path is scaled by the length of the legs, so that feet reach the ground on the rig's own body; motions
    under this skeleton's own names keep theirs.

    Args:
        source: what moves, in metres or, with `unit` or a human size, in any unit.
        mapping: name of a joint here -> its name there, where names are not known.
        unit: of the source's lengths, ``m``, ``cm`` or ``mm``; None: told by the length of the legs.
        up: upward axis of the source's world, as ``y`` or ``-z``; None: told by its rest pose.
        match: ``soles``: all but the slope of feet that stand flat, which do so here; ``bones``: all of them;
            ``limbs``: arms, legs and fingers; the trunk keeps its shape where the source rests as a human.

    Raises:
        InputError: names that are not known, or a size that fits no unit.
    """
    check_type("source", source, SkeletonMotion, fix="Read one: soma_core.motion.read_bvh(path).")
    if match not in _MATCHES:
        raise InputError("match", got=repr(match), expected=" or ".join(_MATCHES), fix="Correct it.")
    joints = match_joints(source.names, source.parents, mapping=mapping, source=source.source or "names")
    spine, neck = chains(source, joints)
    found = placed(source, joints, unit=unit, up=up)
    source, rig = found.source, load_canonical("mid")[1]
    turns = source.turns()
    same = all(source.names[joint] == name for name, joint in joints.items())
    own = same and own_alignment(found, joints, spine, neck, rig)
    rest = dict(zip(rig.joint_names, rig.t_pose_world[:, :3, 3], strict=True))
    alignment = own or align(found, joints, spine, neck, turns, rest, by=match)
    goals = {name: turns[:, joints[name]] @ turn for name, turn in alignment.turns.items() if name in joints}
    for targets, chain in ((_SPINE, spine), (_NECK, neck)):
        along = [turns[:, joint] @ turn for joint, turn in zip(chain, alignment.chain(chain), strict=True)]
        goals.update(_spread(targets, along, goals.get("Hips")))
    rotations = _local(goals, source.frame_count)
    path, scale, legs = _path(source, joints, turns, goals["Hips"], rest, carried=bool(own))
    motion = Motion(
        rotations=rotations, translation=path, fps=source.fps, joint_names=USER_JOINTS,
        rig_revision=rig.revision, source=source.source,
    )  # fmt: skip
    report = _joints_report(source, joints, spine, neck) | {
        "rest_pose": alignment.kind, "unit_metres": found.metres, "up": found.up, "legs_metres": legs,
        "path_scale": scale, "at_rest": [name for name in USER_JOINTS if name not in goals],
        "foot_slopes_degrees": {name: round(angle, 2) for name, angle in alignment.slopes.items()},
    }  # fmt: skip
    return Retargeted(motion=motion, report=report, source=source)


def _joints_report(
    source: SkeletonMotion, joints: Mapping[str, int], spine: Sequence[int], neck: Sequence[int]
) -> dict[str, Any]:
    """Which joint became which, and which were left."""
    used = {*joints.values(), *spine, *neck}
    return {
        "joints": {name: source.names[joint] for name, joint in joints.items()},
        "spine": [source.names[joint] for joint in spine],
        "neck": [source.names[joint] for joint in neck],
        "not_carried": [name for joint, name in enumerate(source.names) if joint not in used],
    }


def _spread(
    targets: tuple[str, ...], along: list[np.ndarray], hips: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Turns of a chain's joints from those of a chain of another number of joints, evenly along it."""
    if not along:
        return {}
    if len(along) == 1 and targets == _SPINE and hips is not None:
        along, places = [hips, *along], (np.arange(len(targets)) + 1) / len(targets)
    else:
        places = np.linspace(0, len(along) - 1, len(targets))
    found = {}
    for name, place in zip(targets, places, strict=True):
        first = min(int(place), max(len(along) - 2, 0))
        share = place - first
        found[name] = along[first] if share == 0 else _between(along[first], along[first + 1], share)
    return found


def _between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    if share == 1:
        return second
    turn = Rotation.from_matrix(np.swapaxes(first, -1, -2) @ second).as_rotvec()
    return np.asarray(first @ Rotation.from_rotvec(share * turn).as_matrix())


def _local(goals: Mapping[str, np.ndarray], frames: int) -> np.ndarray:
    """Rotations relative to the parent, (frames, 77, 3, 3); joints without a goal go with their parent."""
    rotations = np.tile(np.eye(3, dtype=np.float32), (frames, len(USER_JOINTS), 1, 1))
    for index, name in enumerate(USER_JOINTS):
        if name not in goals:
            continue
        above = PARENT_NAMES[name]
        while above in PARENT_NAMES and above not in goals:
            above = PARENT_NAMES[above]
        turn = goals[name]
        rotations[:, index] = np.swapaxes(goals[above], -1, -2) @ turn if above in goals else turn
    return rotations


def _path(
    source: SkeletonMotion,
    match: Mapping[str, int],
    turns: np.ndarray,
    hips: np.ndarray,
    rest: Mapping[str, np.ndarray],
    *,
    carried: bool,
) -> tuple[np.ndarray, float, float | None]:
    """Positions of Hips [m], the scale of the path, and the length of the source's legs [m].

    Not Hips but the middle between the tops of the legs is what is scaled: skeletons have their Hips at
    different heights above it.
    """
    positions = source.positions(turns)
    sides = [side for side in ("Left", "Right") if {f"{side}Leg", f"{side}Shin", f"{side}Foot"} <= set(match)]
    joints = [[match[side + part] for part in ("Leg", "Shin", "Foot")] for side in sides]
    place = positions[:, match["Hips"]]
    if carried or len(sides) < 1:
        return place, 1.0, _length(source.rest, joints) if joints else None
    legs = _length(source.rest, joints)
    own = _length(
        np.array([rest[side + part] for side in sides for part in ("Leg", "Shin", "Foot")]),
        [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(len(sides))],
    )
    if len(sides) < 2:
        return own / legs * place, own / legs, legs
    middle = positions[:, [chain[0] for chain in joints]].mean(axis=1)
    below = np.mean([rest["LeftLeg"], rest["RightLeg"]], axis=0) - rest["Hips"]
    return own / legs * middle - hips @ below, own / legs, legs


def _length(places: np.ndarray, joints: list[list[int]]) -> float:
    """Mean length of thigh and shin together."""
    steps = [np.linalg.norm(np.diff(places[chain], axis=0), axis=1).sum() for chain in joints]
    return float(np.mean(steps))
