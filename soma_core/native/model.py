"""A native model as a rig: what the engine and the solver of this package need to pose and to fit it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.animation.engine import Animation
from soma_core.plugin.spec import SkinnedModel
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["NativeBody", "native_rig"]


def native_rig(model: SkinnedModel, scale: float) -> Rig:
    """The first body of a model as a rig in its rest pose; `scale` is the native unit [m].

    Joint 0 is a virtual root above the model's own. Axes stay native, and every joint's are those of the
    world, so that relative rotations are the model's local ones.
    """
    joints = scale * model.joints[0].double().cpu().numpy()
    bind = np.tile(np.eye(4), (len(joints) + 1, 1, 1))
    bind[1:, :3, 3] = joints
    weights = model.weights.double().cpu().numpy()
    return Rig(
        joint_names=("", *model.joint_names),
        parents=np.array([-1, *(parent + 1 for parent in model.parents)], np.int32),
        bind_world=bind,
        t_pose_world=bind,
        bind_shape=scale * model.rest[0].double().cpu().numpy(),
        weights=scipy.sparse.csr_array(np.pad(weights, ((0, 0), (1, 0)))),
        revision="",
    )


class NativeBody:
    """One body of a native model, in metres: posed by the whole model, blend shapes included.

    Args:
        model: batch of 1.
        params: that it was made from.
        animation: of its rig.
        scale: native unit [m].

    Attributes:
        identity: rest mesh and joints, without blend shapes.
        pelvis: rest place (3,) [m] of the model's root joint.
        offsets: maps relative rotations (F, J - 1, 3, 3) to what they add to the rest mesh (F, n, 3) [m];
            None where a pose adds nothing.
    """

    def __init__(
        self, model: SkinnedModel, params: Mapping[str, Tensor], animation: Animation, scale: float
    ) -> None:
        self.params, self._animation = params, animation
        self.identity = _identity(model.rest, model.joints, scale)
        self.pelvis = scale * model.joints[0, 0]
        self.offsets: Callable[[Tensor], Tensor] | None = None
        if model.pose_offsets is not None:
            native = model.pose_offsets
            self.offsets = lambda rotations: scale * native(rotations)

    def posed(self, rotations: Tensor, pelvis: Tensor) -> Tensor:
        """Vertices (F, n, 3) [m] of relative rotations (F, J - 1, 3, 3) and root places (F, 3) [m]."""
        identity = self.identity
        if self.offsets is not None:
            identity = _with_rest(identity, identity.rest + self.offsets(rotations))
        return self._animation.pose(identity, rotations, pelvis, absolute=False).vertices


def _identity(rest: Tensor, joints: Tensor, scale: float) -> Identity:
    """Bodies (batch, n, 3), (batch, J, 3) in native units as identities [m] of a native rig."""
    points, places = scale * rest, scale * joints
    bind = torch.eye(4, dtype=rest.dtype, device=rest.device).repeat(len(rest), joints.shape[1] + 1, 1, 1)
    bind[:, 1:, :3, 3] = places
    return Identity(rest=points, bind_world=bind, fitted_rest=points, fitted_world=bind)


def _with_rest(identity: Identity, rest: Tensor) -> Identity:
    return Identity(
        rest=rest, bind_world=identity.bind_world, fitted_rest=rest, fitted_world=identity.bind_world
    )
