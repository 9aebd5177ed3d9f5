"""Pose correctives as the layer applies them: sparse in memory and in compute (paper, section 3.5.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.correctives.features import PoseFeatures
from soma_core.correctives.weights import (
    CorrectiveWeights,
    check_bind_pose,
    read_weights,
)
from soma_core.errors import AssetError
from soma_core.geometry.constants import constant
from soma_core.geometry.sparse import SparseRows
from soma_core.rig.manifest import CORRECTIVES_NAME, RESTORE, shipped_file
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.topology.lod_transfer import offset_rows

__all__ = ["Correctives", "find_correctives", "load_correctives", "skeleton_length"]

_RESTORE = f"{RESTORE}; a model of your own is taken by correctives=FILE"


class Correctives(torch.nn.Module):
    """Displacements of the rest shape that depend on the pose: ``tanh(relu(f W1)) W2`` (paper, equation 7).

    Exactly zero in the bind pose. Both stages are sparse products whose weights already hold the masks;
    what no vertex of this level of detail needs is left out.

    Args:
        weights: as read from a checkpoint.
        rig: of the level of detail that comes out.
        outputs: (3 v, 3 V) from offsets of the mid LOD to those of the vertices that come out.
        dtype, device: of constants and results.

    Attributes:
        owner: (activations,) joint that each activation belongs to.
    """

    def __init__(
        self,
        weights: CorrectiveWeights,
        rig: Rig,
        outputs: scipy.sparse.csr_array,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        self.meta, self.use_tanh = weights.meta, weights.use_tanh
        self.features = PoseFeatures(rig, dtype=dtype, device=device)
        second = (outputs @ weights.second.T).tocsc()
        used = np.flatnonzero(np.diff(second.indptr))  # activations that move anything
        self.first = SparseRows(weights.first.T.tocsr()[used], dtype=dtype, device=device)
        self.second = SparseRows(second[:, used].tocsr(), dtype=dtype, device=device)
        self.owner = used // weights.channels
        # A tensor: a list is copied to a GPU at each call, and torch.compile knows no values of NumPy's.
        above = torch.as_tensor(rig.parents[2:].astype(np.int64), device=device)
        self.above = constant(above, device=device)
        self.length = float(skeleton_length(torch.as_tensor(rig.bind_world.copy())[None], rig))

    def scale(self, bind_world: Tensor) -> Tensor:
        """How large bodies are beside the canonical one, (B,), by the length of their bones."""
        return _bone_sum(bind_world, self.above) / self.length

    def forward(self, relative: Tensor, bind_world: Tensor) -> Tensor:
        """Offsets (B, v, 3) [m] of rest shapes in the bind pose. Differentiable.

        Args:
            relative: T-pose-relative rotations (B, J - 1, 3, 3).
            bind_world: bind transforms of the identities (B or 1, J, 4, 4): offsets grow with the body.
        """
        return self.offsets(self.features(relative)) * self.scale(bind_world)[:, None, None]

    def activations(self, features: Tensor) -> Tensor:
        """What the pose excites (activations, B), of features (B, J, 6); offsets are linear in it."""
        active = torch.relu(self.first(features.flatten(1).T.contiguous()))
        return torch.tanh(active) if self.use_tanh else active

    def offsets(self, features: Tensor) -> Tensor:
        """Offsets (B, v, 3) [m] of the canonical body from features (B, J, 6)."""
        moved = self.second(self.activations(features))
        return moved.view(-1, 3, features.shape[0]).permute(2, 0, 1)


def skeleton_length(bind_world: Tensor, rig: Rig) -> Tensor:
    """Sum of all bones below the Hips [m], (B,), of bind transforms (B, J, 4, 4)."""
    above = torch.as_tensor(rig.parents[2:].astype(np.int64), device=bind_world.device)
    return _bone_sum(bind_world, above)


def _bone_sum(bind_world: Tensor, above: Tensor) -> Tensor:
    places = bind_world[..., :3, 3]
    return (places[:, 2:] - places[:, above]).norm(dim=-1).sum(1)


def find_correctives(given: Path | str | None, *, shipped: bool, root: Path | None = None) -> Path | None:
    """The checkpoint that is used; None for none.

    Args:
        given: a file, None, or ``auto`` for the shipped one.
        shipped: whether ``auto`` may be the shipped one.
        root: assets folder of the shipped one; default: the one in use.

    Raises:
        AssetError: a file that was named is not there, or the shipped one was changed.
    """
    if given is None or (given == "auto" and not shipped):
        return None
    path = shipped_file(CORRECTIVES_NAME, fix=_RESTORE, root=root) if given == "auto" else Path(given)
    if path.is_file():
        return path
    if given == "auto":
        return None
    raise AssetError(
        path,
        cause="file is missing",
        fix="Train one with `soma train-correctives`, or pass correctives=None.",
    )


def load_correctives(
    path: Path | None, mesh: CanonicalMesh, rig: Rig, *, dtype: torch.dtype, device: torch.device
) -> Correctives | None:
    """Read a checkpoint for one level of detail; None for no file.

    Raises:
        AssetError: damaged, or made for another rig or mesh.
    """
    if path is None:
        return None
    weights = read_weights(path)
    check_bind_pose(path, weights, rig)
    outputs = offset_rows(mesh)
    least = outputs.shape[1] // 3
    if weights.vertex_count < least:
        cause = f"moves {weights.vertex_count} vertices, this mesh has ids up to {least - 1}"
        raise AssetError(path, cause=cause, fix="Train them for this mesh with `soma train-correctives`.")
    outputs.resize(outputs.shape[0], 3 * weights.vertex_count)
    return Correctives(weights, rig, outputs, dtype=dtype, device=device)
