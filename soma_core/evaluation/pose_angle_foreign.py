"""Meshes of Anny's own rig: what the fit's joints do beyond what the bones did (see `pose_angles`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.evaluation.anny_rig import HINGE_BONES, AnnyClip, hinge_clip, smooth_clip
from soma_core.evaluation.joint_turns import TurnExcess, angles_between, bone_turns, turn_excess
from soma_core.evaluation.pose_angle_fits import Fit, Piece, Trial, fit_frames, piece
from soma_core.evaluation.pose_angle_meshes import ANNY_BODIES
from soma_core.evaluation.report import Figure, Table
from soma_core.evaluation.shipped_layers import layer_label
from soma_core.geometry.rotations import matrix_to_axis_angle
from soma_core.inversion import InversionResult, PoseInversion
from soma_core.inversion.priors import HINGES, hinge_rotation
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["anny_rig_hinges", "anny_rig_motions"]

_OVER_PLAIN_MM, _EXCESS_DEGREES, _MISSED_PERCENT, _OFF_AXIS_DEGREES = 0.1, 10.0, 1.0, 15.0

_BENT_ENOUGH = np.radians(30.0)
"""Below this the axis of a bent joint is not well defined [rad]."""

_CLIP = 100
"""Frames of a whole motion; of a shorter one the first are taken, so that frames stay as near in time."""


@piece
def anny_rig_motions(trial: Trial) -> Piece:
    """Fit smooth motions of Anny's own rig: five bodies, `count` frames each.

    The greatest turn of a body joint between two frames, in the world, less that of the bone of Anny that
    carries the same skin (`BONES_OF`; the bone that turned most, where there are several).
    """
    which: Any = {"lod": trial.lod, "device": trial.device}
    layer, other = trial.make("anny", **which), trial.against("anny", **which)
    inversion, reference = trial.invert(layer), PoseInversion(other)
    label, rows, fits, over, excesses = layer_label(layer), [], [], [], []
    for index, (who, params) in enumerate(ANNY_BODIES.items()):
        clip = smooth_clip(params, max(trial.count, _CLIP), trial.random(13, index))
        clip = _first(clip, trial.count)
        fit = fit_frames(inversion, clip.vertices, layer.identity(params), topology="native")
        known = fit_frames(reference, clip.vertices, other.identity(params), topology="native")
        excess = turn_excess(layer, _result(fit).rotations, bone_turns(clip))
        over.append(float(fit.mean_mm.mean() - known.mean_mm.mean()))
        rows.append((who, label, *_cells(fit, over[-1], excess)))
        fits.append(fit)
        excesses.append(excess)
    worst = max(excesses, key=lambda one: one.excess)
    everything = Fit.joined(fits)
    rows.insert(0, ("all", label, *_cells(everything, float(np.mean(over)), worst)))
    name = f"{label}, Anny's own rig"
    figures = [
        Figure(name=f"{name}, mean", value=float(everything.mean_mm.mean()), unit="mm"),
        Figure(
            name=f"{name}, mean over that of plain skinning, worst body", value=max(over), unit="mm",
            bound=_OVER_PLAIN_MM,
        ),
        Figure(
            name=f"{name}, turn between frames beyond the bone's, worst", value=worst.excess, unit="degrees",
            bound=_EXCESS_DEGREES,
        ),
        Figure(
            name=f"{name}, not converged", value=everything.not_converged, unit="%", bound=_MISSED_PERCENT
        ),
    ]  # fmt: skip
    columns = (
        "body", "layer", "frames", "mean, mm", "max, mm", "over plain, mm", "turn beyond the bone's, degrees",
        "of the joint", "the bone's turn, degrees", "converged, %", "by plain skinning, %", "frames/s",
    )  # fmt: skip
    table = Table(title="smooth motions of Anny's own rig", columns=columns, rows=rows)
    return Piece(layer=label, table=table, figures=figures)


def _cells(fit: Fit, over: float, excess: TurnExcess) -> tuple[str | float | None, ...]:
    return (
        len(fit.converged), float(fit.mean_mm.mean()), float(fit.max_mm.max()), over, excess.excess,
        excess.joint, excess.true, 100 - fit.not_converged, 100 * float(fit.plain.mean()),
        len(fit.converged) / fit.seconds,
    )  # fmt: skip


def _result(fit: Fit) -> InversionResult:
    assert fit.result is not None, "a fit that was just made"
    return fit.result


def _first(clip: AnnyClip, count: int) -> AnnyClip:
    """The first frames of a motion."""
    return AnnyClip(
        vertices=clip.vertices[:count], bones=clip.bones[:count], names=clip.names, bent=clip.bent[:count]
    )


@piece
def anny_rig_hinges(trial: Trial) -> Piece:
    """Fit motions of Anny's own rig whose elbows and knees turn as hinges, about the axes of `HINGES`.

    The axes of our T-pose are carried to Anny's rest pose by the skeleton that was fitted to it. What a fit's
    elbow turned from there has an axis: the angle between both, over frames bent by 30 degrees or more; and
    how far it turned otherwise than about the hinge, over all frames.
    """
    layer = trial.make("anny", lod=trial.lod, device=trial.device)
    inversion, label = trial.invert(layer), layer_label(layer)
    rows: list[tuple[str | float, ...]] = []
    off_axis: list[np.ndarray] = []
    beside: list[np.ndarray] = []
    for index, (who, params) in enumerate(ANNY_BODIES.items()):
        identity = layer.identity(params)
        rest = _rest_turns(layer, identity)
        clip = hinge_clip(params, _anny_axes(layer, rest), trial.count, trial.random(14, index))
        fit = fit_frames(inversion, clip.vertices, identity, topology="native")
        axis, other = _off_hinge(layer, fit, clip, rest)
        for joint in HINGE_BONES:
            rows.append((
                f"{who}, {joint}", label, float(axis[joint].mean()), float(axis[joint].max()),
                float(other[joint].mean()), float(other[joint].max()), 100 - fit.not_converged,
            ))  # fmt: skip
        off_axis += axis.values()
        beside += other.values()
    axes, others = np.concatenate(off_axis), np.concatenate(beside)
    name = f"{label}, hinges of Anny's own rig"
    figures = [
        Figure(
            name=f"{name}, angle off the axis, mean", value=float(axes.mean()), unit="degrees",
            bound=_OFF_AXIS_DEGREES,
        ),
        Figure(name=f"{name}, angle off the axis, max", value=float(axes.max()), unit="degrees"),
        Figure(name=f"{name}, turned beside the hinge, mean", value=float(others.mean()), unit="degrees"),
    ]  # fmt: skip
    columns = (
        "body, joint", "layer", "off the axis, mean, degrees", "max", "beside the hinge, mean, degrees",
        "max", "converged, %",
    )  # fmt: skip
    return Piece(
        layer=label,
        table=Table(title="hinges of Anny's own rig", columns=columns, rows=rows),
        figures=figures,
    )


def _rest_turns(layer: SomaLayer, identity: Identity) -> Tensor:
    """World turns (J - 1, 3, 3) from the T-pose of the skeleton that was fitted to the body at rest."""
    fitted = identity.fitted_world[0, 1:, :3, :3].double().cpu()
    return fitted @ torch.tensor(layer.rig.t_pose_world[1:, :3, :3]).mT


def _anny_axes(layer: SomaLayer, rest: Tensor) -> dict[str, np.ndarray]:
    """Joint -> hinge axis in Anny's world at rest, +Z up, signed so that the joint bends."""
    axes = {}
    for joint, (_, parent) in HINGE_BONES.items():
        sign = -1.0 if joint == "LeftForeArm" else 1.0
        x, y, z = sign * (rest[layer.joint_names.index(parent)].numpy() @ np.array(HINGES[joint]))
        axes[joint] = np.array([x, -z, y])
    return axes


def _off_hinge(
    layer: SomaLayer, fit: Fit, clip: AnnyClip, rest: Tensor
) -> tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]]:
    """Joint -> angles [degrees] between its axis and the hinge's, of bent frames; and what is beside it."""
    rotations = _result(fit).rotations.double().cpu()
    off, beside = {}, {}
    bent = clip.bent > _BENT_ENOUGH
    for joint, (_, parent) in HINGE_BONES.items():
        number, above = (layer.joint_names.index(name) for name in (joint, parent))
        axis = torch.tensor(HINGES[joint], dtype=torch.float64)
        turned = rotations[:, number] @ (rest[above].mT @ rest[number]).mT
        beside[joint] = angles_between(turned, hinge_rotation(turned, axis))
        vectors = matrix_to_axis_angle(turned[bent])
        cosine = (vectors @ axis).abs() / vectors.norm(dim=-1).clamp_min(1e-12)
        off[joint] = np.degrees(np.arccos(cosine.clamp(max=1).numpy()))
    return off, beside
