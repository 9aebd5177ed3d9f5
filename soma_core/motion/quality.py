"""How a motion is, in numbers: its jitter, feet that slide, joints beyond their range."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.inversion.point_priors import JointPrior, JointRange
from soma_core.io.joint_order import CONTACT_JOINTS, USER_JOINTS
from soma_core.io.motion import Motion, check_motion
from soma_core.motion.ground import FootTrack, contacts_of, floor_height, rest_offsets
from soma_core.rig import load_canonical

__all__ = ["joint_places", "motion_quality", "relative_rotations", "turns_about"]

_STILL = 0.1
"""A foot stands where no file says so if it is slower, in heights of the body a second: one that lands or
leaves slides by no fault. What kimodo's files say of theirs agrees best with this."""

_FAR = 3.0
"""Standard deviations of a joint's expected turn beyond which it is out of its range."""


def motion_quality(motion: Motion) -> dict[str, Any]:
    """Jitter, foot slide and joint ranges of a motion, as plain values.

    The joints are those of the recorded skeleton, or of the mean body. ``jitter_m_s3`` is the mean jerk of
    all joints. ``foot_slide_mm_s`` is the mean level speed of heels and toes that stand, as the file says or
    as the low and slow do, in ``foot_contacts`` of all their frames; None where none does. ``joint_range``
    has, for each joint that is further from its expected pose than three of the standard deviations of
    ``soma_core.JointPrior``, the share of such frames and the largest of these distances.

    Args:
        motion: any.
    """
    check_motion(motion)
    places = joint_places(motion)
    jitter = 0.0
    if motion.frame_count > 3:
        jerk = np.linalg.norm(np.diff(places, n=3, axis=0), axis=-1) * motion.fps**3
        jitter = float(jerk.mean())
    return {"jitter_m_s3": jitter, **_foot_slide(motion, places), "joint_range": _joint_range(motion)}


def relative_rotations(motion: Motion) -> np.ndarray:
    """Rotations (frames, 77, 3, 3) from the T-pose, whatever zero those of the motion have."""
    if motion.convention == "t_pose_relative":
        return motion.rotations
    rig = load_canonical("mid")[1]
    own, above = rig.t_pose_world[1:, :3, :3], rig.t_pose_world[rig.parents[1:], :3, :3]
    relative: np.ndarray = above @ motion.rotations @ np.swapaxes(own, -1, -2)
    return relative


def joint_places(motion: Motion) -> np.ndarray:
    """Places (frames, 77, 3) [m] of the joints, on the recorded skeleton or that of the mean body."""
    rig = load_canonical("mid")[1]
    offsets = rest_offsets(rig, rig.bind_world)
    if motion.skeleton is not None:
        offsets = np.where(np.isfinite(motion.skeleton), motion.skeleton, offsets)
    turned = relative_rotations(motion).astype(np.float64)
    places = np.empty(turned.shape[:3])
    places[:, 0] = motion.translation
    for joint, parent in enumerate(rig.parents[2:] - 1, start=1):
        places[:, joint] = places[:, parent] + turned[:, parent] @ offsets[joint]
        turned[:, joint] = turned[:, parent] @ turned[:, joint]
    return places


def _foot_slide(motion: Motion, places: np.ndarray) -> dict[str, float | None]:
    """Mean level speed of heels and toes that stand [mm/s], and the share of frames in which they do."""
    feet = places[:, [USER_JOINTS.index(name) for name in CONTACT_JOINTS]]
    height = float(np.ptp(joint_places(_rest(motion))[..., 1]))
    floors = [floor_height(column, height) for column in feet[..., 1].T]
    track = FootTrack(joints=feet, soles=feet[..., 1] - floors, lowest=feet[..., 1].min(1), height=height)
    held = contacts_of(track, motion, 0.0, slow=_STILL)
    both = held[1:] & held[:-1]
    speeds = 1e3 * motion.fps * np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=-1)
    slide = float(speeds[both].mean()) if both.any() else None
    return {"foot_slide_mm_s": slide, "foot_contacts": float(held.mean())}


def _rest(motion: Motion) -> Motion:
    """One frame of it in the T-pose."""
    frame = motion.cut(slice(0, 1))
    turned = np.eye(3, dtype=np.float32) + 0 * frame.rotations
    return Motion(
        rotations=turned, translation=frame.translation, fps=motion.fps, joint_names=motion.joint_names,
        skeleton=motion.skeleton,
    )  # fmt: skip


def _joint_range(motion: Motion) -> dict[str, dict[str, float]]:
    """Joints that leave their range: the share of frames, and the furthest in standard deviations."""
    prior, found, relative = JointPrior(), {}, relative_rotations(motion)
    for row, name in enumerate(motion.joint_names):
        known = prior.range_of(name)
        if known is None:
            continue
        about, across = turns_about(known, relative[:, row])
        far = np.hypot(about / known.spread[0], across / known.spread[1])
        if far.max() > _FAR:
            found[name] = {"share": float((far > _FAR).mean()), "deviations": float(far.max())}
    return found


def turns_about(
    known: JointRange, turned: np.ndarray, *, expected: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Turns [degrees] about a joint's axis, and across it, of rotations (frames, 3, 3) from the T-pose.

    Args:
        known: the joint's range.
        turned: rotations.
        expected: whether they are measured from where the joint is expected, or from the T-pose.
    """
    turns = Rotation.from_matrix(turned)
    if expected:
        turns = turns * Rotation.from_rotvec(known.rest, degrees=True).inv()
    vectors = np.degrees(turns.as_rotvec())
    axis = np.asarray(known.axis) / np.linalg.norm(known.axis)
    about = vectors @ axis
    return about, np.linalg.norm(vectors - about[:, None] * axis, axis=1)
