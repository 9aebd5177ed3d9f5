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
        moments: of the rig.
        rest: of the body under `weights`.
        weights: (n,) of the vertices.
        above: (n_variables, T), 1 where a variable joint is a weighted one or lies above it.
    """

    def __init__(
        self, shapes: Tensor, moments: SkinMoments, rest: RestMoments, weights: Tensor, above: Tensor
    ) -> None:
        flat = (shapes * weights.sqrt()[:, None]).flatten(1)
        self._own = (flat @ flat.T).unflatten(0, (-1, 9)).unflatten(2, (-1, 9))  # (J, 9, J, 9)
        self._above, pulls = above, []
        for first, last in pairwise(moments.joint_start.tolist()):
            moved = shapes[:, moments.influence_vertex[first:last]] * rest.weight[0, first:last, None]
            torque = torch.einsum("mec,edc->md", moved, skew(rest.local[0, first:last]))
            pulls.append(torch.stack((torque, moved.sum(1)), -1))
        # Torque about each joint and force on it, in the joint's own axes: (J, 9, T, 3, 2).
        self._pull = torch.stack(pulls, 1).unflatten(0, (-1, 9))

    def matrix(self, relative: Tensor, turns: Tensor, places: Tensor, solver: GaussNewton) -> Tensor:
        """What to add to the matrix (F, n + 1, 3, n + 1, 3) of :meth:`GaussNewton.normal_equations`.

        Args:
            relative: rotations of the pose, the virtual root's included, (F, J + 1, 3, 3).
            turns, places: world turns and places of the joints, (F, J + 1, 3, 3) and (F, J + 1, 3).
            solver: whose variables the matrix has.
        """
        n, count, frames = solver.variables, len(solver.variables), len(turns)
        axes = turns[:, solver.parents[n]]  # row a: the world's axis a in the axes of the parent
        change = (skew(axes) @ relative[:, n, None]).flatten(3)  # (F, n, 3, 9)
        by_joint = change.permute(1, 0, 2, 3).flatten(1, 2)  # (n, 3 F, 9)
        own = by_joint @ self._own[n - 1][:, :, n - 1].flatten(2)
        own = own.unflatten(1, (-1, 3)).unflatten(3, (count, 9)).permute(1, 3, 0, 2, 4)
        own = (own.flatten(2, 3) @ change.transpose(-1, -2)).unflatten(2, (count, 3))
        pull = (by_joint @ self._pull[n - 1].flatten(2)).view(count, frames, 3, -1, 3, 2)
        pull = turns[:, solver.joints] @ pull.permute(1, 3, 4, 0, 2, 5).flatten(3)  # (F, T, 3, n 3 2)
        torque, force = pull.unflatten(3, (-1, 2)).unbind(-1)  # of each weighted joint, (F, T, 3, 3 n)
        torque = torque + skew(places[:, solver.joints]) @ force
        torque, force = ((self._above @ one.flatten(2)).view(frames, count, 3, -1) for one in (torque, force))
        torque = torque - skew(places[:, n]) @ force  # of each subtree about its joint
        total = pull.unflatten(3, (-1, 2))[..., 1].sum(1, keepdim=True)
        cross = torch.cat((torque, total), 1).unflatten(3, (count, 3))  # (F, n + 1, 3, n, 3)
        matrix = torch.nn.functional.pad(own.permute(0, 2, 3, 1, 4), (0, 0, 0, 1, 0, 0, 0, 1))
        matrix[:, :, :, :count] += cross
        matrix[:, :count] += cross.permute(0, 3, 4, 1, 2)
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
