"""What pose blend shapes add to the Gauss-Newton matrix of skinning, from moments."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from soma_core.geometry.rotations import skew
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import RestMoments, SkinMoments

__all__ = ["BlendMoments", "blend_shapes"]

_BATCH = 64
"""Blend shapes evaluated at a time."""


class BlendMoments:
    """Second moments of the blend shapes with each other and with the rest points of every joint.

    A joint's turn moves vertices by skinning and by blend shapes: ``J = J_s + J_b``. The products
    ``J_b^T J_b`` and ``J_s^T J_b`` are read from moments as if each influence moved a vertex of its own:
    exact where vertices are rigid, and close elsewhere. Only the path to the minimum depends on it, since
    energy and slope are those of the model.

    Args:
        shapes: (9 J, n, 3) from :func:`blend_shapes`.
        moments: of its rig.
        rest: of the body under `weights`.
        weights: (n,) of the vertices.
    """

    def __init__(self, shapes: Tensor, moments: SkinMoments, rest: RestMoments, weights: Tensor) -> None:
        flat = (shapes * weights.sqrt()[:, None]).flatten(1)
        self._own = (flat @ flat.T).unflatten(0, (-1, 9)).unflatten(2, (-1, 9))  # (J, 9, J, 9)
        point = torch.cat((rest.local[0], torch.ones_like(rest.local[0, :, :1])), 1) * rest.weight[0, :, None]
        starts, cross = moments.joint_start.tolist(), []
        for first, last in pairwise(starts):
            moved = shapes[:, moments.influence_vertex[first:last]].transpose(0, 1).flatten(1)
            cross.append((point[first:last].T @ moved).view(4, -1, 9, 3))
        self._cross = torch.stack(cross)  # (T, 4, J, 9, 3)

    def matrix(self, relative: Tensor, turns: Tensor, places: Tensor, solver: GaussNewton) -> Tensor:
        """What to add to the matrix (F, n + 1, 3, n + 1, 3) of :meth:`GaussNewton.normal_equations`.

        Args:
            relative: rotations of the pose, the virtual root's included, (F, J + 1, 3, 3).
            turns, places: world turns and places of the joints, (F, J + 1, 3, 3) and (F, J + 1, 3).
            solver: whose variables the matrix has.
        """
        n, count = solver.variables, len(solver.variables)
        axes = turns[:, solver.parents[n]]  # row a: the world's axis a in the axes of the parent
        change = (skew(axes) @ relative[:, n, None]).flatten(3)  # (F, n, 3, 9)
        by_joint = change.permute(1, 0, 2, 3).flatten(1, 2)  # (n, 3 F, 9)
        own = by_joint @ self._own[n - 1][:, :, n - 1].flatten(2)
        own = own.unflatten(1, (-1, 3)).unflatten(3, (count, 9)).permute(1, 3, 0, 2, 4)
        own = (own.flatten(2, 3) @ change.transpose(-1, -2)).unflatten(2, (count, 3))
        moved = by_joint @ self._cross[:, :, n - 1].permute(2, 3, 0, 1, 4).flatten(2)
        moved = moved.view(count, -1, 3, *self._cross.shape[:2], 3).permute(1, 0, 2, 3, 5, 4)
        forces = turns[:, None, None, solver.joints] @ moved  # (F, n, 3, T, 3, 4)
        each = [one[:, None].expand(-1, 3 * count, *one.shape[1:]).flatten(0, 1) for one in (turns, places)]
        cross = solver.slopes(*each, forces.flatten(0, 2)).view(-1, count, 3, count + 1, 3)
        matrix = torch.nn.functional.pad(own.permute(0, 2, 3, 1, 4), (0, 0, 0, 1, 0, 0, 0, 1))
        matrix[:, :count] += cross
        matrix[:, :, :, :count] += cross.permute(0, 3, 4, 1, 2)
        return matrix


def blend_shapes(offsets: Callable[[Tensor], Tensor], still: Tensor) -> Tensor:
    """What each entry of each local rotation adds to the rest mesh, (9 J, n, 3).

    Args:
        offsets: maps local rotations (batch, J, 3, 3) to (batch, n, 3).
        still: identity rotations (1, J, 3, 3).
    """
    count = still.shape[1]
    entries = torch.eye(9 * count).to(still).view(-1, count, 3, 3)
    at_rest = offsets(still)
    return torch.cat([offsets(still + part) - at_rest for part in entries.split(_BATCH)])
