"""Motions in another model's terms: what a chunk of frames keeps, and the files that all of them make."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from soma_core.cache import atomic_write
from soma_core.io.amass import Gender, SmplMotion, SmplName, write_amass
from soma_core.io.npz_parts import write_npz_parts
from soma_core.io.soma_npz import METRES_PER_UNIT
from soma_core.io.vertex_sequence import UpAxis
from soma_core.motion.chunks import FittedChunks
from soma_core.motion.files import ResultFiles
from soma_core.motion.native_errors import NativeErrors
from soma_core.motion.posed_input import world_axes
from soma_core.native import NativeFit, NativeTransfer
from soma_core.topology.frames import METRES

__all__ = ["NativeTarget", "SmplTarget", "VertexTarget"]

_PER_FRAME = ("valid", "converged", "iterations", "mean_error", "largest_error")
_SUMMED = ("sums", "numbers", "counts", "maxima")


class NativeTarget(Protocol):
    """What becomes of posed canonical vertices."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """What decides the result, for the report."""
        ...

    def arrays(self, vertices: Tensor) -> dict[str, np.ndarray]:
        """What is kept of a chunk of frames (F, v, 3) [m]."""
        ...

    def write(self, chunks: FittedChunks, files: ResultFiles, *, fps: float, source: str) -> dict[str, Any]:
        """Write the files that all chunks make together; return the figures of the report."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class VertexTarget:
    """Vertices in a backend's own topology, unit and axes.

    Attributes:
        transfer: to that topology.
    """

    transfer: NativeTransfer

    @property
    def facts(self) -> Mapping[str, Any]:
        """The unit and the axes."""
        spec = self.transfer.spec
        return {"to": spec.name, "unit": spec.unit, "up": spec.up}

    def arrays(self, vertices: Tensor) -> dict[str, np.ndarray]:
        """The vertices."""
        return {"vertices": self.transfer(vertices).float().cpu().numpy()}

    def write(self, chunks: FittedChunks, files: ResultFiles, *, fps: float, source: str) -> dict[str, Any]:
        """Write ``files.vertices``, which ``soma invert`` reads."""
        _write_vertices(chunks, files, self.transfer, fps=fps, source=source, up=self.transfer.spec.up)
        return {"frames": chunks.frame_count, "vertices": self.transfer.count}


@dataclass(frozen=True, kw_only=True, eq=False)
class SmplTarget:
    """Pose parameters of SMPL, SMPL-H or SMPL-X, as AMASS stores them.

    Attributes:
        fit: to the model.
        errors: by regions of its mesh.
        model, gender: which it is.
        params: the body; None while it is yet to be found.
        up: upward axis of the world that is written.
    """

    fit: NativeFit
    errors: NativeErrors
    model: SmplName
    gender: Gender
    params: Mapping[str, list[float]] | None
    up: UpAxis

    @property
    def facts(self) -> Mapping[str, Any]:
        """The body and the world."""
        params = "found" if self.params is None else dict(self.params)
        return {"to": self.model, "gender": self.gender, "params": params, "up": self.up}

    def arrays(self, vertices: Tensor) -> dict[str, np.ndarray]:
        """Parameters of the frames, and statistics of the error."""
        if self.up != "+y":  # the fit does not care which way a body is turned
            vertices = vertices @ torch.as_tensor(world_axes(self.up)).to(vertices)
        found = self.fit(vertices, params=self.params)
        return {
            "rotations": found.rotations.float().cpu().numpy(),
            "translation": found.translation.float().cpu().numpy(),
            "determined": found.determined.cpu().numpy(),
            "valid": found.valid.cpu().numpy(),
            "converged": found.converged.cpu().numpy(),
            "iterations": found.iterations.cpu().numpy(),
            **self.errors.statistics(found.vertex_error.float().cpu().numpy()),
        }

    def write(self, chunks: FittedChunks, files: ResultFiles, *, fps: float, source: str) -> dict[str, Any]:
        """Write ``files.motion`` in the layout of AMASS, and ``files.frames``."""
        columns = {name: np.concatenate(list(_column(chunks, name))) for name in ("rotations", "translation")}
        betas = np.array((self.params or {}).get("betas", []))
        motion = SmplMotion(model=self.model, **columns, betas=betas, gender=self.gender, fps=fps, up=self.up)
        write_amass(
            motion,
            files.motion,
            extra={"source": np.array(source), "up_axis": np.array(self.up.lstrip("+").upper())},
        )
        frames = {name: np.concatenate(list(_column(chunks, name))) for name in _PER_FRAME}
        atomic_write(files.frames, lambda path: np.savez_compressed(path, **frames))
        return self._figures(chunks, frames)

    def _figures(self, chunks: FittedChunks, frames: Mapping[str, np.ndarray]) -> dict[str, Any]:
        parts = [dict(zip(_SUMMED, arrays, strict=True)) for arrays in chunks.load_all(*_SUMMED)]
        (determined,) = chunks.load(0, "determined")
        names = zip(self.fit.joint_names, determined, strict=True)
        valid = int(frames["valid"].sum())
        return {
            "frames": chunks.frame_count,
            "unusable_frames": chunks.frame_count - valid,
            "converged_share": int(frames["converged"].sum()) / valid if valid else None,
            "undetermined_joints": [name for name, known in names if not known],
            "error_mm": self.errors.figures(parts),
        }


def _column(chunks: FittedChunks, name: str) -> Iterator[np.ndarray]:
    """One array of each chunk, in the order of the frames."""
    return (array for (array,) in chunks.load_all(name))


def _write_vertices(
    chunks: FittedChunks, files: ResultFiles, transfer: NativeTransfer, *, fps: float, source: str, up: str
) -> None:
    unit = next(name for name, length in METRES_PER_UNIT.items() if length == METRES[transfer.spec.unit])
    arrays = {
        "vertices": np.empty((0, transfer.count, 3), np.float32),
        "triangles": transfer.triangles.cpu().numpy().astype(np.int32),
        "fps": np.asarray(fps),
        "unit": np.asarray(unit),
        "source": np.asarray(source),
    }
    if up in ("+y", "+z"):
        arrays["up_axis"] = np.asarray(up[1:].upper())
    pieces: dict[str, Callable[[], Iterator[np.ndarray]]] = {
        "vertices": functools.partial(_column, chunks, "vertices")
    }
    write_npz_parts(files.vertices, arrays, pieces, count=chunks.frame_count)
