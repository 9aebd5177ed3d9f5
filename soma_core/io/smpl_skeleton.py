"""The skeleton of the SMPL family without its model files: how the T-pose stands, to the centimetre."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.io.amass import SmplMotion
from soma_core.io.skeleton_motion import SkeletonMotion
from soma_core.rig.skeleton import Rig

__all__ = ["smpl_skeleton", "with_sides_swapped"]

_BODY: Final[dict[str, tuple[str, tuple[float, float, float]]]] = {
    "pelvis": ("", (0, -0.22, 0.03)),
    "left_hip": ("pelvis", (0.07, -0.31, 0.02)),
    "right_hip": ("pelvis", (-0.07, -0.31, 0.02)),
    "spine1": ("pelvis", (0, -0.11, 0.00)),
    "left_knee": ("left_hip", (0.10, -0.69, 0.02)),
    "right_knee": ("right_hip", (-0.10, -0.69, 0.02)),
    "spine2": ("spine1", (0, 0.02, 0.00)),
    "left_ankle": ("left_knee", (0.09, -1.09, -0.03)),
    "right_ankle": ("right_knee", (-0.09, -1.09, -0.03)),
    "spine3": ("spine2", (0, 0.07, 0.03)),
    "left_foot": ("left_ankle", (0.12, -1.15, 0.09)),
    "right_foot": ("right_ankle", (-0.12, -1.15, 0.09)),
    "neck": ("spine3", (0, 0.28, -0.02)),
    "left_collar": ("spine3", (0.08, 0.19, -0.01)),
    "right_collar": ("spine3", (-0.08, 0.19, -0.01)),
    "head": ("neck", (0, 0.36, 0.03)),
    "left_shoulder": ("left_collar", (0.17, 0.22, -0.02)),
    "right_shoulder": ("right_collar", (-0.17, 0.22, -0.02)),
    "left_elbow": ("left_shoulder", (0.43, 0.21, -0.04)),
    "right_elbow": ("right_shoulder", (-0.43, 0.21, -0.04)),
    "left_wrist": ("left_elbow", (0.68, 0.22, -0.05)),
    "right_wrist": ("right_elbow", (-0.68, 0.22, -0.05)),
}
"""Joints in the order of SMPL, their parents, and where they stand on an average adult [m]."""

_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_FACE = ("jaw", "left_eye", "right_eye")


def with_sides_swapped(motion: SmplMotion) -> SmplMotion:
    """A motion whose joints of the left are those that it calls right; nothing is mirrored."""
    names = list(_BODY) + (["left_hand", "right_hand"] if motion.model == "smpl" else [])
    names += _FACE if motion.model == "smplx" else ()
    names += [] if motion.model == "smpl" else [name for name, _ in _fingers()]
    sides = {"left": "right", "right": "left"}
    other = ["_".join(sides.get(word, word) for word in name.split("_")) for name in names]
    hands = motion.hand_components
    return replace(
        motion,
        rotations=motion.rotations[:, [names.index(name) for name in other]],
        hand_components=None if hands is None else np.roll(hands, hands.shape[1] // 2, axis=1),
    )


def _fingers() -> Iterator[tuple[str, str]]:
    """Joints of the fingers in the order of SMPL-H, and the joints of this skeleton that they are."""
    for side, finger, number in itertools.product(("left", "right"), _FINGERS, (1, 2, 3)):
        target = f"{side.capitalize()}Hand{finger.capitalize()}{number + (finger != 'thumb')}"
        yield f"{side}_{finger}{number}", target


def smpl_skeleton(motion: SmplMotion, rig: Rig) -> SkeletonMotion:
    """Joints of a motion of SMPL, SMPL-H or SMPL-X on an average adult; betas are not read.

    Fingers and face, whose places follow from the model alone, rest as those of the canonical rig do. The
    two hand joints of SMPL, which lie on the palm, are left out.

    Args:
        motion: of the file.
        rig: the canonical rig.
    """
    names, parents, rest = list(_BODY), [], [np.array(place) for _, place in _BODY.values()]
    parents = [names.index(parent) if parent else -1 for parent, _ in _BODY.values()]
    own = dict(zip(rig.joint_names, rig.t_pose_world[:, :3, 3], strict=True))
    if motion.model == "smplx":
        for name, target in zip(_FACE, ("Jaw", "LeftEye", "RightEye"), strict=True):
            rest.append(rest[names.index("head")] + own[target] - own["Head"])
            parents.append(names.index("head"))
            names.append(name)
    for name, target in _fingers() if motion.model != "smpl" else ():
        wrist = names.index(f"{name.partition('_')[0]}_wrist")
        rest.append(rest[wrist] + own[target] - own[f"{name.partition('_')[0].capitalize()}Hand"])
        parents.append(wrist if name.endswith("1") else len(names) - 1)
        names.append(name)
    vectors = motion.rotations[:, : len(names)].astype(np.float64)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    return SkeletonMotion(
        names=tuple(names),
        parents=np.array(parents),
        rest=np.array(rest),
        rotations=rotations,
        root=motion.about_pelvis(rest[0]).astype(np.float64) + rest[0],
        fps=motion.fps,
        up=motion.up,
        metres=1.0,
        source=motion.source,
    )
