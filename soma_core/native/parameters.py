"""SOMA bodies to the parameters of a native model that says nothing but where its vertices go.

A model that tells its skinning is fitted by :class:`NativeFit`, exactly and many frames at once. Others, such
as MHR, whose pose is one vector of parameters, are evaluated: Levenberg-Marquardt steps on vertices, their
slopes by differences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from soma_core.backends.parameters import batch_parameters
from soma_core.errors import InputError
from soma_core.inversion.levenberg import Damping, descend
from soma_core.native.transfer import NativeTransfer
from soma_core.plugin.declaration import refuse_posed
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import HasPoseVector
from soma_core.rig.mesh import Lod
from soma_core.topology.frames import METRES

__all__ = ["ParameterFit", "ParameterMotion"]

_POINTS = 1500
"""Vertices that a fit looks at, spread over the mesh: ten for each of the unknowns of MHR."""

_ROWS = 32
"""Bodies evaluated at a time."""

_STEP, _SHARE = 5e-3, 5e-3
"""Of differences: in a pose parameter, and of the range of another. Float32 leaves them three digits."""

_RIDGE = 1e-6
"""A parameter away from its start by one costs as much as this mean square error [m^2], a millimetre: that
decides what no vertex tells."""

_DAMPING = Damping(tries=6, lower=1 / 3, higher=4.0)

_GOOD, _LIKE = 2e-3, 1.2
"""A frame is tried from the rest pose too where it is not met this well, as a root mean square [m], nor about
as well as the one before it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterMotion:
    """Pose parameters of every frame, one body for all.

    Attributes:
        parameters: what the generator's ``posed`` takes under ``parameters``, (frames, p).
        params: the body, batch of 1.
        vertex_error: distance of the model's vertices to their targets [m], (frames, n); NaN without one.
        valid: (frames,) bool; False where the target is not finite. Parameters are zero there.
        converged: (frames,) bool; the last step moved the vertices by less than the tolerance.
        iterations: (frames,) int, accepted steps.
    """

    parameters: Tensor
    params: Mapping[str, Tensor]
    vertex_error: Tensor
    valid: Tensor
    converged: Tensor
    iterations: Tensor


