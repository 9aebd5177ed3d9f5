"""Conversion of one file to a motion of this skeleton: rotations carried over, or a posed body fitted."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from soma_core.cache import atomic_write
from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.inversion.options import inversion_options
from soma_core.io.amass import SmplMotion, holds_smpl_motion, read_amass
from soma_core.io.motion_files import read_motion, write_motion
from soma_core.io.npz_fields import NpzFields, open_npz
from soma_core.io.soma_npz import METRES_PER_UNIT
from soma_core.rig import load_canonical
from soma_core.tasks.fit_job import FitJob, ResultFiles, fingerprint, fit_settings
from soma_core.tasks.fitted_chunks import FittedChunks, refuse_other_settings
from soma_core.tasks.posed_input import PosedInput
from soma_core.tasks.posed_model import FitBackends, ModelSequence
from soma_core.topology.frames import METRES

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.plugin.spec import BackendSpec

__all__ = ["SUFFIXES", "Converter", "Layout", "layout_of"]

_log = logging.getLogger(__name__)

Layout = Literal["soma", "kimodo", "amass"]

SUFFIXES = (".npz",)
"""Files that may hold a motion."""

_UPRIGHT = 0.7
"""Cosine between the mean upward direction of a body and that of its world, where people mostly stand."""


def layout_of(path: Path) -> Layout | None:
    """Which motion a file holds, told by its keys; None where it holds none.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or no NPZ.
    """
    with open_npz(path) as fields:
        return _layout(fields)


def _layout(fields: NpzFields) -> Layout | None:
    if "global_rot_mats" in fields or "local_rot_mats" in fields:
        return "kimodo"
    if holds_smpl_motion(fields):
        return "amass"
    if "schema_version" in fields or ("poses" in fields and "transl" in fields):
        return "soma"
    return None


class Converter:
    """Converts one file after another; backends and their fits are made once for all of them.

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

    def __call__(self, path: Path, files: ResultFiles, chunks: Path) -> dict[str, Any]:
        """Convert a file and return its report, which is written too.

        A file that was converted before, with the same settings, is left alone.

        Args:
            path: what to convert.
            files: where the results go.
            chunks: folder for the finished parts of a fit, until its end.

        Raises:
            SomaError: the file, or the backend that it needs, cannot be used.
            InputError: it holds no motion, or was converted before with other settings.
        """
        layout = layout_of(path)
        if layout == "amass":
            return self._fit_smpl(path, files, chunks)
        if layout is None:
            raise InputError(
                str(path),
                got="no motion under any key that is known",
                expected="the keys of an AMASS, kimodo or SOMA file",
                fix="Vertices over time are what soma invert takes.",
            )
        return self._carry_over(path, layout, files)

    def _carry_over(self, path: Path, layout: Layout, files: ResultFiles) -> dict[str, Any]:
        """Write the rotations of a file on this skeleton as they are, in metres."""
        unit = next((name for name, m in METRES_PER_UNIT.items() if m == self._unit), None)
        motion = read_motion(path, fps=self._config.fps, unit=unit)
        orient = load_canonical("mid")[1].t_pose_world[1:, :3, :3]
        write_motion(motion, files.motion, joint_orient=orient)
        document = {
            "settings": {"input": str(path.resolve()), "layout": layout, "fps": motion.fps, "unit": unit},
            "frames": motion.frame_count,
            "convention": motion.convention,
            "identity": motion.identity.get("backend"),
            "rotations": "carried over as they are",
        }
        text = json.dumps(document, indent=2) + "\n"
        atomic_write(files.report, lambda file: file.write_text(text, encoding="utf-8") and None)
        return document

    @property
    def _unit(self) -> float | None:
        return METRES[str(self._config.unit)] if self._config.unit else None

    def _fit_smpl(self, path: Path, files: ResultFiles, chunks: Path) -> dict[str, Any]:
        """Pose the model that the file was made for, and fit this skeleton to it."""
        config = self._config
        motion = read_amass(
            path,
            fps=config.fps,
            gender=str(config.gender) if config.gender else None,
            up=f"+{config.up}" if config.up else None,
        )
        _warn_lying(path, motion)
        options = {"gender": motion.gender}
        backend = self._backends.get(motion.model, options)
        layer = backend.layer
        params = {"betas": _usable_betas(path, motion, layer.spec, config.betas)}
        pose = {"rotations": motion.rotations, "translation": motion.translation}
        sequence = ModelSequence(path, backend, params, pose, fps=motion.fps, up=motion.up)
        settings = {
            "input": str(path.resolve()), "content": fingerprint(path), "layout": "amass", "fps": motion.fps,
            "up": motion.up, "backend": motion.model, "params": params, "options": options,
            "lod": layer.mesh.lod, "inversion": self._fit_settings, "rig": layer.rig.revision,
        }  # fmt: skip
        done = _done_before(files, settings)
        if done is not None:
            return done
        plan = {**settings, "shown": config.picture.frames}
        kept = FittedChunks(chunks, plan, frame_count=sequence.frame_count, size=config.chunk)
        with torch.no_grad():
            identity = layer.identity(params)
        job = FitJob(
            inversion=backend.inversion,
            identity=identity,
            stored={"backend": motion.model, "params": params, "options": options},
            posed=PosedInput(sequence, layer, topology="native"),
            chunks=kept,
            settings=settings,
            files=files,
            picture=config.picture,
            licence=f"that of {path.name}; body model: {layer.spec.licence}",
        )
        job.fit_missing()
        job.write_results()
        return _read_report(files.report)


def _done_before(files: ResultFiles, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Report of an earlier run with the same settings on the same file; None where there is none.

    Raises:
        InputError: the earlier run had other settings.
    """
    if not (files.motion.is_file() and files.report.is_file()):
        return None
    document = _read_report(files.report)
    before, now = dict(document["settings"]), json.loads(json.dumps(settings, default=str))
    if before.pop("content", None) != now.pop("content"):
        return None  # the file was written anew
    refuse_other_settings(files.report, before, now)
    _log.info("%s is there already", files.motion)
    return document


def _read_report(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8")))


def _usable_betas(path: Path, motion: SmplMotion, spec: BackendSpec, count: int | None) -> list[float]:
    """Shape coefficients for the user's model file, without zeros at the end.

    Raises:
        InputError: the model file has fewer shape directions.
    """
    betas = np.trim_zeros(motion.betas[:count].astype(np.float64), "b")
    (width,) = spec.params[0].shape
    if len(betas) > width:
        raise InputError(
            f"{path}: betas",
            got=f"{len(betas)} coefficients",
            expected=f"at most {width}, as your {spec.name} model has",
            fix=f"Pass betas={width} to leave the others out, or get a model file with more of them.",
        )
    return [float(value) for value in betas]


def _warn_lying(path: Path, motion: SmplMotion) -> None:
    """Say so where people stand along another axis than the file's world is taken to have."""
    upward = Rotation.from_rotvec(motion.rotations[:, 0]).apply([0, 1, 0]).mean(axis=0)
    other = {"+z": "+y", "+y": "+z"}[motion.up]
    if upward["xyz".index(other[1])] > _UPRIGHT:
        _log.warning(
            "%s: the body stands along %s, but the world is taken to have %s up; if not so, pass up=%s",
            path.name, other, motion.up, other[1],
        )  # fmt: skip
