"""Conversion of one file to a motion of this skeleton: rotations carried over, or its body fitted."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch

from soma_core.cache import atomic_write
from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.inversion.options import inversion_options
from soma_core.io.amass import holds_smpl_motion
from soma_core.io.motion import Motion
from soma_core.io.motion_files import read_motion, write_motion
from soma_core.io.npz_fields import open_npz
from soma_core.io.sam3d import SAM3D_SUFFIXES
from soma_core.io.soma_npz import METRES_PER_UNIT
from soma_core.rig import load_canonical
from soma_core.tasks.convert_bodies import ShownBody, sam3d_body, smpl_body
from soma_core.tasks.fit_job import (
    FitJob,
    ResultFiles,
    fingerprint,
    fit_settings,
    refuse_no_fit,
    refuse_unfit,
)
from soma_core.tasks.fitted_chunks import FittedChunks, refuse_other_settings
from soma_core.tasks.found_identity import found_identity
from soma_core.tasks.posed_model import FitBackends
from soma_core.tasks.stored_identity import stored_identity
from soma_core.topology.frames import METRES

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["SUFFIXES", "Converted", "Converter", "Layout", "earlier_report", "layout_of", "motion_of"]

_log = logging.getLogger(__name__)

Layout = Literal["soma", "kimodo", "amass", "sam3d"]

SUFFIXES = SAM3D_SUFFIXES
"""Files that may hold a motion."""

_BODIES = {"amass": smpl_body, "sam3d": sam3d_body}


def layout_of(path: Path) -> Layout | None:
    """Which motion a file holds, told by its keys; None where it holds none.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or no NPZ.
    """
    if path.suffix.lower() == ".parquet":
        return "sam3d"
    with open_npz(path) as fields:
        if "global_rot_mats" in fields or "local_rot_mats" in fields:
            return "kimodo"
        if "pred_vertices" in fields:
            return "sam3d"
        if holds_smpl_motion(fields):
            return "amass"
        return "soma" if "schema_version" in fields or {"poses", "transl"} <= {*fields.names} else None


def motion_of(path: Path, config: DictConfig) -> Motion:
    """Motion in a file of SOMA tools or kimodo."""
    metres = METRES[str(config.unit)] if config.unit else None
    unit = next((name for name, length in METRES_PER_UNIT.items() if length == metres), None)
    return read_motion(path, fps=config.fps, unit=unit)


@dataclass(frozen=True, kw_only=True, eq=False)
class Converted:
    """What became of a file: its report, and whether an earlier run made it.

    Attributes:
        report: as it was written.
        earlier: whether an earlier run made it.
        vertices: whether they are the result, and no motion.
    """

    report: Mapping[str, Any]
    earlier: bool = False
    vertices: bool = False

    @property
    def error_mm(self) -> Mapping[str, float | None] | None:
        """Figures of the error over the whole body; None where rotations were carried over."""
        return self.report.get("error_mm", {}).get("all")

    def __str__(self) -> str:
        settings, error = self.report["settings"], self.error_mm
        told = f"{settings['layout']}, {self.report['frames']} frames at {settings['fps']:g} fps"
        earlier = " (by an earlier run)" if self.earlier else ""
        if error is None:
            return f"{told}, {'posed' if self.vertices else 'rotations carried over'}{earlier}"
        if error["mean"] is None:
            return f"{told}, of which none could be used{earlier}"
        figures = f"mean {error['mean']:.3g}, P95 {error['p95']:.3g}, max {error['max']:.3g} mm"
        return f"{told}, fitted with an error of {figures}{earlier}"


class Converter:
    """Converts one file after another to motions of this skeleton; backends and fits serve all of them.

    Args:
        config: that of ``soma convert``.
    """

    def __init__(self, config: DictConfig) -> None:
        self._config = config
        self._fit_settings = fit_settings(config.inversion)
        options, kernels = inversion_options(self._fit_settings), str(config.inversion.kernels)
        self._backends = FitBackends(
            str(config.lod), config.device, lambda layer: PoseInversion(layer, **options, kernels=kernels)
        )

    def __call__(self, path: Path, files: ResultFiles, chunks: Path) -> Converted:
        """Convert a file.

        A body that was fitted before, with the same settings, is not fitted again.

        Args:
            path: what to convert.
            files: where the results go.
            chunks: folder for the finished parts of a fit, until its end.

        Raises:
            SomaError: the file, or the backend that it needs, cannot be used.
            InputError: it holds no motion, or was fitted before with other settings.
        """
        layout = layout_of(path)
        if layout in _BODIES:
            return self._fit(path, layout, _BODIES[layout](path, self._config, self._backends), files, chunks)
        if layout is None:
            raise InputError(
                str(path),
                got="no motion under any key that is known",
                expected="the keys of an AMASS, SAM 3D Body, kimodo or SOMA file",
                fix="Vertices over time are what soma invert takes.",
            )
        return self._carry_over(path, layout, files)

    def _carry_over(self, path: Path, layout: Layout, files: ResultFiles) -> Converted:
        """Write the rotations of a file on this skeleton as they are, in metres."""
        motion = motion_of(path, self._config)
        orient = load_canonical("mid")[1].t_pose_world[1:, :3, :3]
        write_motion(motion, files.motion, joint_orient=orient)
        report = {
            "settings": {"input": str(path.resolve()), "layout": layout, "fps": motion.fps},
            "frames": motion.frame_count,
            "convention": motion.convention,
            "identity": motion.identity.get("backend"),
            "rotations": "carried over as they are",
        }
        text = json.dumps(report, indent=2) + "\n"
        atomic_write(files.report, lambda file: file.write_text(text, encoding="utf-8") and None)
        return Converted(report=report)

    def _fit(
        self, path: Path, layout: Layout, body: ShownBody, files: ResultFiles, chunks: Path
    ) -> Converted:
        """Fit this skeleton to the body that a file shows."""
        layer, posed, config = body.backend.layer, body.posed, self._config
        settings = {
            "input": str(path.resolve()), "layout": layout, "fps": posed.sequence.fps, **body.facts,
            "backend": layer.backend, "params": body.params, "options": layer.options,
            "identity": body.search or {"method": "known"}, "lod": layer.mesh.lod,
            "inversion": self._fit_settings, "rig": layer.rig.revision, "content": fingerprint(path),
        }  # fmt: skip
        earlier = earlier_report(files.report, files.motion, settings)
        if earlier is not None:
            _refuse_failed(path, earlier, files.report)
            return Converted(report=earlier, earlier=True)
        with torch.no_grad():
            refuse_unfit(body.backend.inversion, posed, layer.identity(body.params))
        plan = {**settings, "shown": config.picture.frames}
        kept = FittedChunks(chunks, plan, frame_count=posed.sequence.frame_count, size=config.chunk)
        stored = {"backend": layer.backend, "params": body.params}
        if body.search:
            stored, found = found_identity(
                kept.folder / "identity.npz", layer, posed, body.params, body.search
            )
            settings["found"] = {**found, "params": stored["params"]}
        with torch.no_grad():
            identity = stored_identity(layer, stored)
        posed.check_size(layer, identity)
        job = FitJob(
            inversion=body.backend.inversion, identity=identity, stored=stored, posed=posed, chunks=kept,
            settings=settings, files=files, picture=config.picture, licence=body.licence,
        )  # fmt: skip
        job.fit_missing()
        job.write_results()
        report = _read_report(files.report)
        _refuse_failed(path, report, files.report)
        return Converted(report=report)


def earlier_report(file: Path, result: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """The report `file` if an earlier run left it and `result`, with the same settings for the same input.

    Raises:
        InputError: the earlier run had other settings.
    """
    if not (file.is_file() and result.is_file()):
        return None
    try:
        report = _read_report(file)
        before = dict(report["settings"])
    except (ValueError, KeyError, TypeError):
        return None  # no report of ours
    now = json.loads(json.dumps(settings, default=str))
    before.pop("found", None)
    if before.pop("content", None) != now.pop("content"):
        return None  # the file was written anew
    refuse_other_settings(file, before, now)
    return report


def _refuse_failed(path: Path, report: Mapping[str, Any], file: Path) -> None:
    """Refuse a fit that is none; where the body lies is the readers' to say, who know the file's axes.

    Raises:
        SomaError: what is wrong with it.
    """
    found = report.get("diagnosis")
    if found and found["cause"] != "axis":
        refuse_no_fit(path, found, file)


def _read_report(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8")))
