"""Rest shapes from posed meshes: skinning undone, vertex by vertex, over all frames at once."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
from scipy.sparse.linalg import splu
from torch import Tensor

from soma_core.animation.skinning import skinning_transforms
from soma_core.geometry.laplacian import cotangent_laplacian, vertex_areas
from soma_core.geometry.sparse import sparse_product
from soma_core.inversion.result import InversionResult
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["Unposing", "blended_turns", "posed_turns"]

_REACH = 20.0
"""Changes are smoothed over this many times the distance by which the frames disagree on a vertex: over a
few centimetres where another model bends its skin a few millimetres differently."""

_LENGTHS = (2e-3, 0.1)
"""Smallest and largest such length [m]: rounding, and the width of a limb while poses are still wrong."""

_DOUBT = 1e-2
"""Weight of the present rest shape, relative to the frames: holds what skinning squeezes flat."""


class Unposing:
    """Undoes the skinning of posed meshes on the topology of one layer.

    A vertex of the rest shape is the least-squares solution ``(sum M^T M) a = sum M^T (x - m)`` over the
    frames, ``y = M a + m`` its blended skinning transform: poses that squeeze a vertex flat count little.
    The change from `base` then minimises ``|change - that|^2 / l^4 + |Laplacian of the change|^2`` over the
    surface, the length ``l`` growing with the disagreement of the frames. Vertices that no frame shows
    move with their surroundings. ``m`` holds what the full model adds, its twist and correctives.

    Args:
        layer: the forward model.
        base: the body whose relief is kept where the frames say little, batch of 1.
    """

    def __init__(self, layer: SomaLayer, base: Identity) -> None:
        self._layer, self._base = layer, base.rest[0].double().cpu().numpy()
        vertices, triangles = np.asarray(layer.rig.bind_shape, np.float64), layer.mesh.triangles
        self._areas = vertex_areas(vertices, triangles)
        laplacian = cotangent_laplacian(vertices, triangles)
        self._bending = laplacian @ scipy.sparse.diags_array(1 / self._areas) @ laplacian

    def __call__(
        self, vertices: Tensor, weights: Tensor, identity: Identity, pose: InversionResult
    ) -> Tensor:
        """Rest vertices (1, v, 3) [m] in the bind pose of `identity`.

        Args:
            vertices: posed (F, v, 3) [m]; finite where their weight is not zero.
            weights: (1 or F, v).
            identity: batch of 1, that the poses were fitted with.
            pose: of every frame.
        """
        weights = weights.expand(len(vertices), -1).T.double()
        change, disagreement = self._unposed(vertices, weights, identity, pose)
        length = (_REACH * disagreement.sqrt()).clamp(*_LENGTHS)
        trust = torch.where(weights.sum(1) > 0, length**-4, 0.0)
        moved = (identity.rest[0].double() + change).cpu().numpy() - self._base
        smooth = self._base + self._smoothed(moved, trust.cpu().numpy())
        return torch.as_tensor(smooth).to(identity.rest)[None]

    def _unposed(
        self, vertices: Tensor, weights: Tensor, identity: Identity, pose: InversionResult
    ) -> tuple[Tensor, Tensor]:
        """Change (v, 3) [m] of the rest vertices that explains the frames best, vertex by vertex.

        And the mean squared error (v,) [m^2] that is left: how far the frames disagree.
        """
        turn = posed_turns(self._layer, identity, pose)
        reached = pose.posed(self._layer, identity)
        away = torch.where(weights[..., None] > 0, (vertices - reached).transpose(0, 1).double(), 0.0)
        matrix = torch.einsum("vf,vfab,vfac->vbc", weights, turn, turn)
        pull = torch.einsum("vf,vfab,vfa->vb", weights, turn, away)
        total = weights.sum(1).clamp_min(torch.finfo(torch.float32).tiny)
        eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
        factor = torch.linalg.cholesky(matrix + _DOUBT * total[:, None, None] * eye)
        change = torch.cholesky_solve(pull[..., None], factor)
        left = (away - (turn @ change[:, None]).squeeze(-1)).square().sum(-1)
        return change.squeeze(-1), (weights * left).sum(1) / total

    def _smoothed(self, change: np.ndarray, trust: np.ndarray) -> np.ndarray:
        """The change (v, 3) that keeps to `change` where `trust` (v,) is large, and is smooth elsewhere."""
        mass = self._areas * trust
        return splu((scipy.sparse.diags_array(mass) + self._bending).tocsc()).solve(mass[:, None] * change)


def posed_turns(layer: SomaLayer, identity: Identity, pose: InversionResult) -> Tensor:
    """Blended skinning rotations of every vertex in every frame, (v, F, 3, 3), by the public joints.

    `identity` is one for all frames or one for each.
    """
    animation = layer.animation
    turns, places = animation.kinematics(pose.rotations, animation.bone_vectors(identity), pose.translation)
    return blended_turns(layer, skinning_transforms(turns, places, identity.bind_world))


def blended_turns(layer: SomaLayer, transforms: Tensor) -> Tensor:
    """What transforms (B, J, 3, 4) of the public joints turn each vertex by, (v, B, 3, 3) in float64."""
    joints = transforms[..., :3].transpose(0, 1).flatten(1).contiguous()
    blends = sparse_product(layer.animation.skinning.weights.csr, joints)
    return blends.view(-1, len(transforms), 3, 3).double()
