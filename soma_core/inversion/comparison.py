"""How far a reconstruction under the forward model lies from its target."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from soma_core.animation.engine import Body, ProceduralAnimation
from soma_core.animation.posed import Posed
from soma_core.animation.skinning import skinning_transforms
from soma_core.inversion.problem import Problem
from soma_core.kernels.model_residual import ModelResidual
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["compare", "linear_targets", "model_inputs", "part_of", "residual_model"]

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
        warp: run the Warp twin; it writes no posed vertex.
    """
    weights = problem.weights
    if warp:
        transforms, activations, scale = model_inputs(layer, problem, relative)
        identity = problem.identity
        energy, _, _, error = residual_model(layer, warp=True)(
            identity.rest, weights, transforms, activations, scale, problem.vertices, translation,
            gradient=False, distances=True,
        )  # fmt: skip
        assert error is not None
    else:
        error = problem.vertices.new_empty(problem.vertices.shape[:2])
        for chunk, posed in _posed(layer.pose_checked, problem, relative, translation):
            step = posed.sub_(problem.vertices[chunk])
            torch.linalg.vector_norm(step, dim=-1, out=error[chunk])
        energy = (error * error * weights).sum(1)
    return error, (energy / weights.sum(1).clamp_min(torch.finfo(weights.dtype).tiny)).sqrt()


def residual_model(layer: SomaLayer, *, warp: bool) -> ModelResidual:
    """The layer's forward model, to be compared with targets; made once and kept with what poses.

    Args:
        layer: with twist joints and correctives if it has any.
        warp: run the Warp twin.
    """
    posing = layer.animation if layer.plain else layer.posing
    name = f"_residual_model_{warp}"
    if name not in vars(posing):
        model = ModelResidual(
            posing.posed_skinning.weights.csr,
            None if layer.plain or layer.correctives is None else layer.correctives.second,
            dtype=posing.posed_skinning.weights.val.dtype,
            device=posing.posed_skinning.weights.val.device,
            warp=warp,
        )
        vars(posing)[name] = model  # no submodule: constants derived from its own
    return vars(posing)[name]


def model_inputs(
    layer: SomaLayer, problem: Problem, relative: Tensor
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """What :class:`ModelResidual` takes of a pose whose Hips lie at the frame's origin.

    Args:
        layer, problem, relative: as in :func:`compare`.

    Returns:
        Transforms (F, T, 3, 4) [m], activations (F, C) and the scale (F,) of the correctives' offsets; the
        last two None without correctives.
    """
    count = len(relative)
    nowhere = relative.new_zeros(count, 3)
    if layer.plain or not count:
        return _few_inputs(layer, Body(problem.identity, relative, nowhere, problem.bone_scale))
    parts = [_few_inputs(layer, body) for body in _bodies(problem, relative, nowhere)]
    transforms, activations, scale = (
        None if few[0] is None else torch.cat([one for one in few if one is not None])[:count]
        for few in zip(*parts, strict=True)
    )
    assert transforms is not None
    return transforms, activations, scale


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


def _few_inputs(layer: SomaLayer, body: Body) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """The same of a few frames."""
    posing = layer.animation if layer.plain else layer.posing
    bind = body.identity.bind_world
    vectors = posing.bone_vectors(body.identity, body.bone_scale)
    rotations, positions = posing.kinematics(body.relative, vectors, body.translation)
    transforms = skinning_transforms(rotations, positions, bind)
    if isinstance(posing, ProceduralAnimation):
        helpers = posing.twist(bind, transforms[..., :3], positions, body.bone_scale)
        transforms = torch.cat((transforms, helpers), 1)
    if layer.plain or layer.correctives is None:
        return transforms, None, None
    correctives = layer.correctives
    active = torch.relu(correctives.first(correctives.features(body.relative).flatten(1).T.contiguous()))
    active = torch.tanh(active) if correctives.use_tanh else active
    return transforms, active.T, correctives.scale(bind).expand(len(transforms))


def _bodies(problem: Problem, relative: Tensor, translation: Tensor) -> Iterator[Body]:
    """A few frames at a time.

    Always as many, the last one repeated: a frame is rounded alike whatever frames are beside it.
    """
    count = len(relative)
    for first in range(0, count, _POSED_AT_A_TIME):
        which = torch.arange(first, first + _POSED_AT_A_TIME, device=relative.device).clamp_max(count - 1)
        scale = problem.bone_scale
        scale = scale[which] if scale is not None and len(scale) > 1 else scale
        yield Body(part_of(problem.identity, which), relative[which], translation[which], scale)


def _posed(
    model: Callable[[Body], Posed], problem: Problem, relative: Tensor, translation: Tensor
) -> Iterator[tuple[slice, Tensor]]:
    """Reconstruction of a few frames at a time."""
    count = len(relative)
    for i, body in enumerate(_bodies(problem, relative, translation)):
        chunk = slice(i * _POSED_AT_A_TIME, min((i + 1) * _POSED_AT_A_TIME, count))
        yield chunk, model(body).vertices[: chunk.stop - chunk.start]


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