class ParameterFit:
    """Recovers the pose parameters of a native model from posed SOMA bodies. Not differentiable.

    Frames are fitted one after the other, each from the one before it.

    Args:
        backend: name of an installed backend whose generator has a pose vector, such as mhr.
        options: the backend's own options.
        lod: of the canonical vertices that come in.
        iterations: largest number of steps a frame.
        tolerance: a frame rests once a step moves its vertices by less, as a root mean square [m].
        device, dtype: of all constants and results.
        registry: where backends are looked up.

    Attributes:
        transfer: canonical vertices to the native topology.

    Raises:
        InputError: the backend's poses are no vector of parameters.
        BackendError: the backend is not usable.
    """

    def __init__(
        self,
        backend: str,
        *,
        options: Mapping[str, Any] | None = None,
        lod: Lod = "mid",
        iterations: int = 40,
        tolerance: float = 5e-5,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        registry: Registry | None = None,
    ) -> None:
        registry = registry or default_registry()
        self.device, self.dtype = torch.device(device), dtype
        self._iterations, self._tolerance = iterations, tolerance
        kind: dict[str, Any] = {"device": self.device, "dtype": dtype}
        generator = registry.generator(backend, options=options or {}, **kind)
        if not isinstance(generator, HasPoseVector):
            raise InputError(
                "backend", got=f"{backend}, whose poses are no vector of parameters",
                expected="a backend whose generator has a pose vector, such as mhr",
                fix="NativeFit takes those that tell their skinning, NativeTransfer gives vertices of all.",
            )  # fmt: skip
        self.generator = generator
        self._isolated = lambda: registry.isolated(backend, "rest")
        self.transfer = NativeTransfer(backend, lod=lod, registry=registry, **kind)
        self.spec, self.scale = self.transfer.spec, METRES[self.transfer.spec.unit]
        covered = self.transfer.covered.nonzero()[:, 0]
        self._points = covered[:: max(1, len(covered) // _POINTS)]

    @torch.no_grad()
    def __call__(self, vertices: Tensor, *, params: Mapping[str, Any] | None = None) -> ParameterMotion:
        """Fit every frame.

        Args:
            vertices: canonical vertices (F, v, 3) [m], +Y up.
            params: the body's parameters, one sample; what is left out has its default.
        """
        target = self.scale * self.transfer(vertices.to(self.device, self.dtype))
        body = batch_parameters(self.spec, params, device=self.device, dtype=self.dtype)
        valid = torch.isfinite(target[:, self.transfer.covered]).flatten(1).all(1)
        rest = torch.zeros(self.generator.pose_size, device=self.device, dtype=self.dtype)
        found, last = [], None
        for frame, usable in zip(target[:, self._points], valid.tolist(), strict=True):
            row = _Fitted(rest, rest, torch.inf) if not usable else self._frame(body, frame, last)
            last = row if usable else last
            found.append(row)
        parameters = torch.stack([row.point for row in found])
        shown = self._evaluated(lambda rows: (body, rows), parameters)
        error = torch.linalg.vector_norm(shown - target, dim=-1)
        known = valid[:, None] & self.transfer.covered
        return ParameterMotion(
            parameters=parameters, params=body, valid=valid,
            vertex_error=error.masked_fill(~known, torch.nan),
            converged=torch.tensor([row.converged for row in found]),
            iterations=torch.tensor([row.steps for row in found]),
        )  # fmt: skip

    @torch.no_grad()
    def fit_params(self, vertices: Tensor) -> dict[str, Tensor]:
        """Parameters of the body that comes nearest to one frame, batch of 1, its pose fitted with them.

        A pose that opens the limbs shows most, such as the T-pose. What one frame leaves open stays near the
        default.

        Args:
            vertices: canonical vertices (1, v, 3) [m], +Y up.

        Raises:
            InputError: another number of frames, or vertices that are not finite.
        """
        if len(vertices) != 1 or not bool(torch.isfinite(vertices).all()):
            raise InputError(
                "vertices", got=f"{len(vertices)} frames", expected="one frame of finite vertices",
                fix="Pass the body in its T-pose: layer.pose(identity, torch.zeros(1, 77, 3)).vertices.",
            )  # fmt: skip
        target = (self.scale * self.transfer(vertices.to(self.device, self.dtype)))[0, self._points]
        begin = batch_parameters(self.spec, None, device=self.device, dtype=self.dtype)
        sizes = {name: value[0].numel() for name, value in begin.items()}
        pose = self._frame(begin, target, None).point
        start = torch.cat([pose, *(value.flatten() for value in begin.values())])

        def inputs(rows: Tensor) -> tuple[dict[str, Tensor], Tensor]:
            pose, *parts = rows.split([len(pose_steps), *sizes.values()], 1)
            shapes = zip(begin.items(), parts, strict=True)
            return {name: part.reshape(-1, *value.shape[1:]) for (name, value), part in shapes}, pose

        pose_steps = self._pose_steps()
        ranges = {each.name: each.range[1] - each.range[0] for each in self.spec.params}
        steps = torch.cat(
            [
                pose_steps,
                *(pose_steps.new_full((size,), _SHARE * ranges[name]) for name, size in sizes.items()),
            ]
        )
        fitted = self._levenberg(inputs, start, target, steps, around=start)
        return inputs(fitted.point[None])[0]

    def _pose_steps(self) -> Tensor:
        return torch.full((self.generator.pose_size,), _STEP, device=self.device, dtype=self.dtype)

    def _frame(self, body: Mapping[str, Tensor], target: Tensor, last: _Fitted | None) -> _Fitted:
        """Best pose for target points (m, 3) [m], from the one before it or from the rest pose."""

        def inputs(rows: Tensor) -> tuple[Mapping[str, Tensor], Tensor]:
            return body, rows

        steps = self._pose_steps()
        rest = torch.zeros_like(steps)
        found = None if last is None else self._levenberg(inputs, last.point, target, steps, around=rest)
        if found is not None and last is not None and found.error < max(_GOOD, _LIKE * last.error):
            return found
        cold = self._levenberg(inputs, self._stood(inputs, target, rest), target, steps, around=rest)
        return cold if found is None or cold.error < found.error else found

    def _stood(self, inputs: _Inputs, target: Tensor, rest: Tensor) -> Tensor:
        """The rest pose where the target stands, turned as it is: the best of four beginnings."""
        root, steps = self.generator.root_size, self._pose_steps()
        free = torch.arange(root, device=self.device)
        found = []
        for turn in (0.0, 0.5, 1.0, 1.5):
            start = rest.clone()
            start[self.generator.heading] = turn * torch.pi
            found.append(self._levenberg(inputs, start, target, steps, around=start, free=free))
        return min(found, key=lambda row: row.error).point

    def _levenberg(
        self,
        inputs: _Inputs,
        start: Tensor,
        target: Tensor,
        steps: Tensor,
        *,
        around: Tensor,
        free: Tensor | None = None,
    ) -> _Fitted:
        """Least squares from `start`: points to `target`, and parameters to `around` where nothing tells."""
        free = torch.arange(len(start), device=self.device) if free is None else free
        weight = _RIDGE * torch.ones(len(free), dtype=torch.float64, device=self.device)

        def state(point: Tensor, steps: int) -> _Fitted:
            shown = self._seen(inputs, point[None])[0]
            away = (point - around)[free].double()
            squares = (shown - target).double().square().sum(-1).mean() + (weight * away.square()).sum()
            return _Fitted(point, shown, float(squares), steps=steps)

        def attempts(now: _Fitted) -> Callable[[float], tuple[_Fitted, bool, bool]]:
            slope = self._slopes(inputs, now.point, now.shown, steps, free)
            residual = (now.shown - target).double().flatten()
            matrix = slope.T @ slope / len(target) + torch.diag(weight)
            right = slope.T @ residual / len(target) + weight * (now.point - around)[free].double()

            def attempt(damping: float) -> tuple[_Fitted, bool, bool]:
                damped = matrix + damping * torch.diag(matrix.diagonal())
                move = -torch.cholesky_solve(right[:, None], torch.linalg.cholesky(damped))[:, 0]
                point = now.point.clone()
                point[free] += move.to(point)
                trial = state(point, now.steps + 1)
                change = float((trial.shown - now.shown).square().sum(-1).mean().sqrt())
                return trial, trial.cost < now.cost, change < self._tolerance

            return attempt

        found, rests = descend(state(start, 0), attempts, damping=_DAMPING, iterations=self._iterations)
        rms = float((found.shown - target).square().sum(-1).mean().sqrt())
        return replace(found, error=rms, converged=rests)

    def _slopes(self, inputs: _Inputs, point: Tensor, shown: Tensor, steps: Tensor, free: Tensor) -> Tensor:
        """What each free parameter does to the points, (3 m, k) float64 [m]."""
        rows = point.repeat(len(free), 1)
        rows[torch.arange(len(free)), free] += steps[free]
        moved = self._seen(inputs, rows) - shown
        return (moved / steps[free, None, None]).double().flatten(1).T

    def _seen(self, inputs: _Inputs, rows: Tensor) -> Tensor:
        """The points that a fit looks at, (B, m, 3) [m]."""
        return torch.cat([self._posed(*inputs(part))[:, self._points] for part in rows.split(_ROWS)])

    def _evaluated(self, inputs: _Inputs, rows: Tensor) -> Tensor:
        """All vertices (B, n, 3) [m]."""
        return torch.cat([self._posed(*inputs(part)) for part in rows.split(_ROWS)])

    def _posed(self, params: Mapping[str, Tensor], parameters: Tensor) -> Tensor:
        with self._isolated():
            found = self.generator.posed(params, {"parameters": parameters})
            refuse_posed(found, len(parameters))
            return self.scale * found


_Inputs = Callable[[Tensor], tuple[Mapping[str, Tensor], Tensor]]
"""Rows of unknowns as the body's parameters and the pose vector of each."""


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Where a descent is: its unknowns, points and cost [m^2]; in the end the error [m], and how it went."""

    point: Tensor
    shown: Tensor
    cost: float
    error: float = float("inf")
    converged: bool = False
    steps: int = 0
