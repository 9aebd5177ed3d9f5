"""Poses to learn from: random ones within the limits of human joints, and mirror images of any."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["mirror_rotations", "random_rotations"]

_Range = tuple[float, float]

_NECK = ((-25, 25), (-30, 30), (-20, 20))
_SPINE = ((-12, 28), (-18, 18), (-15, 15))
_LIMITS: tuple[tuple[str, tuple[_Range, _Range, _Range]], ...] = (
    # joint, then degrees about x, y and z of the T-pose world (+X the body's left, +Y up, +Z forward)
    (r"Hips", ((-25, 25), (-25, 25), (-25, 25))),
    (r"Spine\d|Chest", _SPINE),
    (r"Neck\d|Head", _NECK),
    (r"Shoulder", ((-12, 12), (-25, 20), (-12, 30))),
    (r"Arm", ((-80, 70), (-125, 40), (-85, 85))),
    (r"ForeArm", ((-80, 80), (-145, 5), (-8, 8))),
    (r"Hand", ((-20, 20), (-30, 30), (-75, 70))),
    (r"HandThumb1", ((-25, 25), (-40, 25), (-30, 30))),
    (r"HandThumb[23]", ((-10, 10), (-60, 15), (-45, 15))),
    (r"Hand(Index|Middle|Ring|Pinky)1", ((-5, 5), (-8, 8), (-12, 8))),
    (r"Hand(Index|Middle|Ring|Pinky)2", ((-5, 5), (-18, 18), (-95, 25))),
    (r"Hand(Index|Middle|Ring|Pinky)3", ((-3, 3), (-3, 3), (-110, 5))),
    (r"Hand(Index|Middle|Ring|Pinky)4", ((-3, 3), (-3, 3), (-80, 5))),
    (r"Leg", ((-125, 30), (-40, 40), (-25, 50))),
    (r"Shin", ((-5, 145), (-15, 15), (-5, 5))),
    (r"Foot", ((-30, 50), (-20, 20), (-25, 20))),
    (r"ToeBase", ((-60, 35), (-5, 5), (-5, 5))),
)
"""Ranges of the left side, rounded from clinical tables of passive motion; the right side mirrors them."""

_HANGING = {
    "Shoulder": ((10, -6, -5), ((-12, 12), (-14, 12), (-14, 16))),
    "Arm": ((0, -8, -60), ((-40, 40), (-35, 35), (-35, 40))),
}
"""Where a joint is most of the day rather than in the T-pose: centre, and ranges about it, in degrees."""


def _twist_axis(part: str) -> int:
    """Axis about which a joint twists in the T-pose: x in the arms, y in the trunk and legs."""
    return 0 if re.search("Shoulder|Arm|Hand", part) else 1


def random_rotations(
    names: Sequence[str], count: int, random: np.random.Generator, *, hanging: bool = False
) -> np.ndarray:
    """T-pose-relative rotations, (count, J, 3, 3), within the limits of each joint.

    Every limb of every pose is active to a degree of its own between nothing and its full range, so that
    mild and extreme poses are both met, and joints along a limb are extreme together. Joints that the
    table does not list stay at rest.

    Args:
        names: J joint names.
        count: poses.
        random: source of the angles.
        hanging: the arms hang, as those of people who stand and walk do.
    """
    rotations = np.tile(np.eye(3), (count, len(names), 1, 1))
    activity: dict[str, np.ndarray] = {}
    for index, name in enumerate(names):
        side = next((side for side in ("Left", "Right") if name.startswith(side)), "")
        part = name.removeprefix(side)
        limits = next((limits for pattern, limits in _LIMITS if re.fullmatch(pattern, part)), None)
        if limits is None:
            continue
        centre: tuple[float, float, float] = (0, 0, 0)
        if hanging:
            centre, limits = _HANGING.get(part, (centre, limits))
        limb = side + ("Hand" if re.match(r"Hand\w", part) else "Leg" if _twist_axis(part) else "Arm")
        share = activity.setdefault(limb, random.uniform(0.15, 1.0, (count, 1)))
        low, high = np.radians(np.array(limits, float)).T
        drawn = random.uniform(-1, 1, (count, 3))
        angles = np.radians(centre) + share * np.where(drawn < 0, -drawn * low, drawn * high)
        angles *= [1, -1, -1] if side == "Right" else 1
        rotations[:, index] = _swing_twist(angles, _twist_axis(part))
    return rotations


def _swing_twist(angles: np.ndarray, axis: int) -> np.ndarray:
    """Turn about `axis` first, then swing by the other two angles together; (n, 3) -> (n, 3, 3)."""
    swing, twist = angles.copy(), np.zeros_like(angles)
    swing[:, axis], twist[:, axis] = 0, angles[:, axis]
    return (Rotation.from_rotvec(swing) * Rotation.from_rotvec(twist)).as_matrix()


def mirror_rotations(rotations: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Mirror T-pose-relative rotations (..., J, 3, 3) in the plane x = 0; left and right joints swap."""
    places = {name: index for index, name in enumerate(names)}
    swapped = [name.replace("Left", "\0").replace("Right", "Left").replace("\0", "Right") for name in names]
    flip = np.array([-1.0, 1, 1])
    return flip[:, None] * rotations[..., [places[name] for name in swapped], :, :] * flip
