"""The skeleton fit as one sparse operator and a handful of 3x3 problems (paper, section 3.4)."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.geometry.constants import constant
from soma_core.geometry.sparse import SparseRows
from soma_core.geometry.torch_func import untracked
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.joints import joint_regressor
from soma_core.skeleton.rotations import RotationFit

__all__ = ["SkeletonFit", "fit_operator"]

_NOTICEABLE = 0.01
"""Skin weight above which a vertex takes part in a joint's covariance."""


def fit_operator(mesh: CanonicalMesh, rig: Rig) -> scipy.sparse.csr_array:
    """Matrix (4 J, v) whose product with vertices gives joint positions and covariances.

    Row ``4 k`` is the joint regressor. Rows ``4 k + 1 + c`` give column c of
    ``C_k = sum_v (x_v - j_k)(a_v - j_k_bind)^T`` over the vertices with noticeable weight: linear in x
    because the joint itself is.
    """
    regressor = joint_regressor(mesh, rig)
    bind = rig.bind_world[:, :3, 3]
    interior = np.zeros(mesh.vertex_count, bool)
    interior[mesh.face_interior] = True
    weights = rig.weights.tocoo()
    chosen = (weights.data > _NOTICEABLE) & (weights.col > 0) & ~interior[weights.row]
    vertex, joint = weights.row[chosen], weights.col[chosen]
    arm = rig.bind_shape[vertex] - bind[joint]
    total = np.zeros((rig.joint_count, 3))
    np.add.at(total, joint, arm)
    shape = (rig.joint_count, mesh.vertex_count)
    blocks = [regressor]
    for axis in range(3):
        cloud = scipy.sparse.csr_array((arm[:, axis], (joint, vertex)), shape=shape)
        blocks.append(cloud - scipy.sparse.diags_array(total[:, axis]) @ regressor)
    stacked = scipy.sparse.vstack(blocks).tocsr()
    order = np.arange(4 * rig.joint_count).reshape(4, -1).T.ravel()  # (block, joint) -> (joint, block)
    return stacked[order]


class SkeletonFit(torch.nn.Module):
    """Fits the rig's joints to vertices on the canonical topology, in any pose.

    Args:
        mesh, rig: the canonical mesh and rig at one LOD.
        dtype, device: of the constants.
        warp: fit rotations by the Warp twin instead of the torch reference.
    """

    def __init__(
        self,
        mesh: CanonicalMesh,
        rig: Rig,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
        warp: bool = False,
    ) -> None:
        super().__init__()
        self.matrix = fit_operator(mesh, rig)
        self.joint_count = rig.joint_count
        self.moments = SparseRows(self.matrix, dtype=dtype, device=device)
        self.rotations = RotationFit(rig, dtype=dtype, device=device, warp=warp)
        self.bottom = constant(np.array([0.0, 0.0, 0.0, 1.0]), device=device, dtype=dtype)

    def forward(self, vertices: Tensor) -> Tensor:
        """World transforms (B, J, 4, 4) [m] of the joints, from vertices (B, v, 3) [m]. Differentiable."""
        batch = vertices.shape[0]
        flat = vertices.permute(1, 2, 0).reshape(vertices.shape[1], 3 * batch)
        moments = self.moments(flat).view(self.joint_count, 4, 3, batch)
        return self.from_moments(moments.permute(3, 0, 1, 2))

    def from_moments(self, moments: Tensor) -> Tensor:
        """World transforms (B, J, 4, 4) from moments (B, J, 4, 3): position, then covariance columns."""
        joints, covariances = moments[:, :, 0], moments[:, :, 1:].transpose(-1, -2)
        if self.rotations.fused and untracked(moments):
            return self.rotations.world(joints, covariances)
        rotations = self.rotations(joints, covariances)
        top = torch.cat((rotations, joints[..., None]), -1)
        bottom = self.bottom.expand(*top.shape[:2], 1, 4)
        return torch.cat((top, bottom), -2)
