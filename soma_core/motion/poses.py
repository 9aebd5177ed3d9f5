"""Poses by name, as motions of one frame."""

from __future__ import annotations

import numpy as np
import torch

from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.motion import Motion

__all__ = ["POSES", "named_pose"]


_LOWERED = {"LeftArm": (0, 0, -72), "LeftForeArm": (0, -12, 0)}
_SEATED = {"LeftLeg": (-82, 8, 4), "LeftShin": (86, 0, 0), "LeftFoot": (-4, 0, 0)}

POSES: dict[str, dict[str, tuple[float, float, float]]] = {
    "T-pose": {},
    "arms lowered": _LOWERED,
    "A-pose": {"LeftArm": (0, 0, -45)},
    "arms raised": {"LeftShoulder": (0, 0, 14), "LeftArm": (0, 0, 62)},
    "squat": {**_SEATED, "Spine1": (14, 0, 0), "LeftFoot": (-14, 0, 0), "LeftArm": (0, -72, 8)},
    "seated": {**_SEATED, **_LOWERED},
    "stride": {
        "LeftLeg": (-28, 0, 0), "LeftShin": (12, 0, 0), "RightLeg": (22, 0, 0), "RightShin": (28, 0, 0),
        "LeftArm": (0, 24, -68), "RightArm": (0, 24, 68), "LeftForeArm": (0, -22, 0),
        "RightForeArm": (0, 34, 0),
    },
}  # fmt: skip
"""Poses by name: rotation vectors [degrees] of joints, from the T-pose in world axes. A joint of the left
whose right twin is not named stands for both."""


def named_pose(name: str) -> Motion:
    """One frame of a pose of `POSES`.

    Raises:
        InputError: no such pose.
    """
    if name not in POSES:
        raise InputError("pose", got=name, expected=f"one of {', '.join(POSES)}", fix="Choose one.")
    angles = dict(POSES[name])
    for joint, (x, y, z) in list(angles.items()):
        twin = joint.replace("Left", "Right")
        angles.setdefault(twin, (x, -y, -z))
    vectors = np.zeros((1, len(USER_JOINTS), 3))
    for joint, degrees in angles.items():
        vectors[0, USER_JOINTS.index(joint)] = np.radians(degrees)
    rotations = axis_angle_to_matrix(torch.as_tensor(vectors)).numpy()
    return Motion(
        rotations=rotations, translation=np.array([[0.0, 1.0, 0.0]]), fps=30.0, joint_names=USER_JOINTS,
        source=name,
    )  # fmt: skip
