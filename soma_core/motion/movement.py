"""Questions to how a body moves: joints bent backwards, frames that repeat, a path its feet do not walk."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

from soma_core.inversion.point_priors import JointPrior
from soma_core.io.joint_order import CONTACT_JOINTS, USER_JOINTS, nearest_ancestors, other_sides
from soma_core.io.motion import Motion
from soma_core.motion.quality import joint_places, relative_rotations, turns_about
from soma_core.rig import load_canonical
from soma_core.topology.frames import METRES

__all__ = ["LOOKED", "of_movement"]

LOOKED = 3000
"""Frames, from the first, that are looked at."""

_POSES = 100
"""Of these, frames spread over them whose joints are looked at."""

_HINGES = ("LeftForeArm", "RightForeArm", "LeftShin", "RightShin")
_BENT, _BACKWARDS, _ASIDE = 25.0, -25.0, 60.0
"""Degrees by which elbows and knees count as bent, as bent backwards, and as turned otherwise: people's
overstretch by 15, and estimators turn them about other axes by 30."""

_WRONG = 0.2
"""Share of bent hinges that bend as none can: 0 to 0.07 in recorded motions, 0.28 to 1 in mistaken ones."""

_FAR, _NEARER = 1.8, 0.6
"""Standard deviations by which joints are off on average, 0.7 to 1.4 in recorded motions, and the share of
them that another reading leaves at most, where the hinges tell nothing."""

_FROZEN, _CHANGES = 10, 8
"""Frames of a clip that is meant to move, and changes of pose that have a rhythm."""

_SAME = 2e-5
"""Largest entry of a rotation, and metres of the path, by which two frames are one: what fits leave."""

_RHYTHM, _DOUBLED = 0.95, 1.15
"""Share of the stretches without change that have one length or the next, and their mean in frames."""

_RATES, _NEAR_RATE = (12, 12.5, 15, 20, 24, 25, 30, 50, 60, 100, 120), 0.015
"""Usual frame rates, and how far off one is taken for it."""

_STRIDE = 0.07
"""Time [s] over which steps are measured: a foot that stands is still as long as that."""

_SCALES = np.geomspace(1 / 150, 4, 121)
"""Factors on the path that are tried; the unit of a millimetre is told by the height of the hips."""

_SLIDES, _WALKS, _FITS, _NEAR = 0.15, 0.6, 0.5, 1.4
"""Least speed [m/s] by which feet slide, shares of the slide with the path left out and as it is that the
right path leaves at most, and the least factor that is none of legs of another length."""

_CLOSE_UNIT = 1.3
"""Factor by which a unit may differ from what the feet walk, of a person with other legs."""

_SMOOTH, _GRAVITY, _LEAST_GRAVITY = 0.1, 9.81, 5.0
"""Time [s] over which a push is measured, and what a body weighs [m/s^2]."""

_STEADY = 0.5
"""Likeness of a step from one frame to the next and the one after it; that of jitter is -0.5."""

_STANDS, _BESIDE, _LEANS = 0.1, 0.4, 2.0
"""Height [m] above the lowest within which a foot may stand; how far [m] from the feet, and times the
distance of the weight itself, a body is pushed at most: 0.2 m and 1.2 times in a run."""


def of_movement(
    motion: Motion,
    *,
    unit: str = "unit",
    fps: str = "fps",
    turns: Collection[str] = (),
    path: bool = True,
    told: Sequence[str] = (),
    to: str = "",
) -> list[str]:
    """What is doubtful about poses, frames and path of a motion; its first frames tell.

    Args:
        motion: on this skeleton.
        unit, fps: what the settings are called that mend it.
        turns: settings that its file takes, of ``rotation_layout``, ``swap_sides`` and ``convention``.
        path: whether the path is looked at; not where axes or the size of the body are doubtful already.
        to: of which command these settings are, in words.
        told: what is doubtful about the path by itself, which says less than what the feet walk.
    """
    motion = motion.cut(slice(0, LOOKED))
    poses = _of_poses(motion, turns, to)
    frames = _of_frames(motion)
    if poses or frames or not path:
        return [*poses, *frames, *told]
    return _of_steps(motion, unit) or [*told] or _of_balance(motion, fps)


def _of_poses(motion: Motion, turns: Collection[str], to: str) -> list[str]:
    """Whether elbows and knees bend as none do, and which reading of its rotations would mend it."""
    turned = relative_rotations(motion.cut(slice(None, None, max(motion.frame_count // _POSES, 1))))
    share, far = _backwards(turned), _far(turned)
    if share < _WRONG and far < _FAR:
        return []
    mends = {
        "rotation_layout": "its matrices are stored column by column, pass rotation_layout=columns",
        "swap_sides": "left and right are exchanged, pass swap_sides=true",
        "convention": f"its rotations have another zero, pass convention={_other_zero(motion)}",
    }
    readings = [*_READINGS, ("convention", _with_other_zero(motion))]
    rated = [(_far(read(turned)), name) for name, read in readings if _backwards(read(turned)) < _WRONG]
    nearest, best = min(rated, default=(far, ""))
    if share >= _WRONG:
        told = f"elbows and knees bend backwards or sideways in {share:.0%} of the frames in which they bend"
    elif nearest < _NEARER * far:
        told = f"joints turn further than those of bodies do, by {far:.1f} standard deviations on average"
    else:
        return []
    if best in turns:
        return [f"{told}; if {mends[best]}{to}"]
    return [f"{told}: axes, order or zero of its rotations are not what they are taken for; export it again"]


def _transposed(turned: np.ndarray) -> np.ndarray:
    return np.swapaxes(turned, -1, -2)


def _transposed_in_the_world(turned: np.ndarray) -> np.ndarray:
    """The same where world rotations were transposed, and then made local."""
    world, above = turned.astype(np.float64), nearest_ancestors(USER_JOINTS)
    for joint, parent in enumerate(above):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ world[:, joint]
    local = _transposed(world).copy()
    for joint, parent in enumerate(above):
        if parent >= 0:
            local[:, joint] = world[:, parent] @ _transposed(world[:, joint])
    return local


def _with_sides_exchanged(turned: np.ndarray) -> np.ndarray:
    return turned[:, other_sides(USER_JOINTS)]


def _other_zero(motion: Motion) -> str:
    return "absolute_local" if motion.convention == "t_pose_relative" else "t_pose_relative"


def _with_other_zero(motion: Motion) -> Callable[[np.ndarray], np.ndarray]:
    """Rotations from the T-pose that the file holds if its rotations have the other zero."""
    rig = load_canonical("mid")[1]
    own, above = rig.t_pose_world[1:, :3, :3], rig.t_pose_world[rig.parents[1:], :3, :3]
    if motion.convention == "t_pose_relative":
        return lambda turned: above @ turned @ _transposed(own)
    return lambda turned: _transposed(above) @ turned @ own


_READINGS: tuple[tuple[str, Callable[[np.ndarray], np.ndarray]], ...] = (
    ("rotation_layout", _transposed), ("rotation_layout", _transposed_in_the_world),
    ("swap_sides", _with_sides_exchanged),
)  # fmt: skip
"""Other readings of rotations (frames, 77, 3, 3), and the settings that have them."""


def _backwards(turned: np.ndarray) -> float:
    """Share of bent elbows and knees that bend as none can, by turns (frames, 77, 3, 3) from the T-pose."""
    wrong, bent = 0, 0
    for name in _HINGES:
        known = JointPrior().range_of(name)
        assert known is not None
        about, across = turns_about(known, turned[:, USER_JOINTS.index(name)], expected=False)
        wrong += int(((about < _BACKWARDS) | (across > _ASIDE)).sum())
        bent += int((np.hypot(about, across) > _BENT).sum())
    return wrong / max(bent, 1)


def _far(turned: np.ndarray) -> float:
    """How far joints of limbs and trunk are from where they are expected, in standard deviations."""
    far = []
    for name in USER_JOINTS:
        known = JointPrior().range_of(name)
        if known is not None and "Hand" not in name and "Eye" not in name:
            about, across = turns_about(known, turned[:, USER_JOINTS.index(name)])
            far.append(np.minimum(np.hypot(about / known.spread[0], across / known.spread[1]), 5))
    return float(np.mean(far))


def _of_frames(motion: Motion) -> list[str]:
    """Whether all frames are one, or frames repeat in a rhythm, as of a clip of another rate."""
    count = motion.frame_count
    if count < _FROZEN:
        return []
    turned = np.array([
        float(np.abs(after - before).max())
        for before, after in zip(motion.rotations[:-1], motion.rotations[1:], strict=True)
    ])  # fmt: skip
    moved = np.abs(np.diff(motion.translation, axis=0)).max(axis=1)
    if turned.max() <= _SAME:
        along = " while its hips move" if moved.max() > _SAME else ""
        return [
            f"its {count} frames hold one pose{along}; if it should move, export it with a key in every "
            "frame, and if not, frames.stop=1 of soma animate takes one of them"
        ]
    changes = np.flatnonzero((turned > _SAME) | (moved > _SAME))
    gaps = np.diff(changes)
    if len(gaps) < _CHANGES:
        return []
    usual = int(np.median(gaps))
    steady = np.isin(gaps, (usual, usual + 1))  # a pose that is held for a while is none of the rhythm
    mean = float(gaps[steady].mean()) if steady.any() else 1.0
    if steady.mean() < _RHYTHM or mean < _DOUBLED:
        return []
    rate = motion.fps / mean
    near = min(_RATES, key=lambda usual: abs(usual - rate))
    rate = near if abs(near - rate) < _NEAR_RATE * rate else rate
    return [
        f"{1 - len(changes) / (count - 1):.0%} of its frames repeat the one before, as of a clip of "
        f"{rate:.4g} frames a second that was written at {motion.fps:g}; soma clean rate={rate:.4g} takes "
        "them out"
    ]


def _of_steps(motion: Motion, unit: str) -> list[str]:
    """Whether feet that stand stay where they are, or would if the path were of another length."""
    span = max(round(_STRIDE * motion.fps), 1)
    if motion.frame_count < 2 * span + 2:
        return []
    places = joint_places(motion)
    feet = places[:, [USER_JOINTS.index(name) for name in CONTACT_JOINTS]] - places[:, :1]
    rate = motion.fps / span
    own = rate * (feet[span:] - feet[:-span])[..., [0, 2]]
    hips = rate * (places[span:, 0] - places[:-span, 0])[:, [0, 2]]

    def slide(scale: float) -> float:
        return float(np.linalg.norm(own + scale * hips[:, None], axis=-1).min(axis=1).mean())

    left = np.array([slide(scale) for scale in _SCALES])
    best, least = float(_SCALES[left.argmin()]), float(left.min())
    now, still = slide(1.0), slide(0.0)
    longer = best < 1 / _NEAR or (best > _NEAR and motion.skeleton is not None)
    if not longer or now - least < _SLIDES or least > _FITS * now or least > _WALKS * still:
        return []
    found = f"its path is {1 / best:.3g} times as long as its feet walk"
    near = [name for name, metres in METRES.items() if abs(np.log(metres / best)) < np.log(_CLOSE_UNIT)]
    if near:
        return [f"{found}; if its lengths are in {near[0]}, pass {unit}={near[0]}"]
    return [f"{found}; if path and rotations were sampled at other rates, export both at one"]


def _of_balance(motion: Motion, fps: str) -> list[str]:
    """Whether feet can push a body so: what pushes it must pass near one that stands."""
    edge = int(np.ceil(2 * _SMOOTH * motion.fps))
    if motion.frame_count < 3 * edge:
        return []
    places = joint_places(motion)
    feet = places[:, [USER_JOINTS.index(name) for name in CONTACT_JOINTS]]
    weight = 0.7 * places[:, 0] + 0.3 * places[:, USER_JOINTS.index("Chest")]
    steps = np.diff(weight, axis=0)
    if (steps[1:] * steps[:-1]).sum() < _STEADY * (steps**2).sum():
        return []  # jitter, which says nothing of a rate
    smooth = gaussian_filter1d(weight, _SMOOTH * motion.fps, axis=0)
    push = np.gradient(np.gradient(smooth, axis=0), axis=0) * motion.fps**2
    lowest = feet[..., 1].min(axis=1)
    carried = np.maximum(_GRAVITY + push[:, 1], _LEAST_GRAVITY)
    pushed = weight - ((weight[:, 1] - lowest) / carried)[:, None] * push
    stands = feet[..., 1] < lowest[:, None] + _STANDS
    beside, leans = (
        float(np.where(stands, np.linalg.norm((feet - point[:, None])[..., [0, 2]], axis=-1), np.inf)
              .min(axis=1)[edge:-edge].mean())
        for point in (pushed, weight)
    )  # fmt: skip
    if beside < max(_BESIDE, _LEANS * leans):
        return []
    return [
        f"at {motion.fps:g} frames a second no feet could push a body so, {beside:.2g} m beside them on "
        f"average; if the frame rate is wrong, pass {fps}=30 (the true rate)"
    ]
