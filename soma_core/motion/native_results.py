"""Motions in another model's terms: what a chunk of frames keeps, and the files that all of them make."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from soma_core.cache import atomic_arrays
from soma_core.choices import Product
from soma_core.io.amass import Gender, SmplMotion, SmplName, write_amass, write_smplx
from soma_core.io.vertex_sequence import UpAxis
from soma_core.io.vertex_writers import MeshFrames
from soma_core.motion.chunks import FittedChunks
from soma_core.motion.files import ResultFiles
from soma_core.motion.native_errors import NativeErrors
from soma_core.motion.played import Played
from soma_core.motion.posed_input import world_axes
from soma_core.motion.smpl_turns import turns_to_smpl
from soma_core.motion.writers import WRITERS
from soma_core.native import NativeFit, NativeTransfer, ParameterFit
from soma_core.native.motion import NativeMotion
from soma_core.native.parameters import ParameterMotion
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import ModelMotion, MotionFormat
from soma_core.topology.frames import METRES

__all__ = ["ModelTarget", "NativeTarget", "ParameterTarget", "SmplTarget", "VertexTarget"]

_log = logging.getLogger(__name__)

_PER_FRAME = ("valid", "converged", "iterations", "mean_error", "largest_error")
_OWN = "own_"
"""Begins the names of a model's own arrays in a chunk."""

_SEARCHED = 20
"""Frames, spread over the motion, that a body is found from."""

_USUAL_BETAS, _MOST_USUAL_BETAS = 10, 16
"""Coefficients that the models' own code takes unless told otherwise, and as many as files of AMASS hold."""

_SUMMED = ("sums", "numbers", "counts", "maxima")


class NativeTarget(Protocol):
    """What becomes of posed canonical vertices."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """What decides the result, for the report."""
        ...

    def results(self, files: ResultFiles) -> dict[str, Path]:
        """What is written, and where."""
        ...

    def arrays(self, body: Played, frames: slice) -> dict[str, np.ndarray]:
        """What is kept of a chunk of frames."""
        ...

    def write(self, chunks: FittedChunks, files: ResultFiles, *, fps: float, source: str) -> dict[str, Any]:
        """Write the files that all chunks make together; return the figures of the report."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class VertexTarget:
    """Vertices in a backend's own topology, unit and axes.

    Attributes:
        transfer: to that topology.
        products: as what they are written.
    """

    transfer: NativeTransfer
    products: tuple[Product, ...] = (Product.vertices,)

    @property
    def facts(self) -> Mapping[str, Any]:
        """The unit and the axes."""
        spec = self.transfer.spec
        return {"to": spec.name, "unit": spec.unit, "up": spec.up}

    def results(self, files: ResultFiles) -> dict[str, Path]:
        """A file or a folder for each product."""
        return {str(product): files.product(product) for product in self.products}

    def arrays(self, body: Played, frames: slice) -> dict[str, np.ndarray]:
        """The vertices."""
        return {"vertices": self.transfer(body.posed(frames)).float().cpu().numpy()}

    def write(self, chunks: FittedChunks, files: ResultFiles, *, fps: float, source: str) -> dict[str, Any]:
        """Write the products, for which the mesh is streamed chunk by chunk."""
        transfer, triangles = self.transfer, self.transfer.triangles.cpu().numpy()
        mesh = MeshFrames(
            pieces=functools.partial(_column, chunks, "vertices"), frame_count=chunks.frame_count,
            vertex_count=transfer.count, triangles=triangles, counts=np.full(len(triangles), 3),
            indices=triangles.ravel(), fps=fps, metres=METRES[transfer.spec.unit], up=transfer.spec.up,
            source=source,
        )  # fmt: skip
        for product in self.products:
            WRITERS[product].write(files.product(product), mesh)
        return {"frames": chunks.frame_count, "vertices": transfer.count}


