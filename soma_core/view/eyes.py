"""Eyeballs, which the canonical mesh has not: no vertex hangs on the joints of the eyes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from soma_core.io.joint_order import USER_JOINTS
from soma_core.rig.skeleton import Rig
from soma_core.view.stage import Body

__all__ = ["EYES", "eyeball", "eyeball_places", "with_eyes"]

EYES = tuple(USER_JOINTS.index(name) for name in ("LeftEye", "RightEye"))
"""The joints of the eyes among those of a pose."""

_HEAD = USER_JOINTS.index("Head")

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
    return radius, places + _FRONT * radius * turns[_HEAD, :, 2]


def with_eyes(body: Body, transforms: np.ndarray, rig: Rig) -> Body:
    """The same body to draw, with eyeballs that look where their joints do.

    Args:
        body: a posed canonical body.
        transforms: (78, 4, 4) world transforms of its joints [m].
        rig: of the body.
    """
    turns = transforms[1:, :3, :3] @ rig.t_pose_world[1:, :3, :3].transpose(0, 2, 1)
    ball, faces, shades = eyeball()
    radius, centres = eyeball_places(transforms[1:, :3, 3], turns)
    count = len(body.vertices)
    skin = np.tile(body.colour, (count, 1)) if body.shades is None else body.shades
    balls = [radius * ball @ turns[eye].T + centre for eye, centre in zip(EYES, centres, strict=True)]
    return replace(
        body,
        vertices=np.concatenate([body.vertices, *balls]),
        triangles=np.concatenate([body.triangles, faces + count, faces + count + len(ball)]),
        shades=np.concatenate([skin, shades / 255, shades / 255]),
    )
