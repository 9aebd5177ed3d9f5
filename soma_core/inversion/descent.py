"""Descents by the kernel that takes groups of frames through many steps at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, TypeGuard

import torch
from torch import Tensor

from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.protocol import ForwardModel
from soma_core.inversion.skin_model import SkinModel

if TYPE_CHECKING:
    from soma_core.kernels.descent_wp import DescentRule

__all__ = ["converted", "descended", "knows_descent"]

_AT_ONCE = 2
"""Steps that a kernel takes, after its first ones, before frames that still move are brought together."""


def knows_descent(model: ForwardModel, problem: Problem) -> TypeGuard[SkinModel]:
    """Whether there is such a kernel: on a CPU, for skinning and offsets, without terms."""
    if not isinstance(model, SkinModel) or model.steps is None or problem.terms is not None:
        return False
    return model.linear and not problem.vertices.is_cuda


def descended(
    model: SkinModel, problem: Problem, start: Pose, rule: DescentRule, bound: Tensor | None,
    typical: Tensor | None, state: Tensor | None, *, renewed: Callable[[int], bool], iterations: int,
    at_once: int,
) -> tuple[Pose, Tensor]:  # fmt: skip
    """Poses, and what the frames remember of their steps.

    Frames that still move are brought together from time to time, so that those that rest cost nothing.

    Args:
        model, problem, start: see ``refine.Refinement``.
        rule: how a step is taken.
        bound, typical: lengths (F,) [m] of a robust fit; None of least squares.
        state: what an earlier descent remembers; None without.
        renewed: whether the matrix is made anew at a step.
        iterations: largest number of steps.
        at_once: steps that all frames take together.
    """
    from soma_core.kernels.descent_wp import descend

    assert model.steps is not None
    mass = problem.weights.sum(1).expand(len(problem.vertices))
    damping = torch.full_like(mass, rule.damping)
    clip = None if bound is None or typical is None else torch.stack((bound, typical))
    pose = out = replace(start, last_change=torch.full_like(mass, torch.inf))
    rows, begin, end, going = torch.arange(len(mass)), 0, min(at_once, iterations), False
    whole = mass.new_empty(len(mass), model.steps.under_way)
    doubt, known = problem.doubt, None
    if doubt is not None:
        known = model.solver.columns(doubt.variable), doubt.axis.contiguous(), doubt.square
    while True:
        # The first one always is; where few go on after one step, its own matrix judges it.
        made = tuple(step for step in range(begin, end + (end == 1)) if renewed(step))
        frames = len(rows)
        found = descend(
            model.steps, model.constants(problem.rest), model.residual.tables, rule, known,
            problem.identity.rest, problem.weights, pose.relative, pose.translation, damping,
            problem.weights.sum(1).expand(frames), model.scale(problem).expand(frames), problem.vertices,
            problem.origin, clip, state, begin=begin, end=end, going=going, renewed=made,
        )  # fmt: skip
        pose = Pose(
            relative=found.relative, translation=found.hips, last_change=found.change,
            accepted=pose.accepted + found.accepted.to(pose.accepted),
        )  # fmt: skip
        out, whole = out.put(rows, pose), whole.index_copy(0, rows, found.state)
        still = torch.nonzero(found.change > 0).flatten()
        if end == iterations or not len(still):
            return out, whole
        if len(still) < len(rows):
            still = problem.several(still)
            rows, problem, pose = rows[still], problem.part(still), pose.part(still)
            clip = None if clip is None else clip[:, still]
        damping, state = found.damping[still], found.state[still]
        begin, end, going = end, min(end + _AT_ONCE if end else 1, iterations), True


def converted(state: Tensor, factor: Tensor) -> Tensor:
    """What frames (F, k) remember, for errors that are larger by a factor (F,)."""
    from soma_core.kernels.descent_wp import remembered

    changes, inverse = remembered(state.shape[1])
    new = state.clone()
    new[:, changes] *= factor[:, None]
    new[:, inverse] /= factor[:, None]
    return new
