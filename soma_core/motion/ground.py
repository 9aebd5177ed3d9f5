"""Where a played motion stands: its scale, the floor, and a path that keeps planted feet where they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from torch import Tensor

from soma_core.io.joint_order import CONTACT_JOINTS, USER_JOINTS
from soma_core.io.motion import Motion
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = [
    "FootTrack",
    "Soles",
    "contacts_of",
    "floor_height",
    "leg_length",
    "planted_path",
    "rest_offsets",
    "skeleton_of",
    "standing",
]

SLOW = 0.2
"""A foot that is slower than this stands, in heights of the body a second: 0.35 m/s for an adult."""

_SLIDING = 2.0
"""A foot that is faster than this many times what is slow does not stand, whatever a file says."""

_STEADY_SECONDS = 0.1
"""Shorter contacts, and shorter gaps in one, are none, where they are found."""

LOW = 0.03
"""A sole that is no higher above the floor than this touches it, in heights of the body: 5 cm."""

_LAYER = 0.01
"""Heights within this are one floor, in heights of the body: 17 mm."""

_SHARE = 0.5
"""The floor is the lowest layer that holds at least this share of what the fullest one holds."""

_HEEL, _TOE = 0.25, 0.75
"""Skin of a foot that lies behind and before these parts of the way from ankle to toes makes its two ends."""

_RETURN_SECONDS = 1.5
"""How soon the path comes back to the recorded one where no foot holds it."""

_SMOOTH_SECONDS = 0.033
"""How smooth the change of the path is: the time over which its speed may turn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FootTrack:
    """The feet of a played motion, in the order of ``CONTACT_JOINTS``.

    Attributes:
        joints: (frames, 4, 3) places of the joints [m].
        soles: (frames, 4) height of the lowest skin at heels and toes [m].
        lowest: (frames,) height of the lowest skin of the whole body [m].
        height: of the body at rest [m].
    """

    joints: np.ndarray
    soles: np.ndarray
    lowest: np.ndarray
    height: float

    def moved(self, shift: np.ndarray) -> FootTrack:
        """The same feet elsewhere.

        Args:
            shift: (frames, 3) or (3,) [m].
        """
        shift = np.broadcast_to(shift, (len(self.joints), 3))
        return FootTrack(
            joints=self.joints + shift[:, None],
            soles=self.soles + shift[:, None, 1],
            lowest=self.lowest + shift[:, 1],
            height=self.height,
        )


class Soles:
    """The skin under heels and toes.

    Args:
        rig: the canonical one. A rig without feet has none, and nothing stands on them.
    """

    def __init__(self, rig: Rig) -> None:
        names = rig.joint_names
        self.joints = [names.index(name) for name in CONTACT_JOINTS if name in names]
        self._parts = [_ends(rig, side) for side in ("Left", "Right")] if len(self.joints) == 4 else []
        self._ids = [ids for ends in self._parts for ids in ends]

    @property
    def known(self) -> bool:
        """Whether the rig has feet with skin on both ends."""
        return len(self._ids) == len(CONTACT_JOINTS) and all(map(len, self._ids))

    def heights(self, vertices: Tensor) -> np.ndarray:
        """Lowest skin at heels and toes (frames, 4) [m] of posed vertices (frames, v, 3)."""
        lowest = [vertices[:, ids, 1].amin(1).cpu().double().numpy() for ids in self._ids]
        return np.stack(lowest, axis=1)


