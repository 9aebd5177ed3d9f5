"""A native model as a rig: what poses it and what fits poses to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.animation.engine import Animation
from soma_core.geometry.constants import Kind
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.offsets import PoseOffsets
from soma_core.inversion.problem import Pose, Problem, View
from soma_core.inversion.protocol import Curvature
from soma_core.inversion.skin_model import SkinModel
from soma_core.inversion.structure import MomentStructure, skin_structure
from soma_core.layer import Kernels
from soma_core.native.blend import BlendedCurvature, blend_shapes, blended_view, is_linear
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


class NativeRig(SkinModel):
    """The joints of a native model, in metres and native axes: poses bodies, and steps on their error.

    Blend shapes that are linear in the entries of local rotations, which is measured once, are offsets of the
    skin model. Others are evaluated by the model itself, and differentiated by autograd.

    Args:
        model: any body of it.
        scale: native unit [m].
        covered: (n,) bool, vertices that a fit may look at.
        kernels: ``torch`` (the reference), ``warp`` or ``auto``.

    Attributes:
        joint_names: of the model's joints.
        blended: whether poses add to the rest mesh before it is skinned.
        linear: whether that is linear in the entries of the rotations.
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
        rig = native_rig(model, scale)
        structure = skin_structure(rig, covered)
        kind: Kind = {"dtype": dtype, "device": device}
        blend, offsets, linear = model.pose_offsets, None, True
        if blend is not None:
            shapes = scale * blend_shapes(blend, len(model.joints[0]), **kind)
            linear = is_linear(blend, shapes / scale)
            offsets = _offsets(shapes, rig, structure, **kind)
        super().__init__(
            rig, structure, Animation(rig, kernels=kernels, dtype=dtype, device=device), offsets=offsets,
            warp=kernels == "warp" or (kernels == "auto" and device.type == "cpu"), **kind,
        )  # fmt: skip
        self.joint_names, self.linear, self._scale, self._blend = rig.user_joint_names, linear, scale, blend
        self.blended = blend is not None

    def bodies(self, rest: Tensor, joints: Tensor) -> Identity:
        """Rest meshes (batch, n, 3) and joints (batch, J, 3) in native units as identities [m]."""
        points, places = self._scale * rest, self._scale * joints
        bind = torch.eye(4, dtype=rest.dtype, device=rest.device).repeat(len(rest), joints.shape[1] + 1, 1, 1)
        bind[:, 1:, :3, 3] = places
        return Identity(rest=points, bind_world=bind, fitted_rest=points, fitted_world=bind)

    def posed(self, identity: Identity, rotations: Tensor, pelvis: Tensor) -> Tensor:
        """Vertices (F, n, 3) [m] under the whole model. Differentiable.

        Args:
            identity: of one body.
            rotations: local rotations (F, J, 3, 3).
            pelvis: places (F, 3) [m] of the root joint.
        """
        moves = None if self._blend is None else self._scale * self._blend(rotations)
        posed = self.animation.pose(identity, rotations, pelvis, absolute=False, offsets=moves)
        return posed.vertices

    def problem(
        self, target: Tensor, identity: Identity, weights: Tensor, rest: RestMoments | None = None
    ) -> Problem:
        """The problem of finite targets (F, n, 3) [m] of one body under vertex weights (n,)."""
        rest = self.rest(identity, weights[None]) if rest is None else rest
        moments, origin = self.moments.target(target, rest)
        return Problem(
            vertices=target,
            weights=weights[None],
            identity=identity,
            rest=rest,
            target=moments,
            origin=origin,
        )

    def view(self, problem: Problem, pose: Pose, bound: Tensor | None = None) -> View:
        """Error of poses, and its exact derivative; see :class:`ForwardModel`."""
        view = super().view(problem, pose, bound)
        if self.linear:
            return view
        assert bound is None
        return blended_view(self, problem, pose, view)

    def curvature(self, problem: Problem, pose: Pose) -> Curvature:
        """The exact curvature of the error at poses."""
        return super().curvature(problem, pose) if self.linear else BlendedCurvature(self, problem, pose)


def _offsets(
    shapes: Tensor, rig: Rig, structure: MomentStructure, *, dtype: torch.dtype, device: torch.device | str
) -> PoseOffsets:
    """Blend shapes (9 J, n, 3) [m] as offsets of the rig, whose joint 0 is a virtual root."""
    count = len(rig.joint_names)
    eyes = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    rows = shapes.double().cpu().permute(1, 2, 0).flatten(0, 1).numpy()  # (3 n, 9 J)
    return PoseOffsets(
        left=eyes, right=eyes, still=eyes, first=None, squash=False,
        shapes=scipy.sparse.csr_array(np.pad(rows, ((0, 0), (9, 0)))), owner=np.arange(count).repeat(9),
        rig=rig, joints=structure.joints, fitted=structure.fitted, dtype=dtype, device=device,
    )  # fmt: skip
