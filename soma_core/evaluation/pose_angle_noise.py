"""Angles under noise, what the fit claims of them, and gradients through it (see `pose_angles`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from soma_core.evaluation.ground_contact import motion_files
from soma_core.evaluation.joint_turns import angles_between
from soma_core.evaluation.pose_angle_fits import (
    Fit,
    Piece,
    Trial,
    finger_joints,
    fit_frames,
    piece,
    posed_vertices,
    visible_joints,
)
from soma_core.evaluation.pose_angle_meshes import (
    BODIES,
    TestBody,
    drifting_hips,
    rotation_matrices,
    smooth_poses,
)
from soma_core.evaluation.report import Figure, Table
from soma_core.evaluation.shipped_layers import layer_label
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion
from soma_core.io.motion_files import read_motion
from soma_core.skeleton.identity import Identity

__all__ = ["claimed_spread", "gradients", "noisy_targets"]

_NOISE_DEGREES = {5: 2.0, 20: 6.0}
"""Standard deviation of each coordinate [mm] -> bound on the mean angle of body joints."""

_OUTLIERS, _DISPLACED, _ROBUST, _OUTLIER_DEGREES = 0.05, 0.3, 0.01, 15.0
"""Share of the vertices, how far they are moved [m], option of the fit [m], and the bound."""

_MISSING, _MISSING_DEGREES = 0.3, 0.2
_GRADIENT = 1e-4
_SPREAD_FRAMES, _SPREAD_NOISE, _GRADIENT_FRAMES = 4, 0.005, 4

_FEW = BODIES[:2]
"""A native body and an old heavy man."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Motion:
    """Frames of a smooth motion that the layer posed."""

    inversion: PoseInversion
    identity: Identity
    rotations: Tensor
    vertices: Tensor

    @staticmethod
    def of(body: TestBody, inversion: PoseInversion, count: int, random: np.random.Generator) -> _Motion:
        layer = inversion.layer
        rotations = rotation_matrices(smooth_poses(layer, count, random), layer)
        return _Motion.posed(body, inversion, rotations, drifting_hips(count, random, layer))

    @staticmethod
    def recorded(body: TestBody, inversion: PoseInversion, count: int) -> _Motion | None:
        """`count` frames spread over each recorded motion; None where there are none."""
        motions = [read_motion(path) for path in motion_files(None)]
        if not motions:
            return None
        kept = [np.unique(np.linspace(0, motion.frame_count - 1, count).astype(int)) for motion in motions]
        rotations, hips = (
            torch.as_tensor(
                np.concatenate(
                    [getattr(motion, name)[some] for motion, some in zip(motions, kept, strict=True)]
                )
            ).to(inversion.layer.device, inversion.layer.dtype)
            for name in ("rotations", "translation")
        )
        return _Motion.posed(body, inversion, rotations, hips)

    @staticmethod
    def posed(body: TestBody, inversion: PoseInversion, rotations: Tensor, hips: Tensor) -> _Motion:
        identity = body.identity(inversion.layer)
        vertices = posed_vertices(inversion.layer, identity, rotations, hips)
        return _Motion(inversion=inversion, identity=identity, rotations=rotations, vertices=vertices)

    def fit(
        self, vertices: Tensor, inversion: PoseInversion | None = None, weights: Tensor | None = None
    ) -> Fit:
        return fit_frames(
            inversion or self.inversion, vertices, self.identity, self.rotations, weights=weights
        )

    def normal(self, random: np.random.Generator, shape: tuple[int, ...] | None = None) -> Tensor:
        """Standard normal numbers, one a coordinate unless a shape is given."""
        drawn = random.standard_normal(shape or tuple(self.vertices.shape), np.float32)
        return torch.as_tensor(drawn).to(self.vertices)