@dataclass(frozen=True, kw_only=True, eq=False)
class SmplTarget:
    """Pose parameters of SMPL, SMPL-H or SMPL-X, as AMASS stores them.

    Attributes:
        fit: to the model.
        errors: by regions of its mesh.
        model, gender: which it is.
        params: the body; None while it is yet to be found.
        up: upward axis of the world that is written.
        width: shape coefficients that are written; None: those of the body, or of the model.
        layout: ``amass`` or ``smplx``, the names of the keys.
        expression: (frames, k) coefficients of the face that the motion keeps of its own SMPL-X.
        expected: factor on how firmly joints are held near the motion's own turns; 0 for not at all.
    """

    fit: NativeFit
    errors: NativeErrors
    model: SmplName
    gender: Gender
    params: Mapping[str, list[float]] | None
    up: UpAxis
    width: int | None = None
    layout: str = "amass"
    expression: np.ndarray | None = None
    expected: float = 1.0

    def __post_init__(self) -> None:
        """Leave out coefficients that are not to be written: poses then make up for what they can."""
        betas = (self.params or {}).get("betas", [])
        left_out = np.abs(betas[self.width :]).max(initial=0) if self.width else 0
        if left_out > 0:
            _log.warning(
                "num_betas=%d leaves out betas of up to %.2g; the body is the nearest without them",
                self.width, left_out,
            )  # fmt: skip
            object.__setattr__(self, "params", {**(self.params or {}), "betas": betas[: self.width]})

    def find(self, body: Played) -> Mapping[str, Tensor]:
        """Parameters of the model's body that comes nearest to frames spread over a motion."""
        return _found_by_frames(self.fit, body)

    @property
    def facts(self) -> Mapping[str, Any]:
        """The body and the world."""
        params = "found" if self.params is None else dict(self.params)
        return {
            "to": self.model, "gender": self.gender, "params": params, "up": self.up,
            "num_betas": self.width, "to_layout": self.layout, "expected": self.expected,
        }  # fmt: skip

    def results(self, files: ResultFiles) -> dict[str, Path]:
        """One file of poses."""
        return {"npz": files.motion}

    def arrays(self, body: Played, frames: slice) -> dict[str, np.ndarray]:
        """Parameters of the frames, and statistics of the error."""
        vertices = body.posed(frames)
        if self.up != "+y":  # the fit does not care which way a body is turned
            vertices = vertices @ torch.as_tensor(world_axes(self.up)).to(vertices)
        near: dict[str, Tensor] = {}
        if self.expected:
            turns, firmness = turns_to_smpl(body.motion.cut(frames), self.model)
            near = {"expected": torch.as_tensor(turns), "firmness": self.expected * torch.as_tensor(firmness)}
        found = self.fit(vertices, params=self.params, weights=self.fit.transfer.shares, **near)
        return {
            "rotations": found.rotations.float().cpu().numpy(),
            "translation": found.translation.float().cpu().numpy(),
            "determined": found.determined.cpu().numpy(),
            **_told(found, self.errors),
        }

    def write(self, chunks: FittedChunks, files: ResultFiles, *, fps: float, source: str) -> dict[str, Any]:
        """Write ``files.motion`` in the layout of AMASS or with the names of smplx, and ``files.frames``."""
        columns = {name: np.concatenate(list(_column(chunks, name))) for name in ("rotations", "translation")}
        motion = SmplMotion(
            model=self.model, **columns, betas=self._betas(), gender=self.gender, fps=fps, up=self.up,
            expression=self.expression,
        )  # fmt: skip
        extra = {"source": np.array(source), "up_axis": np.array(self.up[1:].upper())}
        (write_amass if self.layout == "amass" else write_smplx)(motion, files.motion, extra=extra)
        (determined,) = chunks.load(0, "determined")
        names = zip(self.fit.joint_names, determined, strict=True)
        unknown = [name for name, known in names if not known]
        return {"undetermined_joints": unknown, **_figures(chunks, files, self.errors)}

    def _betas(self) -> np.ndarray:
        """Coefficients of the width that is written, zeros at the end: other tools multiply all of them."""
        own = np.array((self.params or {}).get("betas", []))
        (width,) = self.fit.spec.params[0].shape
        usual = len(own) if len(own) >= _USUAL_BETAS else min(max(width, _USUAL_BETAS), _MOST_USUAL_BETAS)
        width = self.width or usual
        return np.pad(own, (0, width - len(own)))


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterTarget:
    """Pose parameters of a model whose pose is one vector, such as MHR, under that model's own names.

    Attributes:
        fit: to the model.
        errors: by regions of its mesh.
        model: name of its backend.
        params: the body; None while it is yet to be found.
    """

    fit: ParameterFit
    errors: NativeErrors
    model: str
    params: Mapping[str, Any] | None

    @property
    def facts(self) -> Mapping[str, Any]:
        """The body."""
        return {"to": self.model, "params": "found" if self.params is None else dict(self.params)}

    def results(self, files: ResultFiles) -> dict[str, Path]:
        """One file of parameters."""
        return {"npz": files.motion}

    def find(self, body: Played) -> Mapping[str, Tensor]:
        """Parameters of the model's body that comes nearest to the T-pose."""
        return _found_by_t_pose(self.fit, body)

    def arrays(self, body: Played, frames: slice) -> dict[str, np.ndarray]:
        """Parameters of the frames, and statistics of the error."""
        found = self.fit(body.posed(frames), params=self.params)
        own = self.fit.generator.own_arrays(found.params, found.parameters)
        return {
            **{_OWN + name: value.float().cpu().numpy() for name, value in own.items()},
            **_told(found, self.errors),
        }

    def write(self, chunks: FittedChunks, files: ResultFiles, *, fps: float, source: str) -> dict[str, Any]:
        """Write ``files.motion`` with the model's own arrays, and ``files.frames``."""
        names = [name for name in chunks.names(0) if name.startswith(_OWN)]
        own = {name[len(_OWN) :]: np.concatenate(list(_column(chunks, name))) for name in names}
        told = {"model": self.model, "fps": fps, "source": source}
        atomic_arrays(files.motion, own | {name: np.asarray(value) for name, value in told.items()})
        return _figures(chunks, files, self.errors)


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelTarget:
    """Poses of a plugin's model, in files that the plugin writes.

    Attributes:
        fit: to the model, by its skinning or by its pose vector.
        errors: by regions of its mesh.
        model: name of its backend.
        form: what its files are.
        params: the body; None while it is yet to be found.
        options: of the backend.
    """

    fit: NativeFit | ParameterFit
    errors: NativeErrors
    model: str
    form: MotionFormat
    params: Mapping[str, Any] | None
    options: Mapping[str, Any]

    @property
    def facts(self) -> Mapping[str, Any]:
        """The body, and the file."""
        params = "found" if self.params is None else dict(self.params)
        return {"to": self.model, "format": self.form.name, "params": params, "up": self.fit.spec.up}

    def results(self, files: ResultFiles) -> dict[str, Path]:
        """One file of poses."""
        return {self.form.name: self._file(files)}

    def _file(self, files: ResultFiles) -> Path:
        return files.motion.with_suffix(self.form.suffixes[0])

    def find(self, body: Played) -> Mapping[str, Tensor]:
        """Parameters of the model's body that comes nearest."""
        if isinstance(self.fit, NativeFit):
            return _found_by_frames(self.fit, body)
        return _found_by_t_pose(self.fit, body)

    def arrays(self, body: Played, frames: slice) -> dict[str, np.ndarray]:
        """Poses of the frames, and statistics of the error."""
        found = self.fit(body.posed(frames), params=self.params)
        names = ("rotations", "translation") if isinstance(self.fit, NativeFit) else ("parameters",)
        poses = {_OWN + name: getattr(found, name).float().cpu().numpy() for name in names}
        return {**poses, **_told(found, self.errors)}

    def write(self, chunks: FittedChunks, files: ResultFiles, *, fps: float, source: str) -> dict[str, Any]:
        """Let the plugin write its file; write ``files.frames``."""
        names = [name for name in chunks.names(0) if name.startswith(_OWN)]
        pose = {name[len(_OWN) :]: np.concatenate(list(_column(chunks, name))) for name in names}
        motion = ModelMotion(
            params=dict(self.params or {}), pose=pose, fps=fps, up=self.fit.spec.up, options=self.options,
            source=source,
        )  # fmt: skip
        assert self.form.write is not None
        with default_registry().isolated(self.model, "hooks"):
            self._file(files).parent.mkdir(parents=True, exist_ok=True)
            self.form.write(self._file(files), motion)
        return _figures(chunks, files, self.errors)


