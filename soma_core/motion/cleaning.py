"""Clean-up of motions: frames that stick out, smoothing, another frame rate, the mirror image."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
import torch
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation, Slerp

from soma_core._derived import kind_of
from soma_core.choices import Smooth
from soma_core.errors import InputError, check_type
from soma_core.io.joint_order import USER_JOINTS, other_sides
from soma_core.io.motion import Motion, check_motion
from soma_core.motion.options import CleanOptions, LimbSeconds
from soma_core.motion.quality import motion_quality, relative_rotations
from soma_core.rig import load_canonical

if TYPE_CHECKING:
    from soma_core.layer import SomaLayer
    from soma_core.skeleton.identity import Identity

__all__ = ["Cleaned", "clean", "mirror", "mirrored_body", "resample", "smooth", "without_spikes"]

_LIMBS = {
    "hips": r"Hips", "spine": r"Spine\d|Chest", "head": r"Neck\d|Head|HeadEnd|Jaw|.*Eye",
    "arms": r".*(Shoulder|Arm|ForeArm)", "fingers": r".*Hand(Thumb|Index|Middle|Ring|Pinky).*",
    "hands": r".*Hand", "legs": r".*(Leg|Shin)", "feet": r".*(Foot|ToeBase|ToeEnd)",
}  # fmt: skip
"""Joints of each limb, by their names."""

PRESETS: Mapping[Smooth, LimbSeconds] = {
    Smooth.off: LimbSeconds(),
    Smooth.light: LimbSeconds(
        path=0.025, hips=0.025, spine=0.025, head=0.025, arms=0.02, hands=0.02, fingers=0.025, legs=0.02,
        feet=0.02,
    ),
    Smooth.strong: LimbSeconds(
        path=0.06, hips=0.06, spine=0.06, head=0.06, arms=0.05, hands=0.05, fingers=0.06, legs=0.05, feet=0.05
    ),
}  # fmt: skip
"""Gains [s]: 0.025 keeps three quarters of what swings at 6.4 Hz, the usual limit of gait analysis."""

_SPANS = (1, 3, 6)
"""Error of a cubic over gaps of one frame, two and three, in that over one: products of the distances to its
nodes, over 4. Up to so many frames may stick out together; what lasts longer may be a movement."""

_ROUNDS = 4
"""How often spikes are looked for: those close to others are seen once these are gone."""

_ANGLE, _PLACE = np.radians(15), 0.05
"""How far a joint [rad] and the Hips [m] must at least be from where their neighbours expect them."""

_RATIO, _AROUND = 6.0, 0.5
"""And how many times the median of that within so many seconds before and after."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cleaned:
    """A motion and what was done to it.

    Attributes:
        motion: the cleaned one.
        report: jitter, foot slide and joint ranges ``before`` and ``after``, the ``spikes`` that were
            replaced, and how far frames were ``smoothed`` at most; as plain values.
    """

    motion: Motion
    report: dict[str, Any]


def clean(motion: Motion, *, options: CleanOptions | None = None) -> Cleaned:
    """Replace frames that stick out, smooth, resample and mirror, in this order, as the options say.

    Args:
        motion: on this skeleton.
        options: which of it; left out, spikes go and the motion is smoothed lightly.

    Raises:
        InputError: a rate that is none.
    """
    options = CleanOptions.or_default(options)
    check_motion(motion)
    steady, spikes = without_spikes(motion) if options.spikes else (motion, {})
    smoothed = smooth(steady, _gains(options))
    found = smoothed if options.rate is None else resample(smoothed, options.rate)
    found = mirror(found) if options.mirror else found
    turned, moved = _change(steady, smoothed)
    report = {
        "frames": {"before": motion.frame_count, "after": found.frame_count},
        "fps": {"before": motion.fps, "after": found.fps},
        "spikes": spikes,
        "smoothed": {"degrees": turned, "path_mm": 1e3 * moved},
        "mirrored": options.mirror,
        "before": motion_quality(motion),
        "after": motion_quality(found),
    }
    return Cleaned(motion=found, report=report)


