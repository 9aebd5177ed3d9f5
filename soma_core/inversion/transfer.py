"""Skeleton transfer: the skeleton fit of a posed mesh, a coarse fast fit (paper, section 3.6)."""

from __future__ import annotations

import functools

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.geometry.constants import constant
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.sparse import SparseRows
from soma_core.inversion.problem import Problem
from soma_core.inversion.structure import MomentStructure
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.joints import joint_regressor
from soma_core.skeleton.rotations import RotationFit

__all__ = ["SkeletonTransfer"]


class SkeletonTransfer(torch.nn.Module):
    """Joint positions by the RBF regressor, joint rotations by Kabsch and child alignment.

    As the skeleton fit of a rest shape, with three differences: vertices count by their skin weight on the
    joint, so that those that mostly follow another joint say little; bones are those of the identity; and
    joints without children, such as the jaw, are turned by their own points. The covariances come from the
    moments of the target, so that only the regressor reads vertices.

    Args:
        structure: joints, and which of them carry weight.
        mesh, rig: of the fit.
    """

    def __init__(
        self,
        structure: MomentStructure,
        mesh: CanonicalMesh,
        rig: Rig,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        regressor = scipy.sparse.csr_array(joint_regressor(mesh, rig))
        self.regressor = SparseRows(regressor, dtype=dtype, device=device)
        self.rotations = RotationFit(rig, dtype=dtype, device=device)

        keep = functools.partial(constant, device=device)
        self.read = keep(np.unique(regressor.indices))
        self.joints = keep(structure.joints)
        self.parents = keep(np.maximum(structure.parents, 0))
        pivots = self.rotations.pivots.cpu().numpy()
        alone = np.setdiff1d(structure.joints, pivots)
        self.alone = keep(alone)
        self.source = keep(_sources(structure, pivots, alone))
        self.eye = keep(torch.eye(3, dtype=dtype))

    def forward(self, problem: Problem) -> Tensor:
        """T-pose-relative rotations (F, J, 3, 3).

        Raises:
            InputError: a vertex that the regressor reads has no weight.
        """
        self._check(problem.weights)
        vertices, rest = problem.vertices - problem.origin[:, None], problem.rest
        flat = vertices.permute(1, 2, 0).flatten(1).contiguous()
        joints = self.regressor(flat).unflatten(1, (3, -1)).permute(2, 0, 1)
        mean, target = rest.own[..., 3, :3], problem.target[..., :3]
        about = target - joints[:, self.joints, :, None] * mean[..., None, :]
        covariances = joints.new_zeros(*joints.shape, 3).index_copy(1, self.joints, about)
        pivots = self.rotations.displacements(joints, covariances, rest.offsets)
        alone = rotation_from_covariance(covariances[:, self.alone])
        eye = self.eye.expand(len(joints), 1, 3, 3)
        turns = torch.cat((eye, pivots, alone), 1)[:, self.source]
        relative = turns[:, self.parents].transpose(-1, -2) @ turns
        relative = 1.5 * relative - 0.5 * relative @ (relative.transpose(-1, -2) @ relative)
        return torch.cat((eye, relative[:, 1:]), 1)

    def _check(self, weights: Tensor) -> None:
        """Refuse weights that leave out what the joints are read from."""
        missing = (weights[:, self.read] == 0).any(0)
        if bool(missing.any()):
            raise InputError(
                "weights",
                got=f"0 at {int(missing.sum())} of the {len(self.read)} vertices that locate joints",
                expected="a weight above 0 at each of them for the stage 'transfer'",
                fix="Start without it: stages=('procrustes', ...).",
            )


def _sources(structure: MomentStructure, pivots: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """(J,) position in (identity, `pivots`, `alone`) of each joint's turn; its parent's where it has none."""
    source = np.zeros(len(structure.parents), np.int64)
    source[pivots] = 1 + np.arange(len(pivots))
    source[alone] = 1 + len(pivots) + np.arange(len(alone))
    for joint in range(1, len(source)):
        if source[joint] == 0:
            source[joint] = source[structure.parents[joint]]
    return source
