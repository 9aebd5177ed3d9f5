"""Turns that twist skinning does not tell, and what bends in the activations along them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from soma_core.correctives.features import PoseFeatures
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.rig.skeleton import Rig

__all__ = ["limb_bones", "slope_changes", "twisted"]

_STEP = np.radians(2.0)
"""Turn to either side: finer folds keep no fit, coarser ones are seen by their edges."""

_TURNED, _NEAR, _TWIST = 0.3, 0.05, 0.4
"""Poses are those of the lessons turned by so much, joint by joint, and such as have one hinge bent and all
else within the second of rest (standard deviations); limbs are twisted by the third at most [rad]."""


def limb_bones(rig: Rig) -> list[tuple[int, int, np.ndarray]]:
    """Upper arms and thighs: joint, the next one (both among the user joints), and the bone's axis (3,).

    They are the segments whose twist joints undo the bone's own twist. Turning the bone about its axis, with
    the next joint turned back, leaves the skin of a straight limb where it is (see :func:`twisted`).
    """
    if rig.procedural is None:
        return []
    names, found = list(rig.user_joint_names), []
    for segment in rig.procedural.definition.segments:
        if segment.reverse and rig.parents[rig.joint_names.index(segment.end)] == rig.joint_names.index(
            segment.start
        ):
            own, end = names.index(segment.start), names.index(segment.end)
            bone = rig.t_pose_world[end + 1, :3, 3] - rig.t_pose_world[own + 1, :3, 3]
            found.append((own, end, bone / np.linalg.norm(bone)))
    return found


def twisted(rotations: Tensor, bone: tuple[int, int, np.ndarray], angle: Tensor) -> Tensor:
    """T-pose-relative rotations (B, J, 3, 3) with a bone turned by `angle` (B,); what is below stays."""
    own, end, axis = bone
    turn = axis_angle_to_matrix(angle[:, None] * torch.as_tensor(axis).to(angle))
    turned = rotations.clone()
    turned[:, own] = rotations[:, own] @ turn
    turned[:, end] = turn.mT @ rotations[:, end]
    return turned


@torch.no_grad()
def slope_changes(
    network: CorrectivesNetwork, rig: Rig, motions: Iterable[np.ndarray], random: np.random.Generator
) -> Tensor:
    """Gram matrix (k, k) of the change of the activations' slopes within 2 degrees of limb twist [1/rad^2].

    Summed over the poses of `motions` (n, J, 3, 3) T-pose-relative each, mean over limbs, times the cosine of
    the limb's bend: only the correctives tell how a straight limb's twist is shared by its joints, so that a
    fold along it is a false minimum of a pose fit; of a bent one the skin tells it.
    """
    size = len(network.joints) * network.channels
    total = torch.zeros(size, size, dtype=torch.float64)
    features, bones = PoseFeatures(rig, dtype=torch.float32, device="cpu"), limb_bones(rig)
    if not bones:
        return total

    def active(rotations: Tensor) -> Tensor:
        return network.activations(features(rotations.float())).transpose(0, 1).flatten(1).double()

    for motion in motions:
        given = torch.as_tensor(np.asarray(motion, np.float64))
        drawn = torch.as_tensor(random.standard_normal((2, *given.shape[:2], 3)))
        far = given @ axis_angle_to_matrix(_TURNED * drawn[0])
        near = axis_angle_to_matrix(_NEAR * drawn[1])
        for bone in bones:
            hinge = near.clone()
            hinge[:, bone[1]] = given[:, bone[1]] @ near[:, bone[1]]
            poses = torch.cat([far, hinge])
            angle = torch.as_tensor(random.uniform(-_TWIST, _TWIST, len(poses)))
            angle[len(far) :] = 0
            before, here, after = (active(twisted(poses, bone, angle + s)) for s in (-_STEP, 0, _STEP))
            axis = torch.as_tensor(bone[2])
            straight = (poses[:, bone[1]] @ axis @ axis).clamp_min(0)
            change = straight[:, None] * (after - 2 * here + before) / _STEP
            total += change.T @ change / (2 * len(bones))
    return total