def without_spikes(motion: Motion) -> tuple[Motion, dict[str, list[int]]]:
    """Replace frames in which a joint, or the path, sticks out on both sides of its neighbours.

    A run of up to three frames sticks out where it is further from the cubic through the two frames before
    and after than 15 degrees or 50 mm, and than 6 times what is usual of so many in the second around; and as
    far from the frames next to it, which a step from one pose to another is not. Joints are then
    interpolated along the shortest arc, the path along a line; the first and last frames take the pose
    beside them.

    Args:
        motion: of any length; fewer than five frames stay as they are.

    Returns:
        The motion, and the frames that were replaced, by joint; ``path`` is that of the Hips.
    """
    check_motion(motion)
    found: dict[str, set[int]] = {}
    for _ in range(_ROUNDS):
        motion, replaced = _round(motion)
        if not replaced:
            break
        for name, frames in replaced.items():
            found.setdefault(name, set()).update(frames)
    return motion, {name: sorted(frames) for name, frames in found.items()}


def _round(motion: Motion) -> tuple[Motion, dict[str, list[int]]]:
    """Replace the frames that stick out most; others beside them may stick out only then."""
    times = np.arange(motion.frame_count)
    bad = _spikes(2 * _quaternions(motion.rotations), motion.fps, _ANGLE)
    off = _spikes(motion.translation.astype(np.float64)[:, None], motion.fps, _PLACE)[:, 0]
    rotations, translation, found = motion.rotations.copy(), motion.translation.copy(), {}
    for joint in np.flatnonzero(bad.any(axis=0)):
        gone = bad[:, joint]
        rotations[gone, joint] = _slerp(rotations[~gone, joint], times[~gone], times[gone])
        found[motion.joint_names[joint]] = times[gone].tolist()
    if off.any():
        kept = translation[~off]
        translation[off] = np.stack([np.interp(times[off], times[~off], axis) for axis in kept.T], axis=1)
        found["path"] = times[off].tolist()
    return replace(motion, rotations=rotations, translation=translation), found


def smooth(motion: Motion, seconds: LimbSeconds) -> Motion:
    """Smooth rotations and path without lag: what swings slowly stays, to the ends of the clip.

    Each joint's unit quaternions, and the path, become a smoothing spline, which is what a
    Rauch-Tung-Striebel smoother of constant acceleration finds: x minimises ``|x - y|^2 + (s fps)^6 |d|^2``
    with the third differences d of x, and the gain ``1 / (1 + (2 pi f s)^6)`` of a third-order Butterworth
    filter run forward and backward. What it took away is smoothed again and given back (Tukey's twicing),
    which leaves slow swings alone to the square of that. Quaternions are brought to length one: turns in any
    frame of reference are smoothed alike, and one of constant speed is kept.

    Args:
        motion: of any length; fewer than four frames stay as they are.
        seconds: s of each limb [s]; None and 0 leave it alone.
    """
    check_motion(motion)
    check_type("seconds", seconds, LimbSeconds, fix="Pass LimbSeconds(arms=0.1, ...).")
    if motion.frame_count < 4:
        return motion
    rotations, translation = motion.rotations.copy(), motion.translation
    for limb, gain in asdict(seconds).items():
        if not gain:
            continue
        if limb == "path":
            translation = _spline(motion.translation.astype(np.float64), gain * motion.fps)
            continue
        columns = [row for row, name in enumerate(motion.joint_names) if _limb(name) == limb]
        smoothed = _spline(_quaternions(motion.rotations[:, columns]), gain * motion.fps)
        turned = Rotation.from_quat(smoothed.reshape(-1, 4)).as_matrix()
        rotations[:, columns] = turned.reshape(*smoothed.shape[:2], 3, 3)
    return replace(motion, rotations=rotations, translation=translation)


def resample(motion: Motion, fps: float) -> Motion:
    """Bring a motion to another frame rate, from its first frame on.

    Rotations go along the shortest arc from frame to frame, the path along a cubic spline, and contacts are
    those of the nearest frame. Its own rate changes nothing.

    Args:
        motion: any.
        fps: frames per second.

    Raises:
        InputError: the rate is no positive number.
    """
    check_motion(motion)
    if not (isinstance(fps, Real) and np.isfinite(fps) and fps > 0):
        raise InputError("rate", got=repr(fps), expected="frames per second", fix="Try rate=30.")
    if fps == motion.fps or motion.frame_count == 1:
        return motion if motion.fps == fps else replace(motion, fps=fps)
    own, last = np.arange(motion.frame_count), motion.frame_count - 1
    count = int(np.floor(last / motion.fps * fps + 1e-6)) + 1
    times = np.minimum(np.arange(count) * (motion.fps / fps), last)
    turned = [_slerp(column, own, times) for column in motion.rotations.swapaxes(0, 1)]
    nearest = np.rint(times).astype(int)
    return replace(
        motion,
        rotations=np.stack(turned, axis=1),
        translation=CubicSpline(own, motion.translation.astype(np.float64))(times),
        contacts=None if motion.contacts is None else motion.contacts[nearest],
        expression=None if motion.expression is None else motion.expression[nearest],
        fps=float(fps),
    )


