"""Fit frames and keep what a table of angles needs: errors, angles joint by joint, convergence, time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.evaluation.joint_turns import angles_between
from soma_core.evaluation.pose_angle_meshes import BODIES, TestBody, drifting_hips, rotation_matrices
from soma_core.evaluation.report import Figure, Table
from soma_core.evaluation.shipped_layers import LayerMaker, plain_layer
from soma_core.inversion import InversionResult, PoseInversion
from soma_core.inversion.fit import Topology
from soma_core.layer import SomaLayer
from soma_core.rig.mesh import Lod
from soma_core.skeleton.identity import Identity

__all__ = [
    "COLUMNS", "Fit", "InversionMaker", "Piece", "Trial", "finger_joints",
    "fit_frames", "own_fit", "piece", "posed_vertices", "visible_joints",
]  # fmt: skip

InversionMaker = Callable[..., PoseInversion]
"""``make(layer, **options)``; ``PoseInversion`` itself unless a caller has another."""

_LEAST_VERTICES = 50
"""A joint that moves fewer vertices hardly shows in them."""

_NOTICEABLE = 0.01
"""Skin weight above which a vertex moves with a joint."""

WRONG_DEGREES = 2.0
"""A frame that is flagged converged and has a joint beyond this angle is a wrong answer without warning."""

_CHUNK = 64
"""Frames posed at a time."""

COLUMNS = (
    "layer", "frames", "mean, mm", "max, mm", "angle, mean, degrees", "P95", "max", "worst joint",
    "converged, %", "converged but wrong, frames", "frames/s",
)  # fmt: skip
"""Of a table of fits, after the column that names the row."""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """What one part of an experiment found on one layer.

    Attributes:
        layer: ``default`` or ``plain``.
        table: rows for people.
        figures: with the bounds of the default.
    """

    layer: str
    table: Table
    figures: Sequence[Figure]

    def without_bounds(self) -> Piece:
        """The same, only to inform."""
        return replace(self, figures=[replace(figure, bound=None) for figure in self.figures])


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """Fitted frames.

    Attributes:
        mean_mm, max_mm: (F,) vertex error of each frame, mouth and eye bags left out; NaN where not valid.
        angles: (F, K) between fitted and true rotations [degrees], of the `joints`; K = 0 without a truth.
        joints: (K,) names.
        converged, plain: (F,) bool, as flagged.
        seconds: that the fit took.
        result: None for a part.
    """

    mean_mm: np.ndarray
    max_mm: np.ndarray
    angles: np.ndarray
    joints: tuple[str, ...]
    converged: np.ndarray
    plain: np.ndarray
    seconds: float
    result: InversionResult | None = None

    def part(self, frames: slice) -> Fit:
        """Some of the frames; the time is not divided."""
        return Fit(
            mean_mm=self.mean_mm[frames], max_mm=self.max_mm[frames], angles=self.angles[frames],
            joints=self.joints, converged=self.converged[frames], plain=self.plain[frames],
            seconds=float("nan"),
        )  # fmt: skip

    @staticmethod
    def joined(fits: Sequence[Fit]) -> Fit:
        """Several fits of the same kind of layer as one."""
        return Fit(
            mean_mm=np.concatenate([fit.mean_mm for fit in fits]),
            max_mm=np.concatenate([fit.max_mm for fit in fits]),
            angles=np.concatenate([fit.angles for fit in fits]),
            joints=fits[0].joints,
            converged=np.concatenate([fit.converged for fit in fits]),
            plain=np.concatenate([fit.plain for fit in fits]),
            seconds=sum(fit.seconds for fit in fits),
        )

    @property
    def wrong(self) -> int:
        """Number of frames that are flagged converged and have a joint beyond two degrees."""
        return int((self.converged & (self.worst > WRONG_DEGREES)).sum())

    @property
    def worst(self) -> np.ndarray:
        """(F,) largest angle of each frame [degrees]."""
        return self.angles.max(axis=1, initial=0.0)

    @property
    def not_converged(self) -> float:
        """Percentage of the frames that are not flagged converged."""
        return 100 * float(1 - self.converged.mean())

    def of(self, wanted: Callable[[str], bool]) -> np.ndarray:
        """Angles (F, k) of joints by name [degrees]."""
        return self.angles[:, [wanted(name) for name in self.joints]]

    def row(self, name: str, layer: str) -> tuple[str | float | None, ...]:
        """A row under `COLUMNS`."""
        mean, p95, largest, worst = None, None, None, None
        if self.angles.size:
            mean, p95 = float(self.angles.mean()), float(np.percentile(self.angles, 95))
            largest = float(self.angles.max())
            worst = self.joints[int(np.unravel_index(self.angles.argmax(), self.angles.shape)[1])]
        speed = None if np.isnan(self.seconds) else len(self.converged) / self.seconds
        return (
            name, layer, len(self.converged), float(self.mean_mm.mean()), float(self.max_mm.max()), mean, p95,
            largest, worst, 100 - self.not_converged, self.wrong, speed,
        )  # fmt: skip


def fit_frames(
    inversion: PoseInversion,
    vertices: Tensor,
    identity: Identity,
    truth: Tensor | None = None,
    *,
    weights: Tensor | None = None,
    topology: Topology = "canonical",
) -> Fit:
    """Fit frames and compare them with the true rotations (F, J - 1, 3, 3), where they are known.

    Args:
        inversion: the fit.
        vertices, identity, weights, topology: as in :class:`PoseInversion`.
        truth: true rotations.
    """
    layer = inversion.layer
    options: dict[str, Any] = {"weights": weights, "topology": topology}
    with torch.no_grad():
        first = weights[:1] if weights is not None and weights.ndim > 1 else weights
        inversion(vertices[:1], identity, **options | {"weights": first})  # compiles before the clock runs
        begin = time.perf_counter()
        result = inversion(vertices, identity, **options)
        result.residual.sum().item()  # waits for the device
        seconds = time.perf_counter() - begin
    skin = torch.as_tensor(inversion.default_weights) > 0
    error = 1e3 * result.vertex_error[:, skin].double()
    joints = visible_joints(layer) if truth is not None else np.empty(0, int)
    angles = np.empty((len(vertices), 0))
    if truth is not None:
        angles = angles_between(result.rotations[:, joints], truth[:, joints])
    return Fit(
        mean_mm=error.nanmean(1).cpu().numpy(),
        max_mm=error.nan_to_num(0).amax(1).cpu().numpy(),
        angles=angles,
        joints=tuple(layer.joint_names[joint] for joint in joints),
        converged=result.converged.cpu().numpy(),
        plain=result.plain.cpu().numpy(),
        seconds=seconds,
        result=result,
    )


def visible_joints(layer: SomaLayer) -> np.ndarray:
    """Numbers, among the user joints, of those that move enough vertices to show in them."""
    moved = np.asarray((layer.rig.weights > _NOTICEABLE).sum(axis=0)).ravel()[1:]
    return np.flatnonzero(moved >= _LEAST_VERTICES)


def finger_joints(name: str) -> bool:
    """Whether a joint is one of a finger."""
    return "Hand" in name and not name.endswith("Hand")


@torch.no_grad()
def posed_vertices(layer: SomaLayer, identity: Identity, rotations: Tensor, hips: Tensor) -> Tensor:
    """Vertices (F, v, 3) [m] of one identity in many poses."""
    chunks = zip(rotations.split(_CHUNK), hips.split(_CHUNK), strict=True)
    return torch.cat([layer.pose(identity, turn, place).vertices for turn, place in chunks])


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What a piece is measured on.

    Attributes:
        make: the layer under test.
        count, seed: frames of each motion, and which.
        lod: of the layer.
        invert: the fit.
        device: of both.
        against: layer whose mean error is taken from that of the layer under test.
    """

    make: LayerMaker
    count: int
    seed: int
    lod: Lod
    invert: InversionMaker
    device: str
    against: LayerMaker

    def bodies(
        self, some: Sequence[TestBody] | None = None, dtype: torch.dtype = torch.float32
    ) -> Iterator[tuple[int, TestBody, SomaLayer, PoseInversion]]:
        """Number, body, layer and fit of each body; one layer for each backend."""
        made: dict[str, tuple[SomaLayer, PoseInversion]] = {}
        for index, body in enumerate(BODIES if some is None else some):
            if body.backend not in made:
                layer = self.make(body.backend, lod=self.lod, device=self.device, dtype=dtype)
                made[body.backend] = layer, self.invert(layer)
            yield index, body, *made[body.backend]

    def random(self, *place: int) -> np.random.Generator:
        """Random numbers of one motion."""
        return np.random.default_rng([self.seed, *place])


def piece(measure: Callable[[Trial], Piece]) -> Callable[..., Piece]:
    """The piece as a function ``(make, count, seed, lod="mid", *, invert, device, against)``."""

    def run(
        make: LayerMaker,
        count: int,
        seed: int,
        lod: Lod = "mid",
        *,
        invert: InversionMaker = PoseInversion,
        device: str = "cpu",
        against: LayerMaker = plain_layer,
    ) -> Piece:
        return measure(
            Trial(make=make, count=count, seed=seed, lod=lod, invert=invert, device=device, against=against)
        )

    run.__name__, run.__doc__ = measure.__name__, measure.__doc__
    return run


def own_fit(
    inversion: PoseInversion, body: TestBody, vectors: np.ndarray, random: np.random.Generator
) -> Fit:
    """Pose a body by rotation vectors (F, J, 3) [rad] and fit it again."""
    layer = inversion.layer
    identity = body.identity(layer)
    rotations = rotation_matrices(vectors, layer)
    hips = drifting_hips(len(vectors), random, layer)
    return fit_frames(inversion, posed_vertices(layer, identity, rotations, hips), identity, rotations)
