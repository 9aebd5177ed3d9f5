"""Eyeballs, which the canonical mesh has not: no vertex hangs on the joints of the eyes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_core.io.joint_order import USER_JOINTS
from soma_core.rig.skeleton import Rig

__all__ = ["EYES", "Eyeball", "eyeball", "eyeball_materials", "eyeball_places", "eyeballs"]

EYES = tuple(USER_JOINTS.index(name) for name in ("LeftEye", "RightEye"))
"""The joints of the eyes among those of a pose."""

_BALL, _FRONT = 0.19, 0.15
"""Radius of an eyeball, as a share of the distance of the eyes; how far before its joint it lies, of that."""

_PUPIL, _IRIS, _WHITE = (24, 22, 22), (96, 74, 54), (236, 234, 230)
_PUPIL_DEG, _IRIS_DEG = 12, 27


def eyeball() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A ball of radius 1 that looks along +Z: vertices (v, 3), triangles (t, 3) and sRGB (v, 3) in 0..255."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4)
    off = np.degrees(np.arccos(np.clip(ball.vertices[:, 2], -1, 1)))[:, None]
    shades = np.select([off < _PUPIL_DEG, off < _IRIS_DEG], [_PUPIL, _IRIS], _WHITE).astype(np.uint8)
    return np.asarray(ball.vertices), np.asarray(ball.faces), shades


def eyeball_places(joints: np.ndarray, turns: np.ndarray) -> tuple[float, np.ndarray]:
    """Radius [m] of the eyeballs and their centres (2, 3) [m], left and right.

    Args:
        joints: (77, 3) [m], +Y up.
        turns: (77, 3, 3) world rotations, identity in the T-pose.
    """
    places = joints[list(EYES)]
    radius = _BALL * float(np.linalg.norm(places[0] - places[1]))
    return radius, places + _FRONT * radius * turns[list(EYES), :, 2]


def eyeball_materials() -> list[tuple[str, tuple[float, float, float], np.ndarray]]:
    """Name, sRGB in 0..1 and triangles (t, 3) of each part of :func:`eyeball`, white first."""
    _, faces, shades = eyeball()
    darkest = shades[faces].min(axis=1)
    return [
        (name, (red / 255, green / 255, blue / 255), faces[(darkest == (red, green, blue)).all(axis=1)])
        for name, (red, green, blue) in (("EyeWhite", _WHITE), ("Iris", _IRIS), ("Pupil", _PUPIL))
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class Eyeball:
    """Where an eyeball hangs.

    Attributes:
        name: ``LeftEyeball`` or ``RightEyeball``.
        joint: index of its joint, with which it moves as one piece.
        radius: [m].
        local: (4, 4) from the axes of :func:`eyeball` to those of the joint [m].
    """

    name: str
    joint: int
    radius: float
    local: np.ndarray


def eyeballs(rig: Rig, t_pose_world: np.ndarray) -> list[Eyeball]:
    """The eyeballs of a body, left and right; none where the rig has no joints for them.

    Args:
        rig: of the body.
        t_pose_world: (J, 4, 4) of its joints in the T-pose [m].
    """
    names = [USER_JOINTS[eye] for eye in EYES]
    if not {*names} <= {*rig.joint_names}:
        return []
    joints = [rig.joint_names.index(name) for name in names]
    first, second = t_pose_world[joints, :3, 3]
    radius, found = _BALL * float(np.linalg.norm(first - second)), []
    for name, joint in zip(names, joints, strict=True):
        local = np.eye(4)
        local[:3, :3] = t_pose_world[joint, :3, :3].T
        local[:3, 3] = local[:3, 2] * _FRONT * radius
        found.append(Eyeball(name=f"{name}ball", joint=joint, radius=radius, local=local))
    return found