def mirror(motion: Motion) -> Motion:
    """Reflect a motion in the plane x = 0: left and right change places.

    Turns from the T-pose in world axes become ``S R S`` of the joint of the other side, S = diag(-1, 1, 1);
    places, contacts, the recorded skeleton and a kept rest shape follow. Twice is the motion again, to the
    bit, of rotations from the T-pose. On the mirror image of a body, :func:`mirrored_body`, joints and skin
    are the mirror image of what they were, as far as skin weights and pose correctives have that symmetry.

    Args:
        motion: any. Its body's parameters, which know no sides, are kept.
    """
    check_motion(motion)
    flip, other = np.array([-1.0, 1.0, 1.0], np.float32), other_sides(motion.joint_names)
    rotations = _reflected(relative_rotations(motion), other)
    if motion.convention == "absolute_local":
        rig = load_canonical("mid")[1]
        own, above = rig.t_pose_world[1:, :3, :3], rig.t_pose_world[rig.parents[1:], :3, :3]
        rotations = np.swapaxes(above, -1, -2) @ rotations @ own
    return replace(
        motion,
        rotations=rotations,
        translation=motion.translation * flip,
        contacts=None if motion.contacts is None else motion.contacts[:, [2, 3, 0, 1]],
        skeleton=None if motion.skeleton is None else motion.skeleton[other] * flip,
        identity=_mirrored_rest(motion.identity),
        expression=None,  # a face's coefficients have no mirror image
    )


def mirrored_body(layer: SomaLayer, identity: Identity) -> Identity:
    """Mirror image of a body, which mirrored motions are exact on; no body is quite its own mirror image.

    Args:
        layer: whose mesh and rig the body is of.
        identity: any number of them; their parameters are kept, and are those of the body before.
    """
    kind_of(layer)
    layer.check_identity(identity)
    other = [0, *(1 + row for row in other_sides(USER_JOINTS))]
    partner = torch.as_tensor(layer.mesh.mirror.astype(np.int64), device=identity.rest.device)
    flip = identity.rest.new_tensor([-1.0, 1.0, 1.0])
    zero = torch.tensor(layer.rig.t_pose_world[:, :3, :3]).to(identity.rest)

    def skeleton(world: torch.Tensor) -> torch.Tensor:
        turned = (world[..., :3, :3] @ zero.transpose(-1, -2))[:, other] * (flip[:, None] * flip)
        changed = world[:, other].clone()
        changed[..., :3, :3], changed[..., :3, 3] = turned @ zero, world[:, other, :3, 3] * flip
        return changed

    return replace(
        identity,
        rest=identity.rest[:, partner] * flip,
        bind_world=skeleton(identity.bind_world),
        fitted_rest=identity.fitted_rest[:, partner] * flip,
        fitted_world=skeleton(identity.fitted_world),
    )


def _mirrored_rest(identity: Mapping[str, Any]) -> Mapping[str, Any]:
    """The kept body, its rest shape mirrored if it has one."""
    if identity.get("rest") is None:
        return identity
    rest = np.asarray(identity["rest"])
    for lod in ("mid", "low"):
        partner = load_canonical(lod)[0].mirror
        if len(partner) == len(rest):
            return {**identity, "rest": rest[partner] * np.array([-1, 1, 1], rest.dtype)}
    return identity


def _reflected(rotations: np.ndarray, other: list[int]) -> np.ndarray:
    """``S R S`` of the joints of the other side; only signs change."""
    signs = np.outer([-1, 1, 1], [-1, 1, 1]).astype(rotations.dtype)
    return rotations[:, other] * signs


def _limb(name: str) -> str | None:
    return next((limb for limb, pattern in _LIMBS.items() if re.fullmatch(pattern, name)), None)


