"""A native model as a rig: what poses it and what fits poses to it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.animation.engine import Animation
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import SkinMoments
from soma_core.inversion.start import ProcrustesStart
from soma_core.inversion.structure import skin_structure
from soma_core.layer import Kernels
from soma_core.native.blend import blend_shapes
from soma_core.plugin.spec import SkinnedModel
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["NativeBody", "NativeRig", "native_rig"]


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


@dataclass(frozen=True, kw_only=True, eq=False)
class NativeBody:
    """One body of a native model.

    Attributes:
        params: that it was made from, batch of 1.
        identity: rest mesh and joints [m], without blend shapes.
        pelvis: rest place (3,) [m] of the model's root joint.
    """

    params: Mapping[str, Tensor]
    identity: Identity
    pelvis: Tensor


class NativeRig(torch.nn.Module):
    """The joints of a native model, in metres and native axes: poses bodies, and steps on their error.

    Args:
        model: any body of it.
        scale: native unit [m].
        covered: (n,) bool, vertices that a fit may look at.
        kernels: ``torch`` (the reference), ``warp`` or ``auto``.

    Attributes:
        joint_names: of the model's joints.
        blended: whether poses add to the rest mesh before it is skinned.
        above: (n, T), 1 where a variable joint is a weighted one or lies above it.
        animation, moments, solver, start: of the rig.
    """

    def __init__(
        self,
        model: SkinnedModel,
        scale: float,
        covered: np.ndarray,
        *,
        dtype: torch.dtype,
        device: torch.device,
        kernels: Kernels,
    ) -> None:
        super().__init__()
        rig = native_rig(model, scale)
        structure = skin_structure(rig, covered)
        warp = kernels == "warp" or (kernels == "auto" and device.type == "cpu")
        kind = {"dtype": dtype, "device": device}
        self.joint_names, self._scale, self._offsets = rig.user_joint_names, scale, model.pose_offsets
        self.blended = model.pose_offsets is not None
        self.animation = Animation(rig, kernels=kernels, **kind)
        self.moments = SkinMoments(structure, rig, warp=warp, **kind)
        self.solver = GaussNewton(structure, warp=warp, **kind)
        above = structure.ancestors[structure.variables][:, structure.joints]
        self.register_buffer("above", torch.as_tensor(above, device=device).to(dtype), persistent=False)
        self.start = ProcrustesStart(structure, **kind)

    def bodies(self, rest: Tensor, joints: Tensor) -> Identity:
        """Rest meshes (batch, n, 3) and joints (batch, J, 3) in native units as identities [m]."""
        points, places = self._scale * rest, self._scale * joints
        bind = torch.eye(4, dtype=rest.dtype, device=rest.device).repeat(len(rest), joints.shape[1] + 1, 1, 1)
        bind[:, 1:, :3, 3] = places
        return Identity(rest=points, bind_world=bind, fitted_rest=points, fitted_world=bind)

    def posed(self, body: NativeBody, rotations: Tensor, pelvis: Tensor) -> Tensor:
        """Vertices (F, n, 3) [m] under the whole model. Differentiable.

        Args:
            body: which.
            rotations: local rotations (F, J, 3, 3).
            pelvis: places (F, 3) [m] of the root joint.
        """
        bind = body.identity.bind_world
        rest = body.identity.rest
        if self._offsets is not None:
            rest = rest + self._scale * self._offsets(rotations)
        shaped = Identity(rest=rest, bind_world=bind, fitted_rest=rest, fitted_world=bind)
        return self.animation.pose(shaped, rotations, pelvis, absolute=False).vertices

    @functools.cached_property
    def blend_shapes(self) -> Tensor:
        """Blend shapes (9 J, n, 3) [m]; made when first asked for."""
        assert self._offsets is not None
        return self._scale * blend_shapes(
            self._offsets, self.solver.eye.expand(1, len(self.joint_names), 3, 3)
        )
