"""``soma invert``: the pose of every frame of a moving mesh, with a report and a picture of errors."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from omegaconf import OmegaConf

from soma_core.cache import atomic_write
from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.inversion.options import inversion_options
from soma_core.io.motion_files import write_motion_parts
from soma_core.io.vertex_files import open_vertex_sequence
from soma_core.io.vertex_sequence import VertexSequence
from soma_core.layer import SomaLayer
from soma_core.progress import progress
from soma_core.tasks.animate import given_params
from soma_core.tasks.fit_results import chunk_arrays, draw_worst, fitted_motions, joined_report, per_frame
from soma_core.tasks.fitted_chunks import FittedChunks
from soma_core.tasks.posed_input import PosedInput

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.inversion.priors import PosePriors
    from soma_core.skeleton.identity import Identity

__all__ = ["run"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Job:
    """What one run works with."""

    config: DictConfig
    layer: SomaLayer
    params: Mapping[str, Any]
    identity: Identity
    posed: PosedInput
    chunks: FittedChunks
    settings: Mapping[str, Any]

    @property
    def apart(self) -> int:
        """Least distance between two frames of the picture: neighbours look alike."""
        return self.chunks.frame_count // (4 * max(self.config.picture.frames, 1))


def run(config: DictConfig, output: Path) -> None:
    """Fit every frame of ``config.input``; write motion.npz, frames.npz, report.json and errors.png.

    Frames are read, fitted and stored chunk by chunk, so memory does not grow with their number. Finished
    chunks stay in ``output/chunks`` until the end: the same run in the same folder goes on after them.

    Raises:
        SomaError: the backend or the input cannot be used.
    """
    if config.chunk < 1:
        raise InputError("chunk", got=config.chunk, expected="at least 1", fix="Try chunk=256.")
    with _open_input(config) as sequence:
        job = _prepare(config, sequence, output)
        try:
            _fit_missing(job)
        except KeyboardInterrupt:
            _log.warning("stopped; the same command with hydra.run.dir=%s goes on from here", output)
            raise
    _write_results(job, output)
    job.chunks.remove()


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
        up=f"+{config.up}" if config.up else None,
    )


def _prepare(config: DictConfig, sequence: VertexSequence, output: Path) -> _Job:
    """Build the layer and the identity, and check the input against them."""
    if sequence.fps is None:
        raise InputError(
            "fps", got=f"none in {sequence.path.name}", expected="frames per second", fix="Pass fps=30."
        )
    options, params = given_params(config.backend.options), given_params(config.backend.params)
    layer = SomaLayer(config.backend.name, options=options, lod=str(config.lod), device=config.device)
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
        "lod": layer.mesh.lod,
        "inversion": _fit_settings(config),
        "rig": layer.rig.revision,
    }
    made_from = {**settings, "content": _fingerprint(sequence.path), "shown": config.picture.frames}
    chunks = FittedChunks(output / "chunks", made_from, frame_count=sequence.frame_count, size=config.chunk)
    _log.info(
        "%s: %d frames of %d vertices (%s) at %g fps",
        sequence.path.name, sequence.frame_count, sequence.vertex_count, posed.topology, sequence.fps,
    )  # fmt: skip
    return _Job(
        config=config, layer=layer, params=params, identity=identity, posed=posed, chunks=chunks,
        settings=settings,
    )  # fmt: skip


def _fit_settings(config: DictConfig) -> dict[str, Any]:
    """Everything in the group ``inversion`` that decides the result; kernels only round differently."""
    values = OmegaConf.to_container(config.inversion, resolve=True)
    return {str(name): value for name, value in values.items() if name != "kernels"}


def _fingerprint(path: Path) -> str:
    """Names, sizes and times of change of a file, or of each file in a folder."""
    digest = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        state = file.stat()
        digest.update(f"{file.name} {state.st_size} {state.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


@torch.no_grad()
def _fit_missing(job: _Job) -> None:
    """Fit the chunks that are not there yet."""
    missing, total = job.chunks.missing(), len(job.chunks.ranges)
    done = total - len(missing)
    if done:
        _log.info("going on after %d of %d chunks", done, total)
    layer, options = job.layer, inversion_options(job.settings["inversion"])
    inversion = PoseInversion(layer, **options, kernels=str(job.config.inversion.kernels))
    margin = _margin(options["priors"])
    kept = -(-job.config.picture.frames // total)
    for number in progress(missing, label="chunk", total=total, done=done, after=5.0):
        start, stop = job.chunks.ranges[number]
        begin, end = max(start - margin, 0), min(stop + margin, job.chunks.frame_count)
        vertices = torch.as_tensor(job.posed.read(begin, end)).to(layer.device, layer.dtype)
        result = inversion(vertices, job.identity, topology=job.posed.topology)
        result = result.part(slice(start - begin, stop - begin))
        job.chunks.save(number, chunk_arrays(result, layer, start=start, kept=kept, apart=job.apart))


def _margin(priors: PosePriors) -> int:
    """Frames on either side of a chunk that a prior on neighbours looks at: one further a round."""
    return priors.temporal_rounds + 1 if priors.temporal_strength else 0


def _write_results(job: _Job, output: Path) -> None:
    """Join the chunks into the files of the result."""
    layer, chunks = job.layer, job.chunks
    source = f"fitted to {job.posed.sequence.path.name}"
    write_motion_parts(
        lambda: fitted_motions(chunks, layer, fps=job.settings["fps"], source=source, params=job.params),
        output / "motion.npz",
        frame_count=chunks.frame_count,
        joint_orient=layer.rig.t_pose_world[1:, :3, :3],
    )
    frames = per_frame(chunks)
    atomic_write(output / "frames.npz", lambda path: np.savez_compressed(path, **frames))
    report = joined_report(chunks, layer)
    document = {"settings": dict(job.settings), **report.as_dict()}
    text = json.dumps(document, indent=2, default=float) + "\n"
    atomic_write(output / "report.json", lambda path: path.write_text(text, encoding="utf-8") and None)
    for line in report.as_text().splitlines():
        _log.info("%s", line)
    unusable = np.flatnonzero(~frames["valid"])
    if len(unusable):
        _log.warning(
            "%d frames could not be used and hold the T-pose, the first is %d; frames.npz lists them",
            len(unusable), unusable[0],
        )  # fmt: skip
    picture = job.config.picture
    draw_worst(
        output / "errors.png", chunks, layer, job.identity,
        count=picture.frames, apart=job.apart, width=picture.width,
    )  # fmt: skip
