"""The exact curvature of the error of a posed body, as products with motions of its joints.

A vertex is ``y = A(T) (rest + s V a) + c(T)``: transforms T and activations a follow from the pose, and the
error is a polynomial in both. Its second derivative along a motion u is that of the polynomial along
``(T', a')``, which differences give without error, plus that of the path that T and a take, weighted by the
slope in them.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import torch
from torch import Tensor

from soma_core.geometry.sparse import sparse_product

if TYPE_CHECKING:
    from soma_core.geometry.sparse import SparseRows
    from soma_core.inversion.gauss_newton import GaussNewton
    from soma_core.inversion.offsets import PoseOffsets
    from soma_core.inversion.problem import Activity, Pose, Problem
    from soma_core.kernels.model_residual import ModelResidual

__all__ = ["SkinCurvature", "in_float64", "problem_in_float64"]

_Module = TypeVar("_Module", bound=torch.nn.Module)

_REACH = 0.25
"""Largest change of any transform or activation in a difference: rounding is smallest relative to such."""

_STENCILS = {
    1: ((1.0, 1 / 2), (-1.0, -1 / 2)),
    2: ((1.0, 8 / 12), (-1.0, -8 / 12), (2.0, -1 / 12), (-2.0, 1 / 12)),
}
"""Steps and factors whose sum is the derivative of forces: a polynomial of degree one in transforms alone, of
degree three in both."""

_FRAMES = 8
"""Frames whose vertices are posed at a time."""


class PosedSkin(Protocol):
    """What curvature asks of a model of skinning and offsets.

    Attributes:
        solver: the equations of its joints; `offsets`: what poses add to the rest shape; None without.
        skin: weights (v, T); `residual`: compares poses with targets.
    """

    @property
    def solver(self) -> GaussNewton: ...

    @property
    def offsets(self) -> PoseOffsets | None: ...

    @property
    def skin(self) -> SparseRows: ...

    @property
    def residual(self) -> ModelResidual: ...

    @property
    def precise(self) -> PosedSkin:
        """The same in float64."""

    def posing(
        self, problem: Problem, turns: Tensor, places: Tensor, activity: Activity | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None, Tensor, Tensor]:
        """What :class:`ModelResidual` takes."""
        ...


class SkinCurvature:
    """Curvature of a model of skinning and offsets at poses, in float64; see :class:`Curvature`.

    Args:
        model: the forward model.
        problem: targets, weights and identity.
        pose: about the problem's origin.

    Attributes:
        energy: of the poses, (F,) [m^2].
        slope: half its derivative (F, n + 1, 3).
    """

    def __init__(self, model: PosedSkin, problem: Problem, pose: Pose) -> None:
        self._model, self._problem = model.precise, problem_in_float64(problem)
        solver, offsets, rest = self._model.solver, self._model.offsets, self._problem.rest
        pose = replace(pose, relative=pose.relative.double(), translation=pose.translation.double())
        with torch.enable_grad():
            turns, _ = solver.walk(pose, rest)
            self._motion = torch.zeros_like(turns[:, : len(solver.variables) + 1, 0]).requires_grad_()
            near = solver.retract(pose, turns, self._motion)
            activity = None if offsets is None else offsets.activity(near.relative)
            self._given = self._model.posing(self._problem, *solver.walk(near, rest), activity)
            self._path = [one for one in self._given[2:4] if one is not None]
            self._at = [one.detach() for one in self._path]
            self._probe = [torch.zeros_like(one).requires_grad_() for one in self._path]
            self._pulled = self._back(self._probe, create_graph=True)
            self.energy, forces = self._forces(self._at)
            self._pull = self._back(forces, create_graph=True)
        self.slope = self._pull.detach()

    def times(self, motion: Tensor) -> Tensor:
        """Half the second derivative of the error, times a motion (F, n + 1, 3)."""
        (bent,) = torch.autograd.grad(self._pull, self._motion, motion, retain_graph=True)
        return bent + self._back(self._change(self._along(motion)))

    def moved(self, motion: Tensor) -> Tensor:
        """Velocities (F, v, 3) of the vertices in a motion (F, n + 1, 3)."""
        along = self._along(motion)
        reach = _reach(along)
        ahead, behind = (self._posed(self._stepped(along, sign * reach)) for sign in (1, -1))
        return (ahead - behind) / (2 * reach[:, None, None])

    def residual(self) -> Tensor:
        """What is left of the targets, (F, v, 3) [m]."""
        return self._posed(self._at) - (self._problem.vertices - self._problem.origin[:, None])

    def _back(self, cotangents: list[Tensor], *, create_graph: bool = False) -> Tensor:
        return torch.autograd.grad(
            self._path, self._motion, cotangents, retain_graph=True, create_graph=create_graph
        )[0]

    def _along(self, motion: Tensor) -> list[Tensor]:
        """Velocities of transforms and activations."""
        return list(torch.autograd.grad(self._pulled, self._probe, motion, retain_graph=True))

    def _stepped(self, along: list[Tensor], step: Tensor) -> list[Tensor]:
        return [
            one + step.view(-1, *[1] * (one.ndim - 1)) * way for one, way in zip(self._at, along, strict=True)
        ]

    def _forces(self, path: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """The error (F,), and half its slope in transforms and activations."""
        rest, weights, _, _, scale, *target = self._given
        activations = path[1] if len(path) > 1 else None
        found = self._model.residual(rest, weights, path[0], activations, scale, *target)
        assert found.forces is not None
        return found.energy, [found.forces] if found.pull is None else [found.forces, found.pull]

    def _change(self, along: list[Tensor]) -> list[Tensor]:
        """How that slope changes along velocities."""
        reach = _reach(along)
        total = [torch.zeros_like(one) for one in along]
        for step, factor in _STENCILS[len(along)]:
            _, found = self._forces(self._stepped(along, step * reach))
            total = [one + factor * more for one, more in zip(total, found, strict=True)]
        return [one / reach.view(-1, *[1] * (one.ndim - 1)) for one in total]

    def _posed(self, path: list[Tensor]) -> Tensor:
        """Vertices (F, v, 3) of transforms and activations, about the problem's origin."""
        rest, offsets, scale = self._given[0], self._model.offsets, self._given[4]
        parts = []
        for rows in torch.arange(len(path[0]), device=rest.device).split(_FRAMES):
            points = rest[rows] if len(rest) > 1 else rest.expand(len(rows), -1, 3)
            if offsets is not None and scale is not None:
                moves = sparse_product(offsets.shapes.csr, path[1][rows].T.contiguous())
                points = points + scale[rows, None, None] * moves.T.unflatten(1, (-1, 3))
            flat = path[0][rows].permute(1, 2, 3, 0).flatten(1).contiguous()
            blend = sparse_product(self._model.skin.csr, flat).unflatten(1, (3, 4, -1)).permute(3, 0, 1, 2)
            parts.append((blend[..., :3] @ points[..., None]).squeeze(-1) + blend[..., 3])
        return torch.cat(parts)


