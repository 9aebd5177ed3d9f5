"""What a corrective sees of a pose: local rotations relative to the bind pose, six numbers a joint."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from soma_core.rig.skeleton import Rig

__all__ = ["PoseFeatures", "local_bind_rotations"]


def local_bind_rotations(rig: Rig) -> np.ndarray:
    """Local rotations of the bind pose ``A_j`` in the rig's own axes, (J, 3, 3)."""
    world = rig.bind_world[:, :3, :3]
    local = world[np.maximum(rig.parents, 0)].transpose(0, 2, 1) @ world
    local[0] = world[0]
    return local


class PoseFeatures(torch.nn.Module):
    """``f_j`` = first two columns of ``X_j - I``, row by row, with ``X_j = (A_j^bind)^T A_j``.

    Zero in the bind pose. The first two columns determine the rotation and are continuous in it
    (Zhou et al., On the Continuity of Rotation Representations in Neural Networks, 2019).
    """

    left: Tensor
    right: Tensor

    def __init__(self, rig: Rig, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        orient = rig.t_pose_world[:, :3, :3]
        parent = np.where((rig.parents <= 0)[:, None, None], np.eye(3), orient[np.maximum(rig.parents, 0)])
        # A_j = O_p^T R_j O_j, so that X_j = (O_p A_j^bind)^T R_j O_j.
        left = (parent @ local_bind_rotations(rig)).transpose(0, 2, 1)
        for name, array in (("left", left[1:]), ("right", orient[1:])):
            tensor = torch.as_tensor(np.array(array)).to(dtype=dtype, device=device)
            self.register_buffer(name, tensor, persistent=False)

    def forward(self, relative: Tensor) -> Tensor:
        """Features (B, J, 6) of T-pose-relative rotations (B, J - 1, 3, 3); the root's are zero."""
        turned = self.left @ relative @ self.right
        eye = torch.eye(3, dtype=relative.dtype, device=relative.device)
        columns = (turned - eye)[..., :2].flatten(-2)
        return torch.nn.functional.pad(columns, (0, 0, 1, 0))