@piece
def noisy_targets(trial: Trial) -> Piece:
    """Fit smooth motions of two bodies with noise, with outliers, and with vertices that are missing.

    Noise is normal in every coordinate. Motions in the folder ``motions`` of SOMA_TEST_DATA get it too: the
    random one turns elbows and knees about every axis, which those of a person do not. Outliers are 5 % of
    the vertices, others in each frame, moved by 300 mm in a random direction, and the fit gets
    ``robust=0.01``. Missing vertices are 30 %, NaN, with weight zero.
    """
    fits: dict[str, list[Fit]] = {}
    label = ""
    for index, body, layer, inversion in trial.bodies(_FEW):
        label = layer_label(layer)
        random = trial.random(15, index)
        motion = _Motion.of(body, inversion, trial.count, random)
        moved = {"": motion}
        if recorded := _Motion.recorded(body, inversion, trial.count):
            moved["recorded motions, "] = recorded
        for of, one in moved.items():
            for mm in _NOISE_DEGREES:
                noisy = one.vertices + 1e-3 * mm * one.normal(random)
                fits.setdefault(f"{of}noise of {mm} mm", []).append(one.fit(noisy))
        outliers = _with_outliers(motion, random)
        robust = trial.invert(layer, robust=_ROBUST)
        fits.setdefault("outliers, robust", []).append(motion.fit(outliers, robust))
        missing = torch.as_tensor(random.uniform(size=motion.vertices.shape[1]) < _MISSING).to(layer.device)
        weights = torch.where(missing, 0.0, torch.as_tensor(inversion.default_weights))
        gaps = motion.vertices.masked_fill(missing[:, None], torch.nan)
        fits.setdefault("30 % missing", []).append(motion.fit(gaps, weights=weights))
    found = {name: Fit.joined(some) for name, some in fits.items()}
    columns = (
        "target", "layer", "frames", "body joints, mean, degrees", "P95", "max", "fingers, mean, degrees",
        "P95", "max", "worst joint", "converged, %", "frames/s",
    )  # fmt: skip
    rows = [(name, label, *_noise_cells(fit)) for name, fit in found.items()]
    table = Table(title="noise, outliers and gaps", columns=columns, rows=rows)
    return Piece(layer=label, table=table, figures=_noise_figures(label, found))


def _with_outliers(motion: _Motion, random: np.random.Generator) -> Tensor:
    direction = torch.nn.functional.normalize(motion.normal(random), dim=-1)
    hit = random.uniform(size=tuple(motion.vertices.shape[:2])) < _OUTLIERS
    return motion.vertices + _DISPLACED * direction * torch.as_tensor(hit).to(direction)[..., None]


def _body_joints(name: str) -> bool:
    return not finger_joints(name)


def _noise_cells(fit: Fit) -> tuple[str | float | None, ...]:
    cells: list[str | float | None] = [len(fit.converged)]
    for wanted in (_body_joints, finger_joints):
        angles = fit.of(wanted)
        some = (angles.mean(), np.percentile(angles, 95), angles.max()) if angles.size else (None, None, None)
        cells += [None if one is None else float(one) for one in some]
    worst = fit.joints[int(fit.angles.max(axis=0).argmax())]
    return (*cells, worst, 100 - fit.not_converged, len(fit.converged) / fit.seconds)


def _noise_figures(label: str, found: dict[str, Fit]) -> list[Figure]:
    figures = [
        Figure(
            name=f"{label}, {target}, body joints, mean angle",
            value=float(found[target].of(_body_joints).mean()), unit="degrees", bound=bound,
        )
        for of in ("", "recorded motions, ") for mm, bound in _NOISE_DEGREES.items()
        if (target := f"{of}noise of {mm} mm") in found
    ]  # fmt: skip
    outliers, missing = found["outliers, robust"], found["30 % missing"]
    return [
        *figures,
        Figure(
            name=f"{label}, 5 % outliers, robust, max angle", value=float(outliers.worst.max()),
            unit="degrees", bound=_OUTLIER_DEGREES,
        ),
        Figure(
            name=f"{label}, 30 % missing, max angle", value=float(missing.worst.max()), unit="degrees",
            bound=_MISSING_DEGREES,
        ),
        Figure(
            name=f"{label}, 30 % missing, not converged", value=missing.not_converged, unit="%", bound=0.0
        ),
        Figure(
            name=f"{label}, 30 % missing, converged but wrong", value=missing.wrong, unit="frames", bound=0.0
        ),
    ]  # fmt: skip