def _reach(along: list[Tensor]) -> Tensor:
    """(F,) steps that change no entry by more than a bound."""
    largest = torch.stack([one.flatten(1).abs().amax(1) for one in along]).amax(0)
    return _REACH / largest.clamp_min(1e-100)


def in_float64(module: _Module, children: Iterable[str] | None = None) -> _Module:
    """A copy whose buffers, and those of the named children or all, are float64; the rest is shared."""
    twin = copy.copy(module)
    twin.__dict__.update({name: _exact(one) for name, one in vars(module).items()})
    twin._buffers = {name: _exact(one) for name, one in module._buffers.items()}
    twin._modules = {
        name: in_float64(one) if one is not None and (children is None or name in children) else one
        for name, one in module._modules.items()
    }
    return twin


def _exact(value: Any) -> Any:
    return value.double() if isinstance(value, Tensor) and value.is_floating_point() else value


def problem_in_float64(problem: Problem) -> Problem:
    """The problem for :class:`SkinCurvature`: moments stay as they are."""
    identity, rest, driven = problem.identity, problem.rest, problem.rest.driven
    if driven is not None:
        driven = replace(driven, **{name: one.double() for name, one in vars(driven).items()})
    return replace(
        problem,
        vertices=problem.vertices.double(),
        weights=problem.weights.double(),
        identity=replace(identity, rest=identity.rest.double(), bind_world=identity.bind_world.double()),
        rest=replace(rest, offsets=rest.offsets.double(), driven=driven),
        origin=problem.origin.double(),
    )
