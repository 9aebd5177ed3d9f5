"""The fit of one sequence: chunk by chunk, after those of an earlier run, with a report and a picture."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from omegaconf import OmegaConf

from soma_core.cache import atomic_write
from soma_core.errors import SomaError
from soma_core.inversion.diagnosis import Diagnosis, diagnose_fit
from soma_core.io.motion_files import write_motion_parts
from soma_core.options import Upward
from soma_core.progress import progress
from soma_core.tasks.fit_results import chunk_arrays, draw_worst, fitted_motions, joined_report, per_frame

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.inversion import PoseInversion
    from soma_core.inversion.report import InversionReport
    from soma_core.skeleton.identity import Identity
    from soma_core.tasks.fitted_chunks import FittedChunks
    from soma_core.tasks.posed_input import PosedInput

__all__ = ["FitJob", "ResultFiles", "fingerprint", "fit_settings", "refuse_no_fit", "refuse_unfit"]

_log = logging.getLogger(__name__)

_FIRST_LOOK, _LAST_LOOK = 8, 64
"""Frames, spread over the sequence, that tell before the fit and after it whether it is one."""


@dataclass(frozen=True, kw_only=True)
class ResultFiles:
    """Where results go: motions, or vertices where there are no motions to be had."""

    motion: Path
    vertices: Path
    frames: Path
    report: Path
    picture: Path

    @classmethod
    def of_folder(cls, folder: Path) -> ResultFiles:
        """The usual names in a folder of their own."""
        return cls(
            motion=folder / "motion.npz",
            vertices=folder / "vertices.npz",
            frames=folder / "frames.npz",
            report=folder / "report.json",
            picture=folder / "errors.png",
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class FitJob:
    """What the fit of one sequence works with.

    Attributes:
        inversion: the fit, with its layer.
        identity: of all frames; `stored` is what the motion file keeps of it.
        posed: the vertices.
        chunks: where finished parts are kept.
        settings: what decides the result, for the report; ``fps`` is among them.
        files: where the results go.
        picture: how many frames, and its width.
        licence: of the motion.
    """

    inversion: PoseInversion
    identity: Identity
    stored: Mapping[str, Any]
    posed: PosedInput
    chunks: FittedChunks
    settings: Mapping[str, Any]
    files: ResultFiles
    picture: DictConfig
    licence: str = ""

    @property
    def _apart(self) -> int:
        """Least distance between two frames of the picture: neighbours look alike."""
        return self.chunks.frame_count // (4 * max(self.picture.frames, 1))

    @torch.no_grad()
    def fit_missing(self) -> None:
        """Fit the chunks that are not there yet."""
        missing, total = self.chunks.missing(), len(self.chunks.ranges)
        done = total - len(missing)
        if done:
            _log.info("going on after %d of %d chunks", done, total)
        layer, margin = self.inversion.layer, _margin(self.inversion)
        kept = -(-self.picture.frames // total)
        for number in progress(missing, label="chunk", total=total, done=done, after=5.0):
            start, stop = self.chunks.ranges[number]
            begin, end = max(start - margin, 0), min(stop + margin, self.chunks.frame_count)
            vertices = torch.as_tensor(self.posed.read(begin, end)).to(layer.device, layer.dtype)
            result = self.inversion(vertices, self.identity, topology=self.posed.topology)
            result = result.part(slice(start - begin, stop - begin))
            self.chunks.save(number, chunk_arrays(result, layer, start=start, kept=kept, apart=self._apart))

    def write_results(self) -> tuple[InversionReport, Diagnosis | None]:
        """Join the chunks into the files of the result, and delete them; say what is wrong with the fit."""
        layer, chunks = self.inversion.layer, self.chunks
        source = f"fitted to {self.posed.sequence.path.name}"
        identity = {**self.stored, **({"options": layer.options} if layer.options else {})}
        write_motion_parts(
            lambda: fitted_motions(
                chunks, layer, fps=self.settings["fps"], source=source, identity=identity,
                licence=self.licence,
            ),
            self.files.motion,
            frame_count=chunks.frame_count,
            joint_orient=layer.rig.t_pose_world[1:, :3, :3],
        )  # fmt: skip
        frames = per_frame(chunks)
        atomic_write(self.files.frames, lambda path: np.savez_compressed(path, **frames))
        unusable = np.flatnonzero(~frames["valid"])
        if len(unusable):
            _log.warning(
                "%d frames could not be used and hold the T-pose, the first is %d; %s lists them",
                len(unusable), unusable[0], self.files.frames.name,
            )  # fmt: skip
        draw_worst(
            self.files.picture, chunks, layer, self.identity,
            count=self.picture.frames, apart=self._apart, width=self.picture.width,
        )  # fmt: skip
        report = joined_report(chunks, layer)
        found = self._diagnosis(frames["mean_error"])
        told = None if found is None else asdict(found)
        document = {"settings": dict(self.settings), **report.as_dict(), "diagnosis": told}
        text = json.dumps(document, indent=2, default=float) + "\n"
        atomic_write(self.files.report, lambda path: path.write_text(text, encoding="utf-8") and None)
        chunks.remove()
        return report, found

    def _diagnosis(self, errors: np.ndarray) -> Diagnosis | None:
        """What is wrong with the fit, by some of its frames and their mean errors [m], NaN where unusable."""
        usable = np.flatnonzero(np.isfinite(errors))
        numbers, vertices = self.posed.spread(_LAST_LOOK, usable if len(usable) else None)
        return _diagnosed(
            self.inversion, self.posed, self.identity, vertices, errors=errors[numbers], frames=numbers,
            searched=self.settings["identity"]["method"] != "known",
        )  # fmt: skip


def _diagnosed(
    inversion: PoseInversion, posed: PosedInput, identity: Identity, vertices: np.ndarray, **known: Any
) -> Diagnosis | None:
    layer = inversion.layer
    given = torch.as_tensor(vertices).to(layer.device, layer.dtype)
    with torch.no_grad():
        canonical = inversion.canonical(given, posed.topology)
    return diagnose_fit(layer, identity, canonical, axes=posed.axes, ups=[*Upward], **known)


def refuse_unfit(inversion: PoseInversion, posed: PosedInput, identity: Identity) -> None:
    """Look at some frames before a fit, and refuse vertices that no pose of any body explains.

    Raises:
        SomaError: they are mirrored, or in another order.
    """
    _, vertices = posed.spread(_FIRST_LOOK)
    found = _diagnosed(inversion, posed, identity, vertices)
    if found is not None and found.failed and found.cause in ("order", "mirrored"):
        raise SomaError(f"{posed.sequence.path}: {found.sentence}.")


def refuse_no_fit(path: Path, found: Mapping[str, Any] | None, report: Path) -> None:
    """Say what is wrong with a fit that was written, as its report has it.

    Raises:
        SomaError: it is no fit.
    """
    if found is None:
        return
    if found["failed"]:
        raise SomaError(f"{path}: {found['sentence']}; {report} has the figures.")
    _log.warning("%s: %s", path.name, found["sentence"])


def _margin(inversion: PoseInversion) -> int:
    """Frames on either side of a chunk that a prior on neighbours looks at: one further a round."""
    priors = inversion.priors
    return priors.temporal_rounds + 1 if priors.temporal_strength else 0


def fit_settings(choice: DictConfig) -> dict[str, Any]:
    """Everything in the group ``inversion`` that decides the result; kernels only round differently."""
    values = OmegaConf.to_container(choice, resolve=True)
    return {str(name): value for name, value in values.items() if name != "kernels"}


def fingerprint(path: Path) -> str:
    """Names, sizes and times of change of a file, or of each file in a folder."""
    digest = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        state = file.stat()
        digest.update(f"{file.name} {state.st_size} {state.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]
