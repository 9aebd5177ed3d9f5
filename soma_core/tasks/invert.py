"""``soma invert``: the pose of every frame of a moving mesh, with a report and a picture of errors."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from omegaconf import OmegaConf

from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.inversion.options import inversion_options
from soma_core.io.vertex_files import open_vertex_sequence
from soma_core.io.vertex_sequence import VertexSequence
from soma_core.layer import SomaLayer
from soma_core.tasks.animate import given_params
from soma_core.tasks.fit_job import (
    FitJob,
    ResultFiles,
    fingerprint,
    fit_settings,
    refuse_no_fit,
    refuse_unfit,
)
from soma_core.tasks.fitted_chunks import FittedChunks
from soma_core.tasks.found_identity import found_identity
from soma_core.tasks.posed_input import PosedInput
from soma_core.tasks.stored_identity import stored_identity

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["run"]

_log = logging.getLogger(__name__)


def run(config: DictConfig, output: Path) -> None:
    """Fit every frame of ``config.input``; write motion.npz, frames.npz, report.json and errors.png.

    Frames are read, fitted and stored chunk by chunk, so memory does not grow with their number. Finished
    chunks stay in ``output/chunks`` until the end: the same run in the same folder goes on after them.

    Raises:
        SomaError: the backend or the input cannot be used, or the fit is none; what there is of it is
            written all the same.
    """
    if config.chunk < 1:
        raise InputError("chunk", got=config.chunk, expected="at least 1", fix="Try chunk=256.")
    with _open_input(config) as sequence:
        job = _prepare(config, sequence, output)
        try:
            job.fit_missing()
        except KeyboardInterrupt:
            _log.warning("stopped; the same command with hydra.run.dir=%s goes on from here", output)
            raise
        report, found = job.write_results()
    for line in report.as_text().splitlines():
        _log.info("%s", line)
    refuse_no_fit(job.posed.sequence.path, asdict(found) if found else None, job.files.report)


def _open_input(config: DictConfig) -> VertexSequence:
    if not config.input:
        raise InputError(
            "input",
            got="none",
            expected="an .npz or .npy of vertices, a folder of meshes, a .usd or a .glb",
            fix="Pass input=FILE.",
        )
    return open_vertex_sequence(
        config.input,
        fps=config.fps,
        unit=str(config.unit) if config.unit else None,
        up=_direction(str(config.up)) if config.up else None,
    )


def _direction(up: str) -> Any:
    """The upward axis with its sign."""
    return up if up.startswith("-") else f"+{up}"


def _prepare(config: DictConfig, sequence: VertexSequence, output: Path) -> FitJob:
    """Build the layer and the identity, and check the input against them."""
    if sequence.fps is None:
        raise InputError(
            "fps", got=f"none in {sequence.path.name}", expected="frames per second", fix="Pass fps=30."
        )
    options, params = given_params(config.backend.options), given_params(config.backend.params)
    layer = SomaLayer(
        config.backend.name, options=options, lod=str(config.lod), device=config.device,
        procedural=config.procedural, correctives=config.correctives,
    )  # fmt: skip
    posed = PosedInput(sequence, layer, topology=str(config.topology))
    with torch.no_grad():
        identity = layer.identity(params)
    posed.check_size(layer, identity)
    settings = {
        "input": str(sequence.path.resolve()),
        "fps": sequence.fps,
        "unit_m": sequence.metres,
        "up": sequence.up,
        "topology": posed.topology,
        "backend": layer.backend,
        "params": params,
        "options": options,
        "identity": _identity_settings(config),
        "lod": layer.mesh.lod,
        "procedural": layer.procedural,
        "correctives": layer.correctives_file and layer.correctives_file.name,
        "inversion": fit_settings(config.inversion),
        "rig": layer.rig.revision,
    }
    _log.info(
        "%s: %d frames of %d vertices (%s) at %g fps",
        sequence.path.name, sequence.frame_count, sequence.vertex_count, posed.topology, sequence.fps,
    )  # fmt: skip
    fit = PoseInversion(
        layer, **inversion_options(settings["inversion"]), kernels=str(config.inversion.kernels)
    )
    refuse_unfit(fit, posed, identity)
    made_from = {**settings, "content": fingerprint(sequence.path), "shown": config.picture.frames}
    chunks = FittedChunks(output / "chunks", made_from, frame_count=sequence.frame_count, size=config.chunk)
    stored = {"backend": layer.backend, "params": params}
    if settings["identity"]["method"] != "known":
        file = chunks.folder / "identity.npz"
        stored, search = found_identity(file, layer, posed, params, settings["identity"])
        settings["identity"] = {**search, "params": stored["params"]}
        with torch.no_grad():
            identity = stored_identity(layer, stored)
    return FitJob(
        inversion=fit, identity=identity, stored=stored, posed=posed, chunks=chunks, settings=settings,
        files=ResultFiles.of_folder(output), picture=config.picture,
    )  # fmt: skip


def _identity_settings(config: DictConfig) -> dict[str, Any]:
    """The group ``identity``, of which nothing but the method matters where the identity is known."""
    values = OmegaConf.to_container(config.identity, resolve=True)
    method = str(config.identity.method)
    return {**values, "method": method} if method != "known" else {"method": method}
