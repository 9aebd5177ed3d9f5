"""A rig as a file states it, and the two things made of it: its hash and the rig in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.sparse

from soma_core.errors import AssetError
from soma_core.geometry.tree import depth_order
from soma_core.rig.procedural import fold_weights
from soma_core.rig.revision import REVISION_DIGITS, rig_hash
from soma_core.rig.skeleton import Rig
from soma_core.rig.transforms import project_rotations

__all__ = ["ROW_SUM_TOLERANCE", "StoredRig", "refuse_bad_weights"]

ROW_SUM_TOLERANCE = 1e-4  # float32 weights of up to 14 influences, with room for other exporters

# Z-up, facing -Y, to +Y up, facing +Z: (x, y, z) -> (x, z, -y).
_UP_TO_Y = {
    "Y": np.eye(4),
    "Z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
}


def refuse_bad_weights(path: Path, weights: scipy.sparse.csr_array) -> None:
    """Refuse skin weights (v, J) that are not finite, negative, or do not sum to 1.

    Raises:
        AssetError: naming the first or worst vertex.
    """
    fix = "Normalise the skin weights and export again"
    coo = weights.tocoo()
    wrong = ~np.isfinite(coo.data)
    if wrong.any():
        cause = f"skin weights of vertex {coo.coords[0][wrong].min()} are NaN or infinite"
        raise AssetError(path, cause=cause, fix=fix)
    if len(coo.data) and coo.data.min() < 0:
        worst = int(coo.data.argmin())
        cause = f"vertex {coo.coords[0][worst]} has a negative skin weight {coo.data[worst]:.6g}"
        raise AssetError(path, cause=cause, fix=fix)
    sums = np.asarray(weights.sum(axis=1)).ravel()
    vertex = int(np.abs(sums - 1).argmax())
    if abs(sums[vertex] - 1) > ROW_SUM_TOLERANCE:
        cause = f"skin weights of vertex {vertex} sum to {sums[vertex]:.6g}, expected 1"
        raise AssetError(path, cause=cause, fix=fix)


def _scaled(transforms: np.ndarray, factor: float) -> np.ndarray:
    """Scale the translations of (J, 4, 4) transforms."""
    scaled = transforms.copy()
    scaled[:, :3, 3] *= factor
    return scaled


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredRig:
    """A rig in the unit and axes of its file, as column-vector matrices.

    Attributes:
        joint_names: J names in the order of the file.
        parents: (J,) int32, -1 for a root; in any order.
        bind_world, t_pose_world: (J, 4, 4) float64.
        bind_shape: (v, 3) float64.
        weights: (v, J) CSR float64, as stored.
        unit: metres in one unit of the file.
        up: axis that points up.
    """

    joint_names: tuple[str, ...]
    parents: np.ndarray
    bind_world: np.ndarray
    t_pose_world: np.ndarray
    bind_shape: np.ndarray
    weights: scipy.sparse.csr_array
    unit: float = 0.01
    up: Literal["Y", "Z"] = "Y"

    def keep(self, names: Sequence[str]) -> StoredRig:
        """Reduce the rig to the joints in `names`, all of which it has, in that order.

        Each joint that goes is folded into its nearest kept ancestor (the first kept joint where it has
        none): its children hang there, and its skin weights are added there.
        """
        kept = [self.joint_names.index(name) for name in names]
        place = np.full(len(self.joint_names), -1)
        place[kept] = np.arange(len(kept))
        target = np.zeros(len(self.joint_names), np.int64)
        parents = np.full(len(self.joint_names), -1)
        for joint in depth_order(self.parents).tolist():
            above = int(self.parents[joint])
            parents[joint] = -1 if above < 0 else (place[above] if place[above] >= 0 else parents[above])
            target[joint] = place[joint] if place[joint] >= 0 else max(parents[joint], 0)
        return replace(
            self,
            joint_names=tuple(names),
            parents=parents[kept].astype(np.int32),
            bind_world=self.bind_world[kept],
            t_pose_world=self.t_pose_world[kept],
            weights=fold_weights(self.weights, target, len(kept)),
        )

    def digest(self, triangles: np.ndarray) -> str:
        """Rig hash (64 hex digits) of the values before any processing but their unit, here cm."""
        centimetres = self.unit / 0.01
        return rig_hash(
            joint_names=self.joint_names,
            parents=self.parents,
            bind_world=_scaled(self.bind_world, centimetres),
            t_pose_world=_scaled(self.t_pose_world, centimetres),
            bind_shape=centimetres * self.bind_shape,
            weights=self.weights,
            triangles=triangles,
        )

    def metric(self, digest: str) -> Rig:
        """Bring the rig to metres, +Y up, exact rotations, unit row sums and parent-first order."""
        turn = _UP_TO_Y[self.up]
        bind, t_pose = (
            project_rotations(turn @ _scaled(world, self.unit) @ turn.T)
            for world in (self.bind_world, self.t_pose_world)
        )
        order = np.arange(len(self.parents))
        if (self.parents >= order).any():
            order = depth_order(self.parents)
        place = np.append(np.argsort(order), -1)  # the last entry keeps a root's parent at -1
        rows = scipy.sparse.diags_array(1.0 / self.weights.sum(axis=1))
        weights = scipy.sparse.csr_array((rows @ self.weights)[:, order])
        weights.sort_indices()
        return Rig(
            joint_names=tuple(self.joint_names[joint] for joint in order),
            parents=place[self.parents[order]].astype(np.int32),
            bind_world=bind[order],
            t_pose_world=t_pose[order],
            bind_shape=self.unit * self.bind_shape @ turn[:3, :3].T,
            weights=weights,
            revision=digest[:REVISION_DIGITS],
        )
