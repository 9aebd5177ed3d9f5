"""The fit of one file: planned as plain values, run chunk by chunk in any process, joined into results."""

from __future__ import annotations

import functools
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from soma_core.cache import atomic_text, atomic_write
from soma_core.choices import Upward
from soma_core.errors import InputError, SomaError
from soma_core.inversion.diagnosis import Diagnosis, diagnose_fit
from soma_core.io.motion import Motion
from soma_core.io.motion_files import write_motion_parts
from soma_core.motion.bodies import ShownBody, open_body
from soma_core.motion.chunks import FittedChunks
from soma_core.motion.files import ResultFiles, fingerprint
from soma_core.motion.fit_results import chunk_arrays, draw_worst, fitted_motions, joined_report, per_frame
from soma_core.motion.ground import skeleton_of
from soma_core.motion.identities import found_identity, stored_identity
from soma_core.motion.models import model_settings
from soma_core.motion.movement import LOOKED, of_movement
from soma_core.motion.options import FitOptions
from soma_core.motion.questions import heard, of_path, say
from soma_core.motion.smpl_input import SMPL_LAYOUTS
from soma_core.progress import progress

if TYPE_CHECKING:
    from torch import Tensor

    from soma_core.inversion import PoseInversion
    from soma_core.inversion.report import InversionReport
    from soma_core.inversion.result import InversionResult
    from soma_core.motion.posed_input import PosedInput
    from soma_core.skeleton.identity import Identity

__all__ = ["FitJob", "FitPlan", "fit_chunks", "fit_settings", "plan_body"]

_log = logging.getLogger(__name__)

