"""A pose under a whole native model: its error, and how the error changes with the pose."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from soma_core.inversion.moments import RestMoments
from soma_core.inversion.problem import Pose
from soma_core.native.model import NativeBody, NativeRig

__all__ = ["View", "turned_slope", "view_pose"]


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A pose under the whole model.

    Attributes:
        energy: (F,) [m^2], float64.
        slope: half its derivative by turns in world axes, and by the translation, (F, n + 1, 3).
        spread: sums of arm times residual of each joint's subtree about it, (F, J, 3, 3).
        turns, places: of the joints, (F, J, 3, 3) and (F, J, 3).
    """

    energy: Tensor
    slope: Tensor
    spread: Tensor
    turns: Tensor
    places: Tensor


def view_pose(
    rig: NativeRig, body: NativeBody, rest: RestMoments, pose: Pose, target: Tensor, weights: Tensor
) -> View:
    """Error of poses against targets (F, n, 3) [m] under vertex weights (n,); one derivative of the model."""
    rotations = pose.relative[:, 1:].detach().requires_grad_()
    pelvis = pose.translation.detach().requires_grad_()
    with torch.enable_grad():
        step = rig.posed(body, rotations, pelvis) - target
        energy = (weights * step.square().sum(-1)).double().sum(1)
        by_rotations, by_pelvis = torch.autograd.grad(energy.sum(), (rotations, pelvis))
    turns, places = rig.solver.walk(pose, rest.offsets)
    slope = 0.5 * turned_slope(rig, rotations.detach(), turns, by_rotations, by_pelvis)
    spread, _ = rig.solver.subtree_forces(turns, places, rig.moments.of_vectors(step.detach(), rest))
    return View(energy=energy.detach(), slope=slope, spread=spread, turns=turns, places=places)


def turned_slope(
    rig: NativeRig, rotations: Tensor, turns: Tensor, by_rotations: Tensor, by_pelvis: Tensor
) -> Tensor:
    """Derivative (F, n + 1, 3) by turns in world axes, and by the translation, from that by matrix entries.

    Args:
        rig: whose variables count.
        rotations: local rotations (F, J, 3, 3).
        turns: world turns, the virtual root's included, (F, J + 1, 3, 3).
        by_rotations, by_pelvis: derivatives (F, J, 3, 3) and (F, 3).
    """
    n = rig.solver.variables
    product = (rotations @ by_rotations.transpose(-1, -2))[:, n - 1]
    torque = torch.stack(
        (
            product[..., 1, 2] - product[..., 2, 1],
            product[..., 2, 0] - product[..., 0, 2],
            product[..., 0, 1] - product[..., 1, 0],
        ),
        -1,
    )
    torque = (turns[:, rig.solver.parents[n]] @ torque[..., None]).squeeze(-1)
    return torch.cat((torque, by_pelvis[:, None]), 1)
