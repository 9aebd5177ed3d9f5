"""Motions that come over by their joints: skeletons of other tools, and SMPL's without its model."""

from __future__ import annotations

import itertools
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from soma_core.choices import BoneMatch
from soma_core.io.joint_names import match_joints, read_mapping
from soma_core.io.joint_order import other_side
from soma_core.io.motion import Motion
from soma_core.io.skeleton_files import read_skeleton
from soma_core.io.skeleton_motion import soma_skeleton
from soma_core.io.smpl_skeleton import smpl_skeleton
from soma_core.motion.foot_lock import Limb
from soma_core.motion.movement import of_movement
from soma_core.motion.options import ConvertOptions
from soma_core.motion.questions import of_path, of_rate, of_smpl, say
from soma_core.motion.retargeting import Retargeted, retarget
from soma_core.motion.smpl_input import SMPL_LAYOUTS, smpl_choices, smpl_motion
from soma_core.rig import load_canonical
from soma_core.rig.skeleton import Rig

__all__ = ["carried", "refined"]

_log = logging.getLogger(__name__)

_SHOWN = 12
_LIMBS = (("Leg", "Shin", "Foot"), ("Arm", "ForeArm", "Hand"))


def carried(path: Path, layout: str, options: ConvertOptions) -> Retargeted:
    """Read the skeleton of a file and carry its motion over to this one.

    Raises:
        SomaError: the file cannot be read, or its joints are not known.
    """
    up, match, asked = options.upward, options.match, list[str]()
    if layout in SMPL_LAYOUTS:
        choices = replace(smpl_choices(options), gender="neutral", betas=(0.0,) * 10)
        motion = smpl_motion(path, options, choices)
        asked = of_smpl(motion)
        say(path.name, asked)
        _log.warning("%s: betas are not read: joints are carried over, no body is fitted", path.name)
        if motion.hand_components is not None and motion.hand_components.size:
            _log.warning("%s: hands are components of the model: the fingers stay straight", path.name)
        source, up, match = smpl_skeleton(motion, load_canonical("mid")[1]), None, match or BoneMatch.limbs
    else:
        source = read_skeleton(path, fps=options.fps, root=options.root, angles=options.angles)
    mapping = read_mapping(options.mapping) if options.mapping else None
    if options.swap_sides and layout not in SMPL_LAYOUTS:
        joints = match_joints(source.names, source.parents, mapping=mapping, source=source.source or "names")
        mapping = {other_side(name): source.names[joint] for name, joint in joints.items()}
    found = retarget(
        source,
        mapping=mapping,
        unit=str(options.unit) if options.unit and layout not in SMPL_LAYOUTS else None,
        up=up,
        match=str(match or BoneMatch.soles),
    )
    if layout not in SMPL_LAYOUTS:
        moved = found.motion
        told = of_path(moved.translation, moved.fps, up="+y", what="its path")
        say(path.name, of_rate(moved.fps) + of_movement(moved, turns=("swap_sides",), told=told))
    elif not asked:
        say(path.name, of_movement(found.motion, turns=("swap_sides", "rotation_layout")))
    found = refined(found) if options.refine == "joints" else found
    left = found.report["not_carried"]
    if left:
        more = " ..." if len(left) > _SHOWN else ""
        _log.info("%s: not carried over: %s%s", path.name, ", ".join(left[:_SHOWN]), more)
    slopes = found.report["foot_slopes_degrees"]
    if slopes:
        _log.info(
            "%s: soles are as flat as there, so lines from ankle to toes are up to %.1f degrees off; "
            "match=bones for those", path.name, max(slopes.values()),
        )  # fmt: skip
    scale = found.report["path_scale"]
    if scale != 1:
        _log.info(
            "%s: its legs are %.3f m; the path is scaled by %.3f to those of the rig, %.3f m",
            path.name,
            found.report["legs_metres"],
            scale,
            scale * found.report["legs_metres"],
        )
    return found


def refined(found: Retargeted) -> Retargeted:
    """Bring hands and feet to where they are on the other skeleton, its path scaled, by elbows and knees.

    Hands and feet keep their turn in the world, and elbows and knees the way they bend. What a limb does not
    reach is left; the report says how far hands and feet are away, before and after.
    """
    motion, rig = found.motion, load_canonical("mid")[1]
    names, places = found.source.names, found.source.positions() * found.report["path_scale"]
    joints = found.report["joints"]
    rotations = motion.rotations.astype(np.float64)
    before: dict[str, float] = {}
    transforms = _transforms(motion, rig)
    for side, parts in itertools.product(("Left", "Right"), _LIMBS):
        limb = [side + part for part in parts]
        if not set(limb) <= set(joints):
            continue
        goal = places[:, names.index(joints[limb[-1]])]
        before[limb[-1]] = _apart(transforms, rig, limb[-1], goal)
        moved = Limb(transforms, rig, limb)
        moved.reach(goal, np.eye(3))
        moved.store(rotations, absolute=False)
    motion = replace(motion, rotations=rotations.astype(np.float32))
    transforms = _transforms(motion, rig)
    told = {
        name: [apart, _apart(transforms, rig, name, places[:, names.index(joints[name])])]
        for name, apart in before.items()
    }
    return replace(found, motion=motion, report={**found.report, "refined_mm": told})


def _transforms(motion: Motion, rig: Rig) -> np.ndarray:
    """World transforms (frames, 78, 4, 4) of the rig's own body [m]."""
    skeleton = soma_skeleton(motion, rig)
    turns = skeleton.turns()
    found = np.tile(np.eye(4), (motion.frame_count, rig.joint_count, 1, 1))
    found[:, 1:, :3, :3] = turns @ rig.t_pose_world[1:, :3, :3]
    found[:, 1:, :3, 3] = skeleton.positions(turns)
    return found


def _apart(transforms: np.ndarray, rig: Rig, joint: str, goal: np.ndarray) -> float:
    """Mean distance of a joint from where it should be [mm]."""
    places = transforms[:, rig.joint_names.index(joint), :3, 3]
    return round(1e3 * float(np.linalg.norm(places - goal, axis=1).mean()), 2)