_FIRST_LOOK, _LAST_LOOK = 8, 64
"""Frames, spread over the sequence, that tell before the fit and after it whether it is one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitPlan:
    """The fit of one file as plain values: it can be pickled, and run in another process.

    Attributes:
        source: the file, or a folder of meshes.
        layout: what it holds.
        options: of the fit.
        stored: the identity of all frames, as a motion file keeps it.
        chunks: where finished parts are kept.
        settings: what decides the result, for the report.
        files: where the results go.
        warnings: what was said while it was planned, for the report.
    """

    source: Path
    layout: str
    options: FitOptions
    stored: Mapping[str, Any]
    chunks: FittedChunks
    settings: Mapping[str, Any]
    files: ResultFiles
    warnings: tuple[str, ...] = ()

    def missing(self) -> list[int]:
        """Numbers of the chunks that are still to be fitted."""
        return self.chunks.missing()


def fit_chunks(plan: FitPlan, numbers: Sequence[int] | int) -> None:
    """Fit some chunks of a plan, or one, and store them: what a pool or a cluster maps over.

    Args:
        plan: it is not finished yet, and its file is as it was.
        numbers: of the chunks, such as those of :meth:`FitPlan.missing`.

    Raises:
        SomaError: the file, or the backend that it needs, cannot be used here.
        InputError: the plan is finished, its file was changed, or it has no such chunk.
    """
    numbers = [numbers] if isinstance(numbers, int) else list(numbers)
    total = len(plan.chunks.ranges)
    if not all(0 <= number < total for number in numbers):
        raise InputError("numbers", got=numbers, expected=f"0 to {total - 1}", fix="Use plan.missing().")
    if not plan.chunks.open:
        raise InputError(
            "plan", got="one that is finished", expected="chunks to fit", fix="Make another by plan_fit."
        )
    if plan.source.exists() and fingerprint(plan.source) != plan.settings["content"]:
        raise InputError(
            str(plan.source), got="another file than when the fit was planned", expected="the same",
            fix="Make another plan by plan_fit.",
        )  # fmt: skip
    body = open_body(plan.source, plan.layout, plan.options)
    with body.posed.sequence:
        FitJob(plan=plan, body=body).fit(numbers)


def fit_settings(source: Path, layout: str, body: ShownBody, options: FitOptions) -> dict[str, Any]:
    """What decides the result of a fit, as plain values; kernels only round differently."""
    layer, inversion = body.backend.layer, asdict(options.inversion)
    inversion.pop("kernels")
    return {
        "input": str(source.resolve()), "layout": layout, "fps": body.posed.sequence.fps, **body.facts,
        "backend": layer.backend, "params": body.params, "options": layer.options,
        "identity": body.search or {"method": "known"}, **model_settings(layer), "inversion": inversion,
        "content": fingerprint(source),
    }  # fmt: skip


def plan_body(
    source: Path, layout: str, body: ShownBody, options: FitOptions, files: ResultFiles, chunks: Path
) -> FitPlan:
    """Look whether a body can be fitted, and find its identity where it is not known.

    Args:
        source, layout: the file that shows the body.
        body: what it shows.
        options: of the fit.
        files: where the results are to go.
        chunks: folder for the finished parts, until the end.

    Raises:
        SomaError: the vertices are mirrored, in another order, or of another size.
        InputError: the folder holds chunks that were made with other settings.
    """
    layer, posed = body.backend.layer, body.posed
    settings = fit_settings(source, layout, body, options)
    say(source.name, body.doubts)
    with torch.no_grad():
        identity = layer.identity(body.params)
        posed.check_size(layer, identity)
        found = _refuse_unfit(body.backend.inversion, posed, identity)
    if found is not None and layout == "vertices":  # other readers say themselves where a body lies
        say(source.name, [found.sentence])
    made_from = {**settings, "shown": options.picture.frames}
    kept = FittedChunks(chunks, made_from, frame_count=posed.sequence.frame_count, size=options.chunk)
    stored = {"backend": layer.backend, "params": body.params}
    if body.search:
        file = kept.folder / "identity.npz"
        stored, search = found_identity(file, layer, posed, body.params, body.search)
        # An earlier report of a conversion is compared with the search that is asked for: that stays there.
        settings["identity" if layout == "vertices" else "found"] = {**search, "params": stored["params"]}
    return FitPlan(
        source=source, layout=layout, options=options, stored=stored, chunks=kept, settings=settings,
        files=files,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class FitJob:
    """A plan and the body that it is about, opened in this process."""

    plan: FitPlan
    body: ShownBody

    @functools.cached_property
    @torch.no_grad()
    def identity(self) -> Identity:
        """Of all frames."""
        return stored_identity(self.body.backend.layer, self.plan.stored)

    @property
    def _apart(self) -> int:
        """Least distance between two frames of the picture: neighbours look alike."""
        return self.plan.chunks.frame_count // (4 * max(self.plan.options.picture.frames, 1))

    @torch.no_grad()
    def fit(self, numbers: Sequence[int]) -> None:
        """Fit some chunks, by their numbers."""
        inversion, posed, chunks = self.body.backend.inversion, self.body.posed, self.plan.chunks
        total = len(chunks.ranges)
        done = total - len(numbers)
        layer, margin = inversion.layer, _margin(inversion)
        kept = -(-self.plan.options.picture.frames // total)
        for number in progress(numbers, label="chunk", total=total, done=done, after=5.0):
            start, stop = chunks.ranges[number]
            begin, end = max(start - margin, 0), min(stop + margin, chunks.frame_count)
            vertices = torch.as_tensor(posed.read(begin, end)).to(layer.device, layer.dtype)
            result = self._fitted(vertices, begin, end)
            result = result.part(slice(start - begin, stop - begin))
            chunks.save(number, chunk_arrays(result, layer, start=start, kept=kept, apart=self._apart))

    def _fitted(self, vertices: Tensor, begin: int, end: int) -> InversionResult:
        """The fit of frames from `begin` to `end`, near the turns that their file tells."""
        inversion, topology = self.body.backend.inversion, self.body.posed.topology
        if self.body.expected is None:
            return inversion(vertices, self.identity, topology=topology)
        expected = torch.as_tensor(self.body.expected[begin:end])
        return inversion.guided(vertices, self.identity, expected, topology=topology)

    def fit_missing(self) -> None:
        """Fit the chunks that are not there yet."""
        missing, total = self.plan.missing(), len(self.plan.chunks.ranges)
        if len(missing) < total:
            _log.info("going on after %d of %d chunks", total - len(missing), total)
        self.fit(missing)

    def write_results(self) -> InversionReport:
        """Join the chunks into the files of the result, and delete them; the report says what is wrong."""
        plan, layer = self.plan, self.body.backend.layer
        chunks, files, picture = plan.chunks, plan.files, plan.options.picture
        source = f"fitted to {plan.source.name}"
        identity = {**plan.stored, **({"options": layer.options} if layer.options else {})}
        skeleton = skeleton_of(layer.rig, self.identity)
        write_motion_parts(
            lambda: fitted_motions(
                chunks, layer, fps=plan.settings["fps"], source=source, identity=identity,
                skeleton=skeleton, licence=self.body.licence, expression=self.body.expression,
            ),
            files.motion,
            frame_count=chunks.frame_count,
            joint_orient=layer.rig.t_pose_world[1:, :3, :3],
        )  # fmt: skip
        frames = per_frame(chunks)
        atomic_write(files.frames, lambda path: np.savez_compressed(path, **frames))
        draw_worst(
            files.picture, chunks, layer, self.identity,
            count=picture.frames, apart=self._apart, width=picture.width,
        )  # fmt: skip
        report = joined_report(chunks, layer)
        found = self._diagnosis(frames["mean_error"])
        with heard() as said:
            self._question(frames["valid"], found)
        document = {
            "settings": dict(plan.settings), **report.as_dict(),
            "diagnosis": None if found is None else asdict(found), "warnings": [*plan.warnings, *said],
        }  # fmt: skip
        atomic_text(files.report, json.dumps(document, indent=2, default=float) + "\n")
        chunks.remove()
        return report

    def _question(self, valid: np.ndarray, found: Diagnosis | None) -> None:
        """Warn of what the fit tells about the file: frames without a body, a doubtful fit, the path."""
        plan, unusable = self.plan, np.flatnonzero(~valid)
        doubts = []
        if len(unusable):
            doubts = [
                f"{len(unusable)} frames could not be used and hold the T-pose, the first is {unusable[0]}; "
                f"{plan.files.frames.name} lists them"
            ]
        if found is not None and not found.failed and found.cause != "axis":
            doubts.append(found.sentence)
        smpl = plan.layout in SMPL_LAYOUTS  # its path was asked about before the fit
        told = []
        if not smpl and valid.sum() > 1:
            path = np.concatenate([path for (path,) in plan.chunks.load_all("translation")])[valid]
            told = of_path(path, plan.settings["fps"], up="+y", what="the fit")
        known = len(valid) if valid.all() else int(np.argmin(valid))
        if known and not any("angles=deg" in doubt for doubt in self.body.doubts):
            turns = ("rotation_layout", "swap_sides") if smpl else ()
            doubted = bool(self.body.doubts) or (found is not None and found.cause == "axis")
            doubts += of_movement(self._begin(known), turns=turns, told=told, path=not doubted)
        say(plan.source.name, doubts)

    def _begin(self, known: int) -> Motion:
        """The first frames of what was fitted, `known` of them at most, on the body's skeleton."""
        count, layer = min(known, LOOKED), self.body.backend.layer
        loaded, parts = 0, []
        for part in self.plan.chunks.load_all("rotations", "translation"):
            parts.append(part)
            loaded += len(part[0])
            if loaded >= count:
                break
        rotations, path = (np.concatenate(each)[:count] for each in zip(*parts, strict=True))
        return Motion(
            rotations=rotations, translation=path, fps=self.plan.settings["fps"],
            joint_names=layer.joint_names, skeleton=skeleton_of(layer.rig, self.identity),
        )  # fmt: skip

    def _diagnosis(self, errors: np.ndarray) -> Diagnosis | None:
        """What is wrong with the fit, by some of its frames and their mean errors [m], NaN where unusable."""
        usable = np.flatnonzero(np.isfinite(errors))
        body = self.body
        numbers, vertices = body.posed.spread(_LAST_LOOK, usable if len(usable) else None)
        return _diagnosed(
            body.backend.inversion, body.posed, self.identity, vertices, errors=errors[numbers],
            frames=numbers, searched=bool(body.search),
        )  # fmt: skip


