"""The canonical body in the bind pose, skinned: where correctives are taught."""

from __future__ import annotations

import torch
from torch import Tensor

from soma_core.animation.engine import Animation, ProceduralAnimation
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["BindBody", "pulled_back"]

_DAMPING = 0.05
"""Of the inverse of a blended matrix: a fold that skinning flattens asks for no offset across it."""


class BindBody:
    """Skinning of one body in the rig's bind pose, with twist joints where the rig has any; float64.

    Args:
        rig: joints, weights and bind pose.
        identity: a body, of batch 1; default: the rig's own bind shape.
    """

    def __init__(self, rig: Rig, identity: Identity | None = None) -> None:
        engine = Animation if rig.procedural is None else ProceduralAnimation
        self.animation = engine(rig, dtype=torch.float64, device=torch.device("cpu"), kernels="auto")
        self.weights = rig.weights if rig.procedural is None else rig.procedural.weights
        if identity is None:
            points, bind = (torch.as_tensor(array.copy()) for array in (rig.bind_shape, rig.bind_world))
        else:
            points, bind = (part[0].detach().cpu().double() for part in (identity.rest, identity.bind_world))
        self.identity = Identity(
            rest=points[None], bind_world=bind[None], fitted_rest=points[None], fitted_world=bind[None],
            rig_revision=rig.revision,
        )  # fmt: skip

    @property
    def bind_pose(self) -> Tensor:
        """T-pose-relative rotations (1, J - 1, 3, 3) of the bind pose."""
        relative: Tensor = self.animation.kinematics.get_buffer("bind_relative")
        return relative[None]

    def transforms(self, relative: Tensor) -> Tensor:
        """Skinning transforms (B, T, 3, 4) of T-pose-relative rotations (B, J - 1, 3, 3); Hips in place."""
        hips = self.identity.bind_world[:, 1, :3, 3].expand(len(relative), 3)
        rotations, positions = self.animation._walk(self.identity, relative, hips, None, absolute=False)
        return self.animation._skinning_transforms(self.identity, rotations, positions, None)

    def skin(self, transforms: Tensor, offsets: Tensor | None = None) -> Tensor:
        """Posed vertices (B, v, 3) [m]; `offsets` (B, v, 3) are added to the rest shape."""
        rest = self.identity.rest if offsets is None else self.identity.rest + offsets
        return self.animation._skin(rest, transforms)

    def blended(self, transforms: Tensor) -> Tensor:
        """The linear part (B, v, 3, 3) of each vertex's blended transform."""
        batch = len(transforms)
        dense = transforms[..., :3].permute(1, 0, 2, 3).reshape(transforms.shape[1], -1).contiguous()
        with torch.no_grad():
            rows = self.animation.posed_skinning.weights(dense)
        return rows.view(-1, batch, 3, 3).transpose(0, 1)


def pulled_back(moved: Tensor, blended: Tensor) -> Tensor:
    """Rest-space offsets d that skinning turns into displacements: ``M d = moved``, damped.

    Args:
        moved: (B, v, 3) displacements of posed vertices [m].
        blended: (B, v, 3, 3) from :meth:`BindBody.blended`.
    """
    transposed = blended.mT
    eye = torch.eye(3, dtype=moved.dtype, device=moved.device)
    normal = transposed @ blended + _DAMPING**2 * eye
    factor = torch.linalg.cholesky(normal)
    right = transposed @ moved[..., None]
    return torch.cholesky_solve(right, factor).squeeze(-1)