def _found_by_frames(fit: NativeFit, body: Played) -> Mapping[str, Tensor]:
    """Parameters of the model's body that comes nearest to frames spread over a motion."""
    frames = body.motion.frame_count
    spread = np.unique(np.linspace(0, frames - 1, min(_SEARCHED, frames)).round().astype(int))
    _log.info("finding the body from %d frames", len(spread))
    return fit.fit_params(body.posed(spread))


def _found_by_t_pose(fit: ParameterFit, body: Played) -> Mapping[str, Tensor]:
    """Parameters of the model's body that comes nearest to the T-pose."""
    _log.info("finding the body from its T-pose")
    layer = body.layer
    still = torch.zeros(1, len(layer.joint_names), 3, device=layer.device, dtype=layer.dtype)
    return fit.fit_params(layer.pose(body.identity, still).vertices)


def _told(found: NativeMotion | ParameterMotion, errors: NativeErrors) -> dict[str, np.ndarray]:
    """What a fit says of each frame, and statistics of its error."""
    return {
        "valid": found.valid.cpu().numpy(),
        "converged": found.converged.cpu().numpy(),
        "iterations": found.iterations.cpu().numpy(),
        **errors.statistics(found.vertex_error.float().cpu().numpy()),
    }


def _figures(chunks: FittedChunks, files: ResultFiles, errors: NativeErrors) -> dict[str, Any]:
    """Write what became of each frame; how far the model's vertices lie from the body's, for the report."""
    frames = {name: np.concatenate(list(_column(chunks, name))) for name in _PER_FRAME}
    atomic_arrays(files.frames, frames)
    parts = [dict(zip(_SUMMED, arrays, strict=True)) for arrays in chunks.load_all(*_SUMMED)]
    valid = int(frames["valid"].sum())
    return {
        "frames": chunks.frame_count,
        "unusable_frames": chunks.frame_count - valid,
        "converged_share": int(frames["converged"].sum()) / valid if valid else None,
        "error_mm": errors.figures(parts),
    }


def _column(chunks: FittedChunks, name: str) -> Iterator[np.ndarray]:
    """One array of each chunk, in the order of the frames."""
    return (array for (array,) in chunks.load_all(name))
