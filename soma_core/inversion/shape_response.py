"""How the skinning error of posed bodies depends on their shape when the poses follow."""

from __future__ import annotations

import torch
from torch import Tensor

from soma_core.inversion.fit import PoseInversion
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.problem import Pose, part_of
from soma_core.inversion.result import InversionResult
from soma_core.skeleton.identity import Identity

__all__ = ["shape_normal_equations"]

_DAMPING = 1e-5
"""Of the poses, relative to the diagonal: keeps what hardly turns anything from following at any cost."""

_RIDGE = 1e-6
"""Relative to the mean diagonal: keeps the factorisation defined where a joint moves nothing."""

_ROUNDING = 16
"""Multiples of the dtype's rounding, relative to what the directions move before the poses follow: keeps the
result positive definite where these undo a direction altogether."""


def shape_normal_equations(
    inversion: PoseInversion,
    vertices: Tensor,
    weights: Tensor,
    pose: InversionResult,
    identities: Identity,
    steps: Tensor,
) -> tuple[Tensor, Tensor]:
    """``J^T J`` (k, k) and ``J^T r`` (k,) of k directions of shape, the poses of all frames eliminated.

    Column i of J is the motion of all vertices from the first identity to identity i + 1, over ``steps[i]``,
    after every frame has turned its joints so as to undo it as well as it can (Schur complement); in that,
    correctives stay as they are. In float64, not divided by anything.

    Args:
        inversion: the pose fit.
        vertices: targets (F, v, 3) [m]; finite where their weight is not zero.
        weights: (1 or F, v).
        pose: of every frame, under the first identity.
        identities: the body and k others near it, (k + 1).
        steps: (k,) how far those are away.
    """
    body, count = part_of(identities, slice(0, 1)), identities.batch_size
    shared = inversion.prepare(body, weights) if len(weights) == 1 else None
    matrix = torch.zeros(count, count, dtype=torch.float64, device=vertices.device)
    before = torch.zeros_like(matrix[0])
    scale = torch.cat((steps.new_ones(1), steps)).to(vertices)[:, None, None]
    for frame in range(len(vertices)):
        weight = weights[frame] if len(weights) > 1 else weights[0]
        rest = shared or inversion.prepare(body, weight)
        turn, place = pose.rotations[frame : frame + 1], pose.translation[frame : frame + 1]
        posed = inversion.layer.pose(identities, turn, place.expand(count, 3)).vertices
        residual = torch.where(weight[:, None] > 0, posed[0] - vertices[frame], 0.0)
        fields = torch.cat((residual[None], posed[1:] - posed[:1])) / scale
        flat = (fields * weight.sqrt()[:, None]).flatten(1)
        product = (flat @ flat.T).double()
        matrix += product
        before += product.diagonal()
        followed = _followed(inversion, rest, turn, place, fields)
        matrix -= followed.T @ followed
    matrix += torch.diag(_ROUNDING * torch.finfo(vertices.dtype).eps * before)
    return matrix[1:, 1:], matrix[1:, 0]


def _followed(
    inversion: PoseInversion, rest: RestMoments, turn: Tensor, place: Tensor, fields: Tensor
) -> Tensor:
    """``L^-1 J^T D`` (n, k) of displacement fields D (k, v, 3) of a frame, ``L L^T = J^T J`` of its pose."""
    solver, moments = inversion.model.solver, inversion.model.moments
    eye = solver.eye.expand(1, 1, 3, 3)
    turns, places = solver.walk(Pose.begin(torch.cat((eye, turn), 1), place), rest)
    matrix, _ = solver.normal_equations(turns, places, rest)
    dense = matrix.flatten(3, 4).flatten(1, 2)[0].double()
    diagonal = dense.diagonal()
    dense = dense + torch.diag(_DAMPING * diagonal + _RIDGE * diagonal.mean())
    count = len(fields)
    turns, places = turns.expand(count, -1, 3, 3), places.expand(count, -1, 3)
    slopes = solver.slopes(turns, places, rest, moments.of_vectors(fields, rest))
    factor = torch.linalg.cholesky(dense)
    return torch.linalg.solve_triangular(factor, slopes.flatten(1).double().T, upper=False)