def _ends(rig: Rig, side: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertex ids of the heel and of the toes of a foot."""
    names = rig.joint_names
    columns = [names.index(side + part) for part in ("Foot", "ToeBase", "ToeEnd") if side + part in names]
    skin = np.flatnonzero(np.asarray(rig.weights[:, columns].sum(axis=1)).ravel() > 0.5)
    ankle, toes = (rig.bind_world[names.index(side + part), :3, 3] for part in ("Foot", "ToeBase"))
    along = (toes - ankle) * [1, 0, 1]
    place = (rig.bind_shape[skin] - ankle) @ along / (along @ along)
    return skin[place < _HEEL], skin[place > _TOE]


def leg_length(offsets: np.ndarray | None) -> float | None:
    """Mean length of thigh and shin together [m] of joint offsets (77, 3); None where they are unknown."""
    if offsets is None:
        return None
    bones = [USER_JOINTS.index(side + part) for side in ("Left", "Right") for part in ("Shin", "Foot")]
    length = float(np.linalg.norm(offsets[bones], axis=1).sum() / 2)
    return length if np.isfinite(length) and length > 0 else None


def skeleton_of(rig: Rig, identity: Identity) -> np.ndarray:
    """Offset of each user joint from its parent in the T-pose (77, 3) [m], of one identity."""
    return rest_offsets(rig, identity.bind_world[0].detach().cpu().double().numpy())


def rest_offsets(rig: Rig, bind_world: np.ndarray) -> np.ndarray:
    """Offset of each user joint from its parent in the T-pose (77, 3) [m]; zero for the Hips.

    Args:
        rig: whose T-pose.
        bind_world: (78, 4, 4) transforms of the joints of a body [m], in any pose.
    """
    joints, parents = np.arange(2, rig.joint_count), rig.parents[2:]
    turned = rig.t_pose_world[parents, :3, :3] @ np.swapaxes(bind_world[parents, :3, :3], -1, -2)
    bones = bind_world[joints, :3, 3] - bind_world[parents, :3, 3]
    return np.concatenate([np.zeros((1, 3)), (turned @ bones[..., None])[..., 0]])


def floor_height(heights: np.ndarray, body: float) -> float:
    """Height of the floor [m] among heights of what stood on it: that of the lowest well-filled layer.

    One frame that pokes through the floor, or a minority, moves it by nothing. Of several floors, such as
    stairs, it is the lowest.

    Args:
        heights: any number of them [m].
        body: height of the body [m], which tells how thick a layer is.
    """
    ordered = np.sort(heights.ravel())
    ends = np.searchsorted(ordered, ordered + _LAYER * body, side="right")
    counts = ends - np.arange(len(ordered))
    first = int(np.argmax(counts >= _SHARE * counts.max()))
    last = first + int(np.argmax(counts[first : ends[first]]))  # the fullest layer that begins in this one
    return float(np.median(ordered[last : ends[last]]))


def standing(track: FootTrack, motion: Motion) -> tuple[np.ndarray, float]:
    """Which heels and toes stand (frames, 4), and the height of the floor [m] that they stand on.

    The file's contacts count where it has any. Else the floor is that of the lowest skin of each frame, of
    knees and hands as well, and on it stands what is low and slow.
    """
    if motion.contacts is not None and motion.contacts.any():
        return motion.contacts, floor_height(track.soles[motion.contacts], track.height)
    floor = floor_height(track.lowest, track.height)
    held = contacts_of(track, motion, floor)
    if held.any():
        soles = floor_height(track.soles[held], track.height)
        floor = soles if abs(soles - floor) < _LAYER * track.height else floor
    return held, floor


def contacts_of(track: FootTrack, motion: Motion, floor: float, *, slow: float = SLOW) -> np.ndarray:
    """Which heels and toes stand (frames, 4): as the file says where they do not run, else the low and slow.

    Args:
        track: the feet of the motion.
        motion: with its frame rate.
        floor: its height [m].
        slow: what is slow, in heights of the body a second.
    """
    speeds = _speeds(track.joints, motion.fps) / (SLOW * track.height)
    if motion.contacts is not None:
        return motion.contacts & (speeds < _SLIDING)
    found = ((speeds < slow / SLOW) & (track.soles < floor + LOW * track.height)).astype(np.int8)
    size = 2 * round(_STEADY_SECONDS * motion.fps / 2 - 0.25) + 1
    for first, second in ((maximum_filter1d, minimum_filter1d), (minimum_filter1d, maximum_filter1d)):
        found = second(first(found, size, axis=0, mode="nearest"), size, axis=0, mode="nearest")
    return found > 0


def _speeds(points: np.ndarray, fps: float) -> np.ndarray:
    """Speed (frames, n) [m/s] of points (frames, n, 3): the smaller of those before and after a frame."""
    steps = fps * np.linalg.norm(np.diff(points, axis=0), axis=-1)
    if not len(steps):
        return np.zeros(points.shape[:2])
    return np.minimum(np.concatenate([steps[:1], steps]), np.concatenate([steps, steps[-1:]]))


def planted_path(track: FootTrack, contacts: np.ndarray, fps: float) -> np.ndarray:
    """Change of the path of the Hips (frames, 3) [m] that keeps planted feet where they are; level.

    Legs of other proportions than the recorded ones take other steps. The change d minimises, over
    frames of length h and with the speed v of each joint in contact,

        sum |v + d'|² + |d|² / return² + (smooth |d''|)²,

    so it follows the feet, returns where none stands, and does not jerk. Feet that slide on purpose, faster
    than what counts as slow, are let slide more and more.
    """
    frames = len(contacts)
    if frames < 3:
        return np.zeros((frames, 3))
    velocity = fps * np.diff(track.joints, axis=0)
    speed = np.linalg.norm(velocity, axis=-1) / (SLOW * track.height)
    weight = np.clip((_SLIDING - speed) / (_SLIDING - 1), 0, 1) * (contacts[1:] & contacts[:-1])
    step, turn = (
        fps * scipy.sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count - 1, count))
        for count in (frames, frames - 1)
    )
    bend = turn @ step
    system = (
        step.T @ scipy.sparse.diags_array(weight.sum(axis=1)) @ step
        + scipy.sparse.eye_array(frames) / _RETURN_SECONDS**2
        + _SMOOTH_SECONDS**2 * bend.T @ bend
    )
    wanted = -step.T @ (weight[..., None] * velocity).sum(axis=1)
    change: np.ndarray = scipy.sparse.linalg.spsolve(scipy.sparse.csc_array(system), wanted)
    change[:, 1] = 0
    return change
