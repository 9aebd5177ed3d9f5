"""Volumes of the body around its joints, and the pressure that changes them."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

__all__ = ["Sections"]


class Sections:
    """Sections of the body around joints: cones from a joint's place to the skin around its crease.

    A section's volume is ``sum_t w_t det(a - c, b - c, d - c) / 6`` over triangles (a, b, d), c the place of
    the joint and w_t falling off with the distance from the crease. It does not change where the section
    moves rigidly. With ``det(a - c, b - c, d - c) = det(a, b, d) - c . n``, n twice the area vector, every
    triangle is looked at once for all sections.

    Args:
        rest: (v, 3) [m].
        triangles: (t, 3).
        falloff: (n, v) weight of each vertex in each section.
        joints: (n,) ids of their joints.
        bind_world: (J, 4, 4).
    """

    def __init__(
        self,
        rest: np.ndarray,
        triangles: np.ndarray,
        falloff: scipy.sparse.csr_array,
        joints: np.ndarray,
        bind_world: np.ndarray,
    ) -> None:
        self.count, self.joints = len(joints), joints
        self.centres = bind_world[joints, :3, 3]
        weight = falloff.T.tocsr()
        shares = (weight[triangles[:, 0]] + weight[triangles[:, 1]] + weight[triangles[:, 2]]) / 18
        used = np.flatnonzero(np.diff(shares.indptr))
        self._shares = shares[used]
        self._corners = torch.as_tensor(triangles[used].astype(np.int64))
        ids = self._corners.numpy().ravel()
        entries = (np.ones(len(ids)), (ids, np.arange(len(ids))))
        self._scatter = scipy.sparse.csr_array(entries, shape=(len(rest), len(ids)))
        self.rest_volumes = self.volumes(rest[None], self.centres[None])[0]

    def posed_centres(self, transforms: Tensor) -> np.ndarray:
        """Places (B, n, 3) of the joints under skinning transforms (B, T, 3, 4)."""
        matrices = transforms[:, torch.as_tensor(self.joints)].numpy()
        return (matrices[..., :3] @ self.centres[:, :, None])[..., 0] + matrices[..., 3]

    def volumes(self, vertices: np.ndarray, centres: np.ndarray) -> np.ndarray:
        """Volumes (B, n) [m^3] of posed vertices (B, v, 3) about centres (B, n, 3)."""
        a, b, d = self._triangles(vertices)
        cross = torch.linalg.cross
        normal = cross(b - a, d - a).numpy()
        solid = (a * cross(b, d)).sum(-1).numpy()
        turned = self._shares.T @ normal.transpose(1, 0, 2).reshape(len(self._corners), -1)
        turned = turned.reshape(self.count, -1, 3).transpose(1, 0, 2)
        return (self._shares.T @ solid.T).T - (centres * turned).sum(-1)

    def push(self, vertices: np.ndarray, centres: np.ndarray, pressure: np.ndarray) -> np.ndarray:
        """Forces (B, v, 3) of pressures (B, n): ``sum_j pressure_j d volume_j / d vertices``."""
        a, b, d = self._triangles(vertices)
        cross, batch = torch.linalg.cross, len(vertices)
        strength = torch.from_numpy(self._shares @ pressure.T).T[..., None]
        moment = (pressure[..., None] * centres).transpose(1, 0, 2).reshape(self.count, -1)
        middle = torch.from_numpy(self._shares @ moment).view(-1, batch, 3).transpose(0, 1)
        forces = torch.stack(
            [strength * cross(y, z) - cross(middle, z - y) for y, z in ((b, d), (d, a), (a, b))]
        )  # (corner, B, t, 3)
        flat = forces.permute(2, 0, 1, 3).reshape(-1, 3 * batch).numpy()
        return (self._scatter @ flat).reshape(-1, batch, 3).transpose(1, 0, 2)

    def rest_gradients(self, rest: np.ndarray) -> list[np.ndarray]:
        """Derivatives of the volumes by x, y and z of the vertices (v, 3) at rest, each (v, n)."""
        columns = [self.push(rest[None], self.centres[None], row[None])[0] for row in np.eye(self.count)]
        return list(np.stack(columns, -1).transpose(1, 0, 2))

    def _triangles(self, vertices: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Corners of the triangles, each (B, t, 3)."""
        points = torch.from_numpy(np.ascontiguousarray(vertices))
        a, b, d = (points[:, self._corners[:, corner]] for corner in range(3))
        return a, b, d
