"""A caricature of the low mesh: the shape that is decimated so that hands, face and joints keep vertices.

Quadric decimation removes a vertex where the surface around it is nearly flat or small. In the caricature
hands, head and face are larger than life, toes smaller, and fingers, jaw, elbows and knees are bent, so
that the creases of a moving body are edges of the shape (the idea of decimating more than one pose: Mohr
and Gleicher 2003, "Deformation sensitive decimation").
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["BoundSkin", "draw_caricature"]

# Chosen on pictures of the result: five fingers with joints, ears, eye sockets, nose and lips.
_FINGER, _JAW, _LIMB = 40.0, 20.0, 50.0  # degrees
_HAND_SCALE, _HEAD_SCALE, _TOE_SCALE, _FACE_SCALE = 2.2, 1.3, 0.7, 1.5
_FACE_RADIUS = 6.5  # cm, standard deviation of the bump that magnifies the face

_FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")
_ROUNDED = 4  # decimals of a centimetre: other processors shall start from the same numbers


@dataclass(frozen=True, kw_only=True, eq=False)
class BoundSkin:
    """A skin at its bind pose [cm], +Y up, +X left.

    Attributes:
        points: (v, 3).
        weights: (v, J) dense.
        joint_names, parents: J names and (J,) parents, parents before children.
        joints: (J, 3) bind positions.
        mirror: (v,) left/right partner of each vertex.
        lips_and_lids: ids of the vertices around the mouth and the eyes.
    """

    points: np.ndarray
    weights: np.ndarray
    joint_names: tuple[str, ...]
    parents: np.ndarray
    joints: np.ndarray
    mirror: np.ndarray
    lips_and_lids: np.ndarray

    def at(self, name: str) -> np.ndarray:
        """Bind position of a joint, (3,)."""
        return self.joints[self.joint_names.index(name)]

    def share(self, names: Sequence[str]) -> np.ndarray:
        """Skin weight that the named joints carry together, (v, 1)."""
        return self.weights[:, [self.joint_names.index(name) for name in names]].sum(axis=1, keepdims=True)


def _bends(skin: BoundSkin) -> Iterator[tuple[str, np.ndarray, float]]:
    """Joint, axis and angle [degrees] of every bend, of the left side and the jaw."""
    hand, across = skin.at("LeftHand"), skin.at("LeftHandPinky2") - skin.at("LeftHandIndex2")
    out_of_palm = np.cross(across, skin.at("LeftHandMiddle2") - hand)
    for finger in _FINGERS:
        for number in (2, 3) if finger == "Thumb" else (2, 3, 4):
            joint = f"LeftHand{finger}{number}"
            child = skin.joint_names[skin.joint_names.index(joint) + 1]
            yield joint, np.cross(skin.at(child) - skin.at(joint), out_of_palm), _FINGER
    yield "LeftForeArm", np.cross(hand - skin.at("LeftForeArm"), (0, 0, 1)), _LIMB
    yield "LeftShin", np.array([1.0, 0, 0]), _LIMB
    yield "Jaw", np.array([1.0, 0, 0]), _JAW


def _bent(skin: BoundSkin) -> np.ndarray:
    """Linear blend skinning of all bends, (v, 3)."""
    local = {joint: (axis / np.linalg.norm(axis), np.radians(angle)) for joint, axis, angle in _bends(skin)}
    transforms = np.tile(np.eye(4), (len(skin.joint_names), 1, 1))
    for joint, name in enumerate(skin.joint_names):
        if skin.parents[joint] >= 0:
            transforms[joint] = transforms[skin.parents[joint]]
        if name in local:
            axis, angle = local[name]
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
            turn[:3, 3] = skin.joints[joint] - turn[:3, :3] @ skin.joints[joint]
            transforms[joint] = transforms[joint] @ turn
    ends = np.einsum("jab,vb->vja", transforms[:, :3, :3], skin.points) + transforms[:, :3, 3]
    return np.einsum("vj,vja->va", skin.weights, ends)


def draw_caricature(skin: BoundSkin) -> np.ndarray:
    """Return the caricature, (v, 3) [cm]: symmetric as `mirror` says, its midline on x = 0."""
    points = _bent(skin)
    left_hand = [name for name in skin.joint_names if name.startswith("LeftHand")]
    parts = (
        (left_hand, "LeftHand", _HAND_SCALE),
        (("Head", "HeadEnd", "Jaw", "LeftEye", "RightEye"), "Head", _HEAD_SCALE),
        (("LeftToeBase", "LeftToeEnd"), "LeftToeBase", _TOE_SCALE),
    )
    for names, centre, scale in parts:
        points = points + (scale - 1) * skin.share(names) * (points - skin.at(centre))
    to_face = points - points[skin.lips_and_lids].mean(axis=0)
    bump = np.exp(-0.5 * (to_face**2).sum(axis=1, keepdims=True) / _FACE_RADIUS**2)
    points = points + (_FACE_SCALE - 1) * bump * to_face
    right = skin.points[:, 0] < 0
    points[right] = points[skin.mirror[right]] * [-1, 1, 1]
    points[skin.mirror == np.arange(len(points)), 0] = 0
    return np.round(points, _ROUNDED)
