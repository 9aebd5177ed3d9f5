"""Gradients through a fit: what the pose of the minimum does when the target moves."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from soma_core.geometry.rotations import skew
from soma_core.inversion.problem import part_of
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import RestMoments, SkinMoments
from soma_core.inversion.priors import JointTerms
from soma_core.inversion.problem import Pose
from soma_core.skeleton.identity import Identity

__all__ = ["attach_gradient"]

_CHUNK = 64
"""Frames whose matrices are held at a time."""

_RIDGE = {torch.float32: 1e-6, torch.float64: 1e-12}
"""Relative to the diagonal: gradients of what the target does not determine stay finite."""


def attach_gradient(
    vertices: Tensor,
    rotations: Tensor,
    translation: Tensor,
    *,
    solver: GaussNewton,
    moments: SkinMoments,
    identity: Identity,
    weights: Tensor,
    offsets: Tensor,
    valid: Tensor,
    terms: JointTerms | None,
) -> tuple[Tensor, Tensor]:
    """Rotations and translation of a fit as differentiable functions of its target.

    At a minimum ``J^T O (y - x) = 0``, hence ``d pose = (J^T O J)^-1 J^T O dx``: exact where the residual is
    zero, the Gauss-Newton approximation elsewhere. Frames that are not valid get no gradient.

    Args:
        vertices: targets (F, v, 3) [m] that the fit was made for.
        rotations: (F, J - 1, 3, 3), T-pose-relative, and translation (F, 3) [m]: the fit.
        solver, moments: as in the fit.
        identity: batch of 1 or F; no gradient reaches it.
        weights: (1 or F, v).
        offsets: bone vectors (1 or F, J, 3) [m].
        valid: (F,) bool.
        terms: soft terms of the fit.
    """
    parts = solver, moments, identity, weights, offsets, valid, terms
    return _Implicit.apply(vertices, rotations, translation, parts)


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx, _vertices, rotations, translation, parts):
        ctx.parts = parts
        ctx.save_for_backward(rotations, translation)
        return rotations.clone(), translation.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, rotations_grad, translation_grad):
        solver, moments, identity, weights, offsets, valid, terms = ctx.parts
        frames = *ctx.saved_tensors, rotations_grad, translation_grad, valid
        shared = (
            moments.rest(identity, weights, offsets) if identity.batch_size == len(weights) == 1 else None
        )
        grads = []
        for first in range(0, len(valid), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            weight, bones = (one[chunk] if len(one) > 1 else one for one in (weights, offsets))
            rest = shared or moments.rest(part_of(identity, chunk), weight, bones)
            if shared:
                rest = replace(rest, offsets=bones)
            moved = _pull_back(*(one[chunk] for one in frames), solver, moments, rest, terms)
            grads.append(moved * weight[..., None])
        return torch.cat(grads), None, None, None


def _pull_back(
    rotations: Tensor,
    translation: Tensor,
    rotations_grad: Tensor,
    translation_grad: Tensor,
    valid: Tensor,
    solver: GaussNewton,
    moments: SkinMoments,
    rest: RestMoments,
    terms: JointTerms | None,
) -> Tensor:
    """Gradient (F, v, 3) by the target of a chunk of frames, vertex weights left out."""
    eye = solver.eye.expand(len(rotations), 1, 3, 3)
    relative = torch.cat((eye, rotations), 1)
    # The matrix does not depend on where the body stands; near the origin it is most precise.
    turns, places = solver.walk(Pose.begin(relative, torch.zeros_like(translation)), rest)
    n = solver.variables
    above = turns[:, solver.parents[n]]
    zero = torch.zeros(len(rotations), len(moments.joints), 3, 4).to(rotations)
    matrix, _ = solver.normal_equations(turns, places, rest.second, zero)
    if terms is not None:
        mass = rest.own[..., 3, 3].sum(1)
        solver.add_terms(matrix, torch.zeros_like(above[..., 0]), relative, turns, terms, mass)
    product = relative[:, n] @ rotations_grad[:, n - 1].transpose(-1, -2)
    local = torch.stack(
        (
            product[..., 1, 2] - product[..., 2, 1],
            product[..., 2, 0] - product[..., 0, 2],
            product[..., 0, 1] - product[..., 1, 0],
        ),
        -1,
    )
    slope = torch.cat(((above @ local[..., None]).squeeze(-1), translation_grad[:, None]), 1)
    motion = _solve(matrix, torch.where(valid[:, None, None], slope, 0.0))
    return _velocities(solver, moments, rest, turns, places, motion)


def _solve(matrix: Tensor, slope: Tensor) -> Tensor:
    dense = matrix.flatten(3, 4).flatten(1, 2)
    diagonal = dense.diagonal(dim1=-2, dim2=-1)
    ridge = _RIDGE[dense.dtype] * diagonal.clamp_min(1e-12)
    factor, _ = torch.linalg.cholesky_ex(dense + torch.diag_embed(ridge))
    return torch.cholesky_solve(slope.flatten(1)[..., None], factor).view_as(slope)


def _velocities(
    solver: GaussNewton,
    moments: SkinMoments,
    rest: RestMoments,
    turns: Tensor,
    places: Tensor,
    motion: Tensor,
) -> Tensor:
    """Velocities (F, v, 3) of the vertices when the joints turn and the body shifts by `motion`."""
    joints, n = moments.joints, solver.variables
    own = torch.zeros_like(places).index_copy(1, n, motion[:, :-1])
    spin = solver.down_the_tree(own)
    lever = solver.down_the_tree(torch.linalg.cross(places, own, dim=-1)) + motion[:, -1:]
    shift = torch.linalg.cross(spin, places, dim=-1) + lever
    turned = skew(spin[:, joints]) @ turns[:, joints]
    of = moments.influence_joint
    points = rest.local.expand(len(motion), -1, 3)
    step = (turned[:, of] @ points[..., None]).squeeze(-1) + shift[:, joints][:, of]
    step = step * moments.influence_weight.to(step)[:, None]
    out = step.new_zeros(len(step), moments.vertex_count, 3)
    return out.index_add_(1, moments.influence_vertex, step)