@piece
def claimed_spread(trial: Trial) -> Piece:
    """Compare ``result.angle_std`` (F, J - 1) [degrees] with what `count` draws of 5 mm noise do.

    By joint, over four frames of each of two bodies: the root mean square angle between fitted and true
    rotation, over the root mean square of what the fits claimed. Empty where the result claims nothing.
    """
    rows: list[tuple[str | float, ...]] = []
    ratios: list[np.ndarray] = []
    label = ""
    for index, body, layer, inversion in trial.bodies(_FEW):
        label = layer_label(layer)
        random = trial.random(16, index)
        motion = _Motion.of(body, inversion, _SPREAD_FRAMES, random)
        angles, claims = [], []
        for _ in range(trial.count):
            fit = motion.fit(motion.vertices + _SPREAD_NOISE * motion.normal(random))
            claimed = getattr(fit.result, "angle_std", None)
            if claimed is None:
                break
            angles.append(fit.angles)
            claims.append(claimed[:, visible_joints(layer)].double().cpu().numpy())
        if not claims:
            continue
        found, said = (np.sqrt(np.nanmean(np.concatenate(one) ** 2, axis=0)) for one in (angles, claims))
        ratios.append(found / said)
        names = [layer.joint_names[joint] for joint in visible_joints(layer)]
        rows += [
            (f"{body.name}, {name}", label, float(one), float(other), float(one / other))
            for name, one, other in zip(names, found, said, strict=True)
        ]
    columns = ("body, joint", "layer", "found, degrees", "claimed, degrees", "ratio")
    table = Table(title="spread of angles under noise of 5 mm", columns=columns, rows=rows)
    if not ratios:
        return Piece(layer=label, table=table, figures=[])
    every = np.concatenate(ratios)
    name = f"{label}, spread of angles over the claimed one, by joint"
    figures = [
        Figure(name=f"{name}, median", value=float(np.median(every))),
        Figure(name=f"{name}, P95", value=float(np.percentile(every, 95))),
    ]
    return Piece(layer=label, table=table, figures=figures)


@piece
def gradients(trial: Trial) -> Piece:
    """Compare gradients through a fit, in float64, with those of its known inverse.

    Where the layer posed the target, posing and fitting is the identity, so that a gradient that goes back
    through both must be the one that went in: a random one of rotations and Hips, by turns of all joints.
    At most four frames of each of two bodies; relative to the length of the gradient of the frame.
    """
    rows = []
    label, worst = "", 0.0
    for index, body, layer, inversion in trial.bodies(_FEW, torch.float64):
        label = layer_label(layer)
        random = trial.random(17, index)
        motion = _Motion.of(body, inversion, min(trial.count, _GRADIENT_FRAMES), random)
        relative, angle = _gradient_errors(motion, random)
        worst = max(worst, float(relative.max()))
        rows.append(
            (body.name, label, len(relative), float(np.median(relative)), float(relative.max()), angle)
        )
    columns = (
        "body",
        "layer",
        "frames",
        "median, relative",
        "max, relative",
        "max angle of the fit, degrees",
    )
    figures = [Figure(name=f"{label}, gradient through a fit, relative error", value=worst, bound=_GRADIENT)]
    table = Table(title="gradients through a fit", columns=columns, rows=rows)
    return Piece(layer=label, table=table, figures=figures)


def _gradient_errors(motion: _Motion, random: np.random.Generator) -> tuple[np.ndarray, float]:
    """Relative error (F,) of the gradient, and the largest angle of the fit [degrees]."""
    layer, count = motion.inversion.layer, len(motion.rotations)
    seen = visible_joints(layer)
    turns = torch.zeros(count, len(layer.joint_names), 3).to(motion.rotations).requires_grad_()
    hips = drifting_hips(count, random, layer).requires_grad_()
    rotations = motion.rotations @ axis_angle_to_matrix(turns)
    with torch.enable_grad():
        result = motion.inversion(layer.pose(motion.identity, rotations, hips).vertices, motion.identity)
    by_rotation = motion.normal(random, (count, len(seen), 3, 3))
    by_hips = motion.normal(random, (count, 3))
    through, known = (
        _flat(
            torch.autograd.grad(
                [pose[:, seen], place], [turns, hips], [by_rotation, by_hips], retain_graph=True
            )
        )
        for pose, place in ((result.rotations, result.translation), (rotations, hips))
    )
    relative = (through - known).norm(dim=1) / known.norm(dim=1)
    angle = angles_between(result.rotations[:, seen], motion.rotations[:, seen]).max()
    return relative.cpu().numpy(), float(angle)


def _flat(parts: tuple[Tensor, ...]) -> Tensor:
    return torch.cat([part.flatten(1) for part in parts], 1)
