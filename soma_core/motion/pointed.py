"""Motions from points: files of joints, keypoints or markers, fitted on this skeleton."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from soma_core.errors import InputError
from soma_core.inversion.point_identity import fit_point_identity
from soma_core.inversion.points import PointInversion
from soma_core.io.camera import Camera, read_cameras
from soma_core.io.motion import Motion
from soma_core.io.point_files import PointFrames, read_points
from soma_core.motion.identities import kept_identity
from soma_core.motion.models import open_layer, under
from soma_core.motion.options import SIGNED, ConvertOptions, FitOptions
from soma_core.motion.posed_input import world_axes
from soma_core.motion.questions import Names, of_motion, of_rate, say
from soma_core.options import IdentityChoice
from soma_core.points.point_set import load_point_set
from soma_core.topology.frames import METRES

if TYPE_CHECKING:
    from soma_core.inversion.result import PointResult
    from soma_core.skeleton.identity import Identity

__all__ = ["Pointed", "from_points"]

_log = logging.getLogger(__name__)

_SIZES = (0.6, 1.5)
"""A person this much smaller or larger than the body is said; a newborn has 0.3 of an adult."""

_EXCHANGED, _TRIED = 5e-3, 24
"""Sides are doubted where points miss by more [m], and tried on so many frames."""

_LEAST_FRAMES = 60
"""A body is found from so many frames of points, or more: each tells little."""

_MISSED, _MISSED_SHARE = 0.05, 0.03
"""Errors that are said: [m], or beside the size of the person in the picture."""


class Pointed:
    """A motion that was fitted to points.

    Attributes:
        motion: on this skeleton, of the body with the lengths of the points.
        report: figures for people and programs.
    """

    def __init__(self, motion: Motion, report: dict[str, Any]) -> None:
        self.motion, self.report = motion, report


def from_points(path: Path, options: FitOptions, *, person: str | None = None) -> Pointed:
    """Read points of a set, and fit a motion to them.

    Raises:
        SomaError: the file, the set or the backend cannot be used, or no frame has enough points.
    """
    assert options.points is not None
    points = load_point_set(options.points)
    cameras = () if options.camera is None else _cameras(options)
    found = _without_zeros(path, read_points(path, points.names, person=person, views=len(cameras)))
    fps = options.fps or found.fps
    if fps is None:
        raise InputError(
            f"{path.name}: fps", got="none", expected="frames per second", fix="Pass fps=30 (the true rate)."
        )
    say(path.name, of_rate(fps))
    name = options.backend.name if options.backend is not None else "soma"
    given = dict(options.backend.options) if options.backend is not None else {}
    layer = open_layer(options, name, given)
    places, scale = _in_metres(path, found, options)
    order = _other_sides(points.names)
    if isinstance(options, ConvertOptions) and options.swap_sides:
        places, sure = places[..., order, :], found.confidence
        found = replace(found, confidence=None if sure is None else sure[..., order])
    inversion = PointInversion(layer, points)
    weights = None if found.confidence is None else torch.as_tensor(found.confidence).to(places)
    try:
        identity, lengths = _body(inversion, places, weights, cameras, options)
        result = inversion(
            places, identity, weights=weights, bone_scale=lengths, fps=fps, cameras=cameras or None
        )
    except InputError as error:
        if error.argument == "points" and "Multiply" in error.fix:
            raise _unit_error(path, error, scale) from error
        raise
    if not bool(result.valid.any()):
        raise InputError(
            str(path), got="three known points in no frame", expected=f"points of {points.name}",
            fix="Look at the order of the points, and at their confidence.",
        )  # fmt: skip
    kept = {} if options.identity.method == "known" else kept_identity(layer, identity)
    motion = Motion(
        rotations=result.rotations.cpu().numpy(), translation=result.translation.cpu().numpy(), fps=fps,
        joint_names=layer.joint_names, rig_revision=layer.rig.revision, source=str(path), identity=kept,
        skeleton=layer.animation.bone_vectors(identity, lengths)[0, 1:].cpu().numpy(),
    )  # fmt: skip
    names = Names(ups=tuple(SIGNED) if options.upward is None else ())
    extent = None if not cameras else _extent(found.positions)
    doubts = _doubts(result, lengths, extent)
    if not cameras:
        doubts += _exchanged(inversion, places[:, order], identity, lengths, result)
    say(path.name, [*of_motion(motion, names), *doubts])
    report = {"identity": kept or None, **_report(points.name, found, result, lengths, motion)}
    noise = f"{1e3 * result.noise:.1f} mm" if extent is None else f"{result.noise:.1f} px"
    _log.info(
        "%s: %s, %d frames of %d points at %g fps; noise %s",
        path.name, found.layout, motion.frame_count, len(points), fps, noise,
    )  # fmt: skip
    return Pointed(motion, report)


def _body(
    inversion: PointInversion,
    places: torch.Tensor,
    weights: torch.Tensor | None,
    cameras: tuple[Camera, ...],
    options: FitOptions,
) -> tuple[Identity, torch.Tensor | None]:
    """The body, and factors of its bones where it is made as long as the points are.

    Raises:
        InputError: one that is not known is sought by a single view, or vertex by vertex.
    """
    params = dict(options.backend.params) if options.backend is not None else {}
    choice = options.identity
    if choice.method == "known":
        body = inversion.layer.identity(params)
        if len(cameras) == 1:
            return body, None
        return body, inversion.bone_scale(places, body, cameras=cameras or None)
    if choice.method != "backend" or len(cameras) == 1:
        got = (
            f"{choice.method} of points" if choice.method != "backend" else "one view, which tells no length"
        )
        raise InputError(
            "identity", got=got, expected="parameters of a backend, from points in space or several views",
            fix="Pass identity=known, and what is known of the body as backend.params.KEY=VALUE.",
        )  # fmt: skip
    if cameras:
        places, met = inversion.triangulated(places, cameras, weights)
        weights = met
    with under(IdentityChoice, "identity"):
        found = fit_point_identity(
            inversion, places, weights=weights, start=params, free=choice.free,
            frames=max(choice.frames, _LEAST_FRAMES), iterations=choice.iterations,
        )  # fmt: skip
    short = {name: value.item() for name, value in found.params.items() if value.numel() == 1}
    if short:
        _log.info("found %s", ", ".join(f"{name}={value:.3g}" for name, value in short.items()))
    return found.identity, None


def _cameras(options: FitOptions) -> tuple[Camera, ...]:
    """The cameras, in a world of metres with +Y up."""
    metres = 1.0 if options.metres is None else options.metres
    turn = np.eye(4)
    if options.upward is not None:
        turn[:3, :3] = world_axes(options.upward).T
    scale = np.array([1.0, 1.0, 1.0, metres])
    return tuple(
        replace(camera, extrinsics=camera.extrinsics * scale @ turn)
        for camera in read_cameras(str(options.camera))
    )


def _extent(pixels: np.ndarray) -> float:
    """Size [px] of a person in a picture: the median over frames."""
    known = np.isfinite(pixels).all(-1).sum(-1) > 2
    seen = pixels[known]
    return float(np.median(np.nanmax(seen, 1) - np.nanmin(seen, 1), axis=0).max()) if len(seen) else 1.0


def _in_metres(path: Path, found: PointFrames, options: FitOptions) -> tuple[torch.Tensor, float]:
    """Points (F, P, 3) [m], +Y up, and the length of the unit [m] as it was taken; pixels as they are."""
    if options.camera is not None:
        return torch.as_tensor(found.positions).to(options.device, torch.float32), 1.0
    metres = options.metres
    if metres is None:
        metres = _told_unit(path, found.positions)
    axes = np.eye(3) if options.upward is None else world_axes(options.upward)
    places = metres * found.positions @ axes.T
    return torch.as_tensor(places).to(options.device, torch.float32), metres


def _told_unit(path: Path, positions: np.ndarray) -> float:
    """Length of the unit [m] by the extent of a body: 0.4 to 2.6 m in the largest direction."""
    known = np.isfinite(positions).all(-1)
    seen, known = positions[known.sum(1) > 2], known[known.sum(1) > 2][..., None]
    extents = np.where(known, seen, -np.inf).max(1) - np.where(known, seen, np.inf).min(1)
    if not len(extents):
        return 1.0
    extent = float(np.median(extents.max(1)))
    if extent == 0:
        raise InputError(
            str(path), got=f"all points at one place, in {len(extents)} frames",
            expected="points of a person", fix="Look at how the file was written.",
        )  # fmt: skip
    for unit in METRES:
        if 0.4 < extent * METRES[unit] < 2.6:
            if unit != "m":
                say(path.name, [f"points span {extent:.4g}: taken for {unit}; if they are not, pass unit=m"])
            return METRES[unit]
    return 1.0


def _unit_error(path: Path, error: InputError, metres: float) -> InputError:
    return InputError(
        f"{path.name}: unit", got=f"{error.got}, in units of {metres:g} m", expected="a person",
        fix="Pass unit= as the points are stored (m, cm, mm, inch, ft), or backend.params of such a body.",
    )  # fmt: skip


def _doubts(result: PointResult, lengths: torch.Tensor | None, extent: float | None) -> list[str]:
    """What is doubtful about a fit: its size, its error, frames that were bridged."""
    told, size = [], 1.0 if lengths is None else float(lengths.mean())
    if not _SIZES[0] < size < _SIZES[1]:
        told.append(
            f"the person is {size:.2g} times the body's size; "
            "pass unit=m, cm, mm, inch or ft if that is not so"
        )
    gone = int((~result.valid).sum())
    if gone:
        told.append(f"{gone} frames with fewer than three known points are bridged")
    error = float(result.residual.nanmedian())
    if error > (_MISSED if extent is None else _MISSED_SHARE * extent):
        missed = f"{1e3 * error:.0f} mm" if extent is None else f"{error:.0f} px"
        told.append(
            f"points miss the body by {missed}; is their order that of the set? `soma points list` has others"
            + ("" if extent is None else "; are fx, fy, cx, cy and extrinsics those of the picture?")
        )
    return told


def _without_zeros(path: Path, found: PointFrames) -> PointFrames:
    """Points without those together at exactly zero in a frame, as many programs write unknown ones."""
    zero = (found.positions == 0).all(-1)
    zero &= zero.sum(-1, keepdims=True) > 1
    if not zero.any() or zero.all():
        return found
    say(path.name, [f"{int(zero.sum())} points at exactly zero, beside others there, are taken as not known"])
    return replace(found, positions=np.where(zero[..., None], np.nan, found.positions))


def _other_sides(names: Sequence[str]) -> list[int]:
    """For each point the place of that of the other side, by their names; its own where there is none."""
    row = {name.lower(): place for place, name in enumerate(names)}
    other = {"left": "right", "right": "left", "l": "r", "r": "l"}
    found = []
    for place, name in enumerate(map(str.lower, names)):
        swapped = re.sub("left|right", lambda side: other[side[0]], name)
        short = other.get(name[0], name[0]) + name[1:]
        found.append(row.get(swapped if swapped != name else short, place))
    return found


def _exchanged(
    inversion: PointInversion,
    other: torch.Tensor,
    identity: Identity,
    lengths: torch.Tensor | None,
    result: PointResult,
) -> list[str]:
    """Whether points fit far better as those of the other side (F, P, 3)."""
    missed = float(result.residual.nanmedian())
    if not missed > _EXCHANGED:
        return []
    some = torch.linspace(0, len(other) - 1, min(len(other), _TRIED)).round().long()
    again = float(inversion(other[some], identity, bone_scale=lengths).residual.nanmedian())
    if not again < 0.5 * missed:
        return []
    return [
        f"points miss the body by {1e3 * missed:.0f} mm, and by {1e3 * again:.0f} mm if left is right; pass "
        "swap_sides=true, or the axes are those of a left hand"
    ]


def _report(
    name: str, found: PointFrames, result: PointResult, lengths: torch.Tensor | None, motion: Motion
) -> dict[str, Any]:
    flat = found.positions.shape[-1] == 2
    unit, scale = ("px", 1.0) if flat else ("mm", 1e3)
    error = scale * result.point_error[torch.isfinite(result.point_error)]
    figures = {
        "mean": float(error.mean()), "p95": float(error.quantile(0.95)), "max": float(error.max())
    } if len(error) else {"mean": None, "p95": None, "max": None}  # fmt: skip
    std = result.angle_std[result.valid].nanmedian(0).values
    names = motion.joint_names
    report = {
        "points": name, "layout": found.layout, f"error_{unit}": {"all": figures},
        f"noise_{unit}": scale * result.noise, "valid_frames": int(result.valid.sum()),
        "angle_std_degrees": {joint: round(float(v), 2) for joint, v in zip(names, std, strict=True)},
        "determined": [names[place] for place in torch.nonzero(result.determined.any(0)).flatten().tolist()],
    }  # fmt: skip
    if lengths is not None:
        report["size"] = float(lengths.mean())
        report["bone_scale"] = {joint: round(float(v), 4) for joint, v in zip(names, lengths[0], strict=True)}
    return report
