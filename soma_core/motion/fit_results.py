"""Results of a fit over many chunks: what a chunk keeps, and the files that all of them make together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from soma_core.inversion.report import InversionReport
from soma_core.io.motion import Motion
from soma_core.view.error_picture import error_sheet
from soma_core.view.stage import Body

if TYPE_CHECKING:
    from soma_core.inversion.result import InversionResult
    from soma_core.layer import SomaLayer
    from soma_core.motion.chunks import FittedChunks
    from soma_core.skeleton.identity import Identity

__all__ = ["chunk_arrays", "draw_worst", "fitted_motions", "joined_report", "per_frame", "worst_frames"]

_PER_FRAME = ("valid", "converged", "plain", "iterations", "mean_error", "largest_error")
_REPORT = "report_"
_MM = 1e3


def chunk_arrays(
    result: InversionResult, layer: SomaLayer, *, start: int, kept: int, apart: int
) -> dict[str, np.ndarray]:
    """Arrays kept of the frames from `start` on: poses, statistics, errors of the `kept` worst frames."""
    report = InversionReport(layer.mesh, layer.rig)
    report.add(result)
    error = result.vertex_error.detach().cpu().float().numpy()
    skin = np.delete(error, layer.mesh.face_interior, axis=1)
    known = np.isfinite(skin)
    count, skin = known.sum(axis=1), np.where(known, skin, 0)
    mean = skin.sum(axis=1, dtype=np.float64) / np.maximum(count, 1)
    outcome = {
        "valid": result.valid.cpu().numpy(),
        "converged": result.converged.cpu().numpy(),
        "plain": result.plain.cpu().numpy(),
        "iterations": result.iterations.cpu().numpy(),
        "mean_error": np.where(count, mean, np.nan).astype(np.float32),
        "largest_error": np.where(count, skin.max(axis=1), np.nan).astype(np.float32),
    }
    worst = worst_frames(outcome["mean_error"], kept, apart=apart)
    return {
        "rotations": result.rotations.detach().cpu().float().numpy(),
        "translation": result.translation.detach().cpu().float().numpy(),
        "worst": start + worst,
        "worst_error": error[worst],
        **outcome,
        **{_REPORT + name: array for name, array in report.arrays().items()},
    }


def worst_frames(errors: np.ndarray, count: int, *, apart: int) -> np.ndarray:
    """Ids of the `count` largest errors, more than `apart` frames from each other, ascending."""
    left = np.where(np.isfinite(errors), errors, -np.inf)
    found: list[int] = []
    while len(found) < count and len(left) and left.max() > -np.inf:
        worst = int(left.argmax())
        found.append(worst)
        left[max(worst - apart, 0) : worst + apart + 1] = -np.inf
    return np.array(sorted(found), np.int64)


def per_frame(chunks: FittedChunks) -> dict[str, np.ndarray]:
    """Outcome of every frame: usable, converged, plain, iterations, mean and largest error of the skin [m].

    Errors are NaN where a frame could not be used.
    """
    rows = list(chunks.load_all(*_PER_FRAME))
    return {name: np.concatenate([row[index] for row in rows]) for index, name in enumerate(_PER_FRAME)}


def joined_report(chunks: FittedChunks, layer: SomaLayer) -> InversionReport:
    """The report over all chunks."""
    report = InversionReport(layer.mesh, layer.rig)
    names = tuple(report.arrays())
    for arrays in chunks.load_all(*(_REPORT + name for name in names)):
        report.merge(dict(zip(names, arrays, strict=True)))
    return report


def fitted_motions(
    chunks: FittedChunks,
    layer: SomaLayer,
    *,
    fps: float,
    source: str,
    identity: Mapping[str, Any],
    skeleton: np.ndarray | None = None,
    licence: str = "",
    expression: np.ndarray | None = None,
) -> Iterator[Motion]:
    """The fitted motion, a chunk at a time; `skeleton` and `expression` of all frames."""
    ranges = (slice(*ends) for ends in chunks.ranges)
    for part, (rotations, translation) in zip(
        ranges, chunks.load_all("rotations", "translation"), strict=True
    ):
        yield Motion(
            rotations=rotations,
            translation=translation,
            fps=fps,
            joint_names=layer.joint_names,
            rig_revision=layer.rig.revision,
            source=source,
            identity=identity,
            skeleton=skeleton,
            licence=licence,
            expression=None if expression is None else expression[part],
        )


@torch.no_grad()
def draw_worst(
    path: Path,
    chunks: FittedChunks,
    layer: SomaLayer,
    identity: Identity,
    *,
    count: int,
    apart: int,
    width: int,
) -> None:
    """Draw the worst frames of all chunks, in the order of time; nothing where no frame is usable."""
    kept = {
        int(frame): error
        for worst, errors in chunks.load_all("worst", "worst_error")
        for frame, error in zip(worst, errors, strict=True)
    }
    frames = per_frame(chunks)
    means = np.full(chunks.frame_count, np.nan)
    means[list(kept)] = frames["mean_error"][list(kept)]
    bodies, shown = [], []
    for frame in worst_frames(means, count, apart=apart).tolist():
        number, place = divmod(frame, chunks.size)
        arrays = chunks.load(number, "rotations", "translation")
        pose = (torch.as_tensor(array[place : place + 1]).to(layer.device, layer.dtype) for array in arrays)
        posed = layer.pose_plain if frames["plain"][frame] else layer.pose
        vertices = posed(identity, *pose).vertices[0].cpu().numpy()
        mean, largest = (_MM * frames[name][frame] for name in ("mean_error", "largest_error"))
        caption = f"frame {frame}\nmean {mean:.3g} mm, max {largest:.3g} mm"
        bodies.append(
            Body(vertices=vertices, triangles=layer.mesh.triangles, colour=(0.8, 0.8, 0.8), caption=caption)
        )
        shown.append(_MM * kept[frame])
    if bodies:
        error_sheet(path, bodies, shown, width=width)
