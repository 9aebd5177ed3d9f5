"""How far a reconstruction under the forward model lies from its target."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from soma_core.animation.engine import Animation, Body
from soma_core.animation.posed import Posed
from soma_core.animation.skinning import skinning_transforms
from soma_core.inversion.problem import Problem
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["compare", "linear_targets", "part_of"]

_POSED_AT_A_TIME = 32
"""Frames posed and compared at a time by the reference, so that they stay in cache."""

_SAMPLED = 8
"""Every so many vertices have a say in a frame's median residual."""


def compare(
    layer: SomaLayer, problem: Problem, relative: Tensor, translation: Tensor, *, warp: bool
) -> tuple[Tensor, Tensor]:
    """Vertex errors (F, v) [m] and their weighted root mean square (F,) [m].

    Args:
        layer: the forward model.
        problem: targets, weights and identity.
        relative: user joints' rotations (F, J - 1, 3, 3).
        translation: Hips positions (F, 3) [m], in the world.
        warp: run the Warp twin for plain skinning of one identity under one set of weights.
    """
    identity, weights = problem.identity, problem.weights
    if warp and layer.plain and identity.batch_size == 1 and len(weights) == 1:
        error, total = _by_warp(layer.animation, problem, relative, translation)
    else:
        error = problem.vertices.new_empty(problem.vertices.shape[:2])
        for chunk, posed in _posed(layer.pose_checked, problem, relative, translation):
            step = posed.sub_(problem.vertices[chunk])
            torch.linalg.vector_norm(step, dim=-1, out=error[chunk])
        total = (error * error * weights).sum(1)
    return error, (total / weights.sum(1).clamp_min(torch.finfo(weights.dtype).tiny)).sqrt()


def linear_targets(
    layer: SomaLayer,
    problem: Problem,
    relative: Tensor,
    translation: Tensor,
    *,
    plain: bool,
    robust: float | None,
) -> tuple[Tensor, Tensor]:
    """Targets (F, v, 3) [m] for plain skinning, and the energy (F,) [m^2] that the forward model has now.

    What twist and correctives add at this pose is taken from the target. With `robust`, vertices too far
    from their target ask for no more than that length [m]. Too far is farther than `robust` and than twice
    the frame's median: a fit that outliers have dragged off finds its way back in few rounds.

    Args:
        layer, problem, relative, translation: as in :func:`compare`.
        plain: the forward model is plain skinning.
    """
    targets, energy = torch.empty_like(problem.vertices), problem.vertices.new_empty(len(relative))
    skinned = _posed(layer.animation.pose_body, problem, relative, translation)
    whole = None if plain else _posed(layer.pose_checked, problem, relative, translation)
    for chunk, base in skinned:
        posed = base if whole is None else next(whole)[1]
        step = problem.vertices[chunk] - posed
        weights = problem.weights[chunk] if len(problem.weights) > 1 else problem.weights
        energy[chunk] = ((step * step).sum(-1) * weights).sum(-1)
        if robust is not None:
            step *= _share(step, weights, robust)[..., None]
        torch.add(base, step, out=targets[chunk])
    return targets, energy


def _share(step: Tensor, weights: Tensor, robust: float) -> Tensor:
    """(F, v) the share of residuals (F, v, 3) that counts, 1 or less."""
    length = torch.linalg.vector_norm(step, dim=-1)
    counted = weights[:, ::_SAMPLED] > 0
    typical = length[:, ::_SAMPLED].masked_fill(~counted, torch.nan).nanmedian(1, keepdim=True).values
    bound = (2 * typical.nan_to_num(0.0)).clamp_min(robust)
    return bound / torch.maximum(length, bound)


def _posed(
    model: Callable[[Body], Posed], problem: Problem, relative: Tensor, translation: Tensor
) -> Iterator[tuple[slice, Tensor]]:
    """Reconstruction of a few frames at a time.

    Always of as many, the last one repeated: a frame is rounded alike whatever frames are beside it.
    """
    count = len(relative)
    for first in range(0, count, _POSED_AT_A_TIME):
        chunk = slice(first, min(first + _POSED_AT_A_TIME, count))
        which = torch.arange(first, first + _POSED_AT_A_TIME, device=relative.device).clamp_max(count - 1)
        scale = problem.bone_scale
        scale = scale[which] if scale is not None and len(scale) > 1 else scale
        body = Body(part_of(problem.identity, which), relative[which], translation[which], scale)
        yield chunk, model(body).vertices[: chunk.stop - first]


def _by_warp(
    animation: Animation, problem: Problem, relative: Tensor, translation: Tensor
) -> tuple[Tensor, Tensor]:
    from soma_core.kernels.skin_error_wp import skin_error

    identity, weights = problem.identity, animation.skinning.weights
    rotations, positions = animation.kinematics(relative, problem.rest.offsets, translation)
    transforms = skinning_transforms(rotations, positions, identity.bind_world)
    rest = torch.cat((identity.rest[0], torch.ones_like(identity.rest[0, :, :1])), 1)
    point = weights.val[:, None] * rest[animation.skinning.influence_vertex]
    return skin_error(weights.crow, weights.col, point, problem.weights[0], transforms, problem.vertices)


def part_of(identity: Identity, chunk: slice | Tensor) -> Identity:
    """The identities of a chunk of frames; one identity serves every chunk."""
    if identity.batch_size == 1:
        return identity
    return replace(
        identity,
        rest=identity.rest[chunk],
        bind_world=identity.bind_world[chunk],
        fitted_rest=identity.fitted_rest[chunk],
        fitted_world=identity.fitted_world[chunk],
        params={name: value[chunk] for name, value in identity.params.items()},
    )
