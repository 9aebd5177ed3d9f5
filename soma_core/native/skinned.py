"""Posing a native model by the skinning that it tells."""

from __future__ import annotations

import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.plugin.spec import SkinnedModel

__all__ = ["pose_skinned"]


def pose_skinned(model: SkinnedModel, rotations: Tensor, translation: Tensor) -> Tensor:
    """Pose bodies as :class:`SkinnedModel` says: what ``posed()`` of such a model returns. Differentiable.

    Args:
        model: one body, or one for each frame.
        rotations: local rotations (frames, J, 3), axis-angle [rad].
        translation: what is added to all vertices (frames, 3), native unit and axes.

    Returns:
        Posed vertices (frames, n, 3), native unit and axes.
    """
    local = axis_angle_to_matrix(rotations)
    rest = model.rest if model.pose_offsets is None else model.rest + model.pose_offsets(local)
    world, place = [local[:, 0]], [model.joints[:, 0].expand(len(local), 3)]
    for joint, parent in enumerate(model.parents[1:], 1):
        bone = model.joints[:, joint] - model.joints[:, parent]
        place.append(place[parent] + (world[parent] @ bone[..., None])[..., 0])
        world.append(world[parent] @ local[:, joint])
    turns = torch.stack(world, 1)
    shifts = torch.stack(place, 1) - (turns @ model.joints[..., None])[..., 0]
    blended = torch.einsum("nj,fjab->fnab", model.weights, turns)
    return (blended @ rest[..., None])[..., 0] + model.weights @ shifts + translation[:, None]
