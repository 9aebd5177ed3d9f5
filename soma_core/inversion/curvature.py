"""The exact curvature of the error of a posed body, as products with motions of its joints.

A vertex is ``y = A(T) (rest + s V a) + c(T)``: transforms T and activations a follow from the pose, and the error is
a polynomial in both. Its second derivative along a motion u is that of the polynomial along ``(T', a')``, which
differences give without error, plus that of the path that T and a take, weighted by the slope in them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from soma_core.geometry.sparse import SparseRows, sparse_product

if TYPE_CHECKING:
    from soma_core.inversion.model import PoseModel
    from soma_core.inversion.problem import Pose, Problem

__all__ = ["SkinCurvature"]

_REACH = 0.25
"""Largest change of any transform or activation in a difference: rounding is smallest relative to such."""

_STENCILS = ((), ((1.0, 1 / 2), (-1.0, -1 / 2)), ((1.0, 8 / 12), (-1.0, -8 / 12), (2.0, -1 / 12), (-2.0, 1 / 12)))
"""Steps and factors whose sum is the derivative of a polynomial: of transforms alone, and with activations. Forces
are of degree one in those, of degree three in both."""

_FRAMES = 8
"""Frames whose velocities are found at a time."""


class SkinCurvature:
    """Curvature of a model of skinning and offsets at poses; see :class:`Curvature`.

    Args:
        model: the forward model.
        problem: targets, weights and identity.
        pose: about the problem's origin.
    """

    def __init__(self, model: PoseModel, problem: Problem, pose: Pose) -> None:
        self.model, self.problem = model, problem
        with torch.enable_grad():
            turns, _ = model.solver.walk(pose, problem.rest)
            self._motion = torch.zeros_like(turns[:, : len(model.solver.variables) + 1, 0]).requires_grad_()
            near = model.solver.retract(pose, turns, self._motion)
            activity = None if model.offsets is None else model.offsets.activity(near.relative)
            walked = model.solver.walk(near, problem.rest)
            self._given = model._posed(problem, *walked, activity)
            self._path = [one for one in self._given[2:4] if one is not None]
            self._at = [one.detach() for one in self._path]
            self._probe = [torch.zeros_like(one).requires_grad_() for one in self._path]
            self._pulled = self._back(self._probe, create_graph=True)
            self._slope = self._back(self._forces(self._at), create_graph=True)

    def times(self, motion: Tensor) -> Tensor:
        """Half the second derivative of the error, times a motion (F, n + 1, 3)."""
        (bent,) = torch.autograd.grad(self._slope, self._motion, motion, retain_graph=True)
        return bent + self._back(self._change(self._along(motion)))

    def moved(self, motion: Tensor) -> Tensor:
        """Velocities (F, v, 3) of the vertices in a motion (F, n + 1, 3)."""
        along = self._along(motion)
        reach = _reach(along)
        ahead, behind = (self._posed(self._stepped(along, sign * reach)) for sign in (1, -1))
        return (ahead - behind) / (2 * reach[:, None, None])

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

    def _forces(self, path: list[Tensor]) -> list[Tensor]:
        """Half the slope of the error in transforms and activations."""
        given = list(self._given)
        given[2 : 2 + len(path)] = path
        found = self.model.residual(*(None if one is None else one.detach() for one in given))
        forces = torch.zeros_like(path[0])
        forces[:, : found.forces.shape[1]] = found.forces
        return [forces] if len(path) == 1 else [forces, found.pull]

    def _change(self, along: list[Tensor]) -> list[Tensor]:
        """How those change along velocities."""
        reach = _reach(along)
        total = [torch.zeros_like(one) for one in along]
        for step, factor in _STENCILS[len(along)]:
            found = self._forces(self._stepped(along, step * reach))
            total = [one + factor * more for one, more in zip(total, found, strict=True)]
        return [one / reach.view(-1, *[1] * (one.ndim - 1)) for one in total]

    def _posed(self, path: list[Tensor]) -> Tensor:
        """Vertices (F, v, 3) of transforms and activations, about the problem's origin."""
        rest, scale = self._given[0], self._given[4]
        kind = {"dtype": rest.dtype, "device": rest.device}
        skin = SparseRows(self.model._skin, **kind)
        parts = []
        for rows in torch.arange(len(path[0]), device=rest.device).split(_FRAMES):
            points = rest[rows] if len(rest) > 1 else rest.expand(len(rows), -1, 3)
            if len(path) > 1:
                moves = sparse_product(self.model.offsets.shapes.csr, path[1][rows].T.contiguous())
                points = points + scale[rows, None, None] * moves.T.unflatten(1, (-1, 3))
            flat = path[0][rows].permute(1, 2, 3, 0).flatten(1).contiguous()
            blend = sparse_product(skin.csr, flat).unflatten(1, (3, 4, -1)).permute(3, 0, 1, 2)
            parts.append((blend[..., :3] @ points[..., None]).squeeze(-1) + blend[..., 3])
        return torch.cat(parts)


def _reach(along: list[Tensor]) -> Tensor:
    """(F,) steps that change no entry by more than a bound."""
    largest = torch.stack([one.flatten(1).abs().amax(1) for one in along]).amax(0)
    return _REACH / largest.clamp_min(torch.finfo(largest.dtype).tiny / torch.finfo(largest.dtype).eps)
