"""A teacher that needs no data: an elastic surface that keeps the volume of the body around its joints."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy.sparse
import torch
from scipy.sparse.linalg import splu
from torch import Tensor

from soma_core.cache import content_key
from soma_core.correctives.bind_body import BindBody
from soma_core.correctives.bones import Bones
from soma_core.correctives.frames import SurfaceFrames, diffused
from soma_core.correctives.masks import find_creases, geodesic_falloff
from soma_core.correctives.sections import Sections
from soma_core.geometry.laplacian import adjacency, random_walk
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["ElasticSurface"]

_STEP, _ROUNDS = 2.0, 4
"""Smoothing of the frames: about two edges of the mesh to each side, 3 cm at a knee, 8 mm at a finger."""

_FREE, _HELD = 0.1, 5.0
"""Pull towards skinned positions, relative to the stiffness of an edge: around joints, and along bones."""

_HELD_FROM = 0.7
"""Smoothed weight of one joint from which on skin begins to be held."""

_REACH = 1.5
"""How far a section around a joint goes along the surface, in thicknesses of the limb."""

_BONE = 6.0
"""Pull of bone on the skin over it, on the same scale."""

_SPREAD = 0.2
"""Of the flesh: below this share of a section pressure is not evened out, or its end would bulge."""

_VERSION = 1  # raise when the surface comes out differently

_VOLUME_STEPS = 6
_CHUNK = 4


class ElasticSurface:
    """Posed bodies as the equilibrium of an elastic skin over its volume, by a few linear solves.

    Minimises ``sum_ij |(x_i - x_j) - (R_i + R_j)/2 (u_i - u_j)|^2 + sum_i a_i |x_i - y_i|^2`` subject to the
    volume of a section around every joint being that of the bind pose: y are skinned vertices, R their
    smooth local rotations (Direct Delta Mush: Le and Lewis 2019), a is large where skin follows one bone.
    With `bones` y goes around the joint on an arc in front of knees and elbows, and no pressure acts there:
    what the fold displaces goes to the flesh of calf and thigh, forearm and upper arm (see :class:`Bones`).
    The rotations are known, so that the energy is quadratic with one matrix for all poses; the volumes are
    kept by one pressure each, found by Newton steps with the response of the bind pose.

    Args:
        mesh, rig: the canonical body; twist joints take part where the rig has any.
        identity: another body than the canonical one, of batch 1.
        bones: there is bone under the skin of knees and elbows.
        kernels: of the frames, see :class:`SurfaceFrames`.
    """

    name = "elastic"

    def __init__(
        self,
        mesh: CanonicalMesh,
        rig: Rig,
        *,
        identity: Identity | None = None,
        bones: bool = False,
        kernels: Literal["auto", "torch", "warp"] = "auto",
    ) -> None:
        self.body = BindBody(rig, identity)
        points = self.body.identity.rest[0].numpy()
        bind_world = self.body.identity.bind_world[0].numpy()
        edges = mesh.edges()
        laplacian = random_walk(edges, len(points))
        self._frames = SurfaceFrames(
            points, self.body.weights, laplacian, step=_STEP, rounds=_ROUNDS, kernels=kernels
        )
        neighbours = adjacency(edges, len(points))
        degree = np.asarray(neighbours.sum(1)).ravel()
        creases = find_creases(rig)
        self._bones = Bones(
            points, self.body.weights, bind_world, rig, creases, laplacian, step=_STEP, rounds=_ROUNDS
        )
        self._bone = _BONE * self._bones.share if bones else np.zeros(len(points))
        self._skinned = _attachment(mesh, rig, laplacian)
        self._held = self._skinned + self._bone
        matrix = scipy.sparse.diags_array(degree + self._held) - neighbours
        self._factor = splu(matrix.tocsc())
        self._adjacency, self._degree = neighbours, degree
        falloff = geodesic_falloff(mesh, creases, reach=_REACH)
        self.sections = Sections(points, mesh.triangles, falloff, np.array(creases.joints), bind_world)
        nearest = np.asarray(falloff.tocsc().max(0).todense()).ravel()
        flesh = (1 - self._bones.share) ** 2 / (_SPREAD + nearest) if bones else np.ones(len(points))
        self._flesh = flesh[:, None]
        self._response = self._volume_response(points)
        weights = self.body.weights
        self.key = content_key(_VERSION + bones, points, weights.data, weights.indices, weights.indptr, edges)

    def __call__(self, relative: Tensor) -> Tensor:
        """Posed vertices (B, v, 3) [m], Hips where they are in the bind pose.

        Args:
            relative: T-pose-relative rotations (B, J - 1, 3, 3) float64.
        """
        return torch.cat([self._solve(part) for part in relative.split(_CHUNK)])

    @torch.no_grad()
    def _solve(self, relative: Tensor) -> Tensor:
        transforms = self.body.transforms(relative)
        load = self._elastic_load(self._frames(transforms).numpy())
        load += self._skinned[:, None] * self.body.skin(transforms).numpy()
        if self._bone.any():
            ids = self._bones.ids
            load[:, ids] += self._bone[ids, None] * self._bones(transforms)
        centres = self.sections.posed_centres(transforms)
        found = self._equilibrium(load)
        pressure = np.zeros((len(relative), self.sections.count))
        for _ in range(_VOLUME_STEPS):
            missing = self.sections.rest_volumes - self.sections.volumes(found, centres)
            pressure += missing @ self._response
            found = self._equilibrium(load + self._flesh * self.sections.push(found, centres, pressure))
        return torch.as_tensor(found)

    def _elastic_load(self, frames: np.ndarray) -> np.ndarray:
        """Right-hand side (B, v, 3) of the equilibrium of the edges alone."""
        rest = self.body.identity.rest[0].numpy()
        turned = (frames @ rest[:, :, None])[..., 0]
        # half of sum_j (R_i + R_j)(u_i - u_j), as sums over neighbours
        around = self._neighbours(frames.reshape(*frames.shape[:2], 9)).reshape(frames.shape)
        own = self._degree[:, None] * rest - self._adjacency @ rest
        bent = (frames @ own[:, :, None])[..., 0] + (around @ rest[:, :, None])[..., 0]
        load: np.ndarray = 0.5 * (bent - self._neighbours(turned))
        return load

    def _neighbours(self, values: np.ndarray) -> np.ndarray:
        """Sum (B, v, n) over the neighbours of each vertex."""
        batch, count, width = values.shape
        columns = values.transpose(1, 0, 2).reshape(count, batch * width)
        return (self._adjacency @ columns).reshape(count, batch, width).transpose(1, 0, 2)

    def _equilibrium(self, load: np.ndarray) -> np.ndarray:
        batch, count, _ = load.shape
        columns = load.transpose(1, 0, 2).reshape(count, 3 * batch)
        return self._factor.solve(columns).reshape(count, batch, 3).transpose(1, 0, 2)

    def _volume_response(self, points: np.ndarray) -> np.ndarray:
        """Pressures (n, n) that give back missing volumes, by the response of the bind pose."""
        slopes = self.sections.rest_gradients(points)
        gained = sum(slope.T @ self._factor.solve(self._flesh * slope) for slope in slopes)
        return np.linalg.inv(gained + _COMPLIANCE * np.diag(gained.diagonal())).T


_COMPLIANCE = 0.05
"""Sections overlap, most of all between the fingers: what they share is not pushed twice."""


def _attachment(mesh: CanonicalMesh, rig: Rig, laplacian: scipy.sparse.csr_array) -> np.ndarray:
    """How strongly each vertex is held where skinning puts it, (v,)."""
    creased = set(find_creases(rig).joints)
    owner = np.arange(rig.joint_count)
    for joint, parent in enumerate(rig.parents):
        if joint not in creased and parent > 0:
            owner[joint] = owner[parent]  # a joint without a crease is part of the bone above it
    groups = scipy.sparse.csr_array((np.ones(len(owner)), (np.arange(len(owner)), owner)))
    smooth = diffused((rig.weights @ groups).toarray(), laplacian, step=_STEP, rounds=_ROUNDS).max(1)
    held = _FREE + _HELD * np.clip((smooth - _HELD_FROM) / (1 - _HELD_FROM), 0, 1) ** 2
    held[mesh.face_interior] = _HELD
    return held