def _gains(options: CleanOptions) -> LimbSeconds:
    """Those of the preset, and the limbs' own where they are given."""
    own = {limb: value for limb, value in asdict(options.seconds).items() if value is not None}
    return LimbSeconds(**{**asdict(PRESETS[options.smooth]), **own})


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions (frames, joints, 4) of matrices, of the sign that makes them continuous in time."""
    found = Rotation.from_matrix(rotations.reshape(-1, 3, 3).astype(np.float64)).as_quat()
    found = found.reshape(*rotations.shape[:2], 4)
    turns = np.where((found[1:] * found[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    found[1:] *= np.cumprod(turns, axis=0)[..., None]
    return found


def _slerp(rotations: np.ndarray, times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) at other times; before the first and after the last they stay."""
    if len(times) == 1:
        return np.repeat(rotations, len(wanted), axis=0)
    turns = Rotation.from_matrix(rotations.astype(np.float64))
    return Slerp(times, turns)(np.clip(wanted, times[0], times[-1])).as_matrix()


def _spline(values: np.ndarray, frames: float) -> np.ndarray:
    """Values (n, ...) of a twiced smoothing spline whose gain is so many frames."""
    count, flat = len(values), values.reshape(len(values), -1)
    turn = scipy.sparse.diags_array([-1.0, 3.0, -3.0, 1.0], offsets=range(4), shape=(count - 3, count))
    system = (scipy.sparse.eye_array(count) + frames**6 * (turn.T @ turn)).todia()
    banded = np.zeros((4, count))
    for offset in range(4):
        banded[offset, : count - offset] = system.diagonal(offset)
    first = solveh_banded(banded, flat, lower=True)
    twiced = first + solveh_banded(banded, flat - first, lower=True)
    return twiced.reshape(values.shape)


def _spikes(values: np.ndarray, fps: float, least: float) -> np.ndarray:
    """Which frames (n, columns) of values (n, columns, d) stick out, by at least so much."""
    bad = np.zeros(values.shape[:2], bool)
    if len(values) < 5:
        return bad
    scores = [_sticking_out(values, length) for length in range(1, len(_SPANS) + 1)]
    around = min(2 * round(_AROUND * fps), 2 * len(values)) + 1
    usual = median_filter(scores[0], (around, 1), mode="mirror")
    over = [
        score > np.maximum(_RATIO * span * usual, least) for span, score in zip(_SPANS, scores, strict=True)
    ]
    for column in np.flatnonzero(np.any(over, axis=(0, 1))):
        runs = [
            (scores[index][start, column], start, index + 1)
            for index, found in enumerate(over) for start in np.flatnonzero(found[:, column])
        ]  # fmt: skip
        taken = np.zeros(len(values) + 2 * len(_SPANS), bool)  # a spike also bends what is expected beside it
        for _, start, length in sorted(runs, reverse=True):
            if not taken[start : start + length + 2 * len(_SPANS)].any():
                bad[start : start + length, column] = True
                taken[start + len(_SPANS) : start + len(_SPANS) + length] = True
    return bad


def _sticking_out(values: np.ndarray, length: int) -> np.ndarray:
    """How far the run of so many frames from each frame on sticks out (n, columns), at the least of them."""
    count = len(values)
    out = np.zeros(values.shape[:2])
    padded = np.concatenate([values[:1], values, values[-1:]])
    starts = np.arange(1, count - length)
    nodes = np.array([-2, -1, length, length + 1])
    expected_from = padded[starts[:, None] + 1 + nodes]
    far = np.full((len(starts), values.shape[1]), np.inf)
    for place in range(length):
        weights = [np.prod([(place - m) / (n - m) for m in nodes if m != n]) for n in nodes]
        expected = np.tensordot(weights, expected_from, axes=(0, 1))
        far = np.minimum(far, _norm(values[starts + place] - expected))
    beside = [values[starts] - values[starts - 1], values[starts + length - 1] - values[starts + length]]
    out[starts] = np.minimum(far, np.minimum(*map(_norm, beside)))
    if length == 1:
        for end, (one, two, three) in ((0, values[1:4]), (-1, values[-2:-5:-1])):
            guesses = one, two, 2 * one - two, 3 * one - 3 * two + three
            out[end] = np.min([_norm(values[end] - guess) for guess in guesses], axis=0)
    return out


def _norm(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1)


def _change(first: Motion, second: Motion) -> tuple[float, float]:
    """Largest turn [degrees] and way of the Hips [m] from one motion to another of the same frames."""
    between = np.swapaxes(first.rotations, -1, -2).astype(np.float64) @ second.rotations
    angles = Rotation.from_matrix(between.reshape(-1, 3, 3)).magnitude()
    return float(np.degrees(angles.max())), float(_norm(second.translation - first.translation).max())