def _diagnosed(
    inversion: PoseInversion, posed: PosedInput, identity: Identity, vertices: np.ndarray, **known: Any
) -> Diagnosis | None:
    layer = inversion.layer
    given = torch.as_tensor(vertices).to(layer.device, layer.dtype)
    with torch.no_grad():
        canonical = inversion.canonical(given, posed.topology)
    return diagnose_fit(layer, identity, canonical, axes=posed.axes, ups=[*Upward], **known)


def _refuse_unfit(inversion: PoseInversion, posed: PosedInput, identity: Identity) -> Diagnosis | None:
    """Look at some frames before a fit, and refuse vertices that no pose of any body explains.

    Returns:
        That the body lies or stands on its head; None otherwise.

    Raises:
        SomaError: they are mirrored, or in another order.
    """
    _, vertices = posed.spread(_FIRST_LOOK)
    found = _diagnosed(inversion, posed, identity, vertices)
    if found is not None and found.failed and found.cause in ("order", "mirrored"):
        raise SomaError(f"{posed.sequence.path}: {found.sentence}.")
    return found if found is not None and found.cause == "axis" else None


def _margin(inversion: PoseInversion) -> int:
    """Frames on either side of a chunk that a prior on neighbours looks at: one further a round."""
    priors = inversion.priors
    return priors.temporal_rounds + 1 if priors.temporal_strength else 0
