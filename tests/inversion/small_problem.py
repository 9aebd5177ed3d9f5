"""Inversion problems of a few frames, and the skinning error by its definition."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.engine import Animation
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import RestMoments, SkinMoments
from soma_core.inversion.problem import Pose
from soma_core.inversion.structure import MomentStructure, skin_structure
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity
from tests.bodies import CPU, randn, tiny_canonical

__all__ = ["Body", "canonical_structure", "part", "pose_about", "real", "synthetic"]


@functools.cache
def synthetic() -> Body:
    """The small body of formulas, whose coarse hands hardly determine their joints."""
    return Body(*tiny_canonical())


@functools.cache
def real() -> Body:
    """The shipped rig at low LOD, whose weights determine every variable joint."""
    return Body(*load_canonical("low"))


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh and rig with what fits need of them, made once."""

    mesh: CanonicalMesh
    rig: Rig

    @functools.cached_property
    def structure(self) -> MomentStructure:
        """Index lists of the rig."""
        return canonical_structure(self.mesh, self.rig)

    @functools.cached_property
    def skin_weights(self) -> np.ndarray:
        """Skin weights (v, J), zero in the face interior."""
        weights = self.rig.weights.toarray()
        weights[self.mesh.face_interior] = 0
        return weights

    @functools.cache  # noqa: B019 - there are two bodies
    def animation(self, dtype: torch.dtype = torch.float64) -> Animation:
        """The forward model."""
        return Animation(self.rig, dtype=dtype, device=CPU, kernels="torch")

    @functools.cache  # noqa: B019
    def moments(self, dtype: torch.dtype = torch.float64, *, warp: bool = False) -> SkinMoments:
        """Moments of the rig."""
        return SkinMoments(self.structure, self.rig, dtype=dtype, device=CPU, warp=warp)

    @functools.cache  # noqa: B019
    def solver(self, dtype: torch.dtype = torch.float64, *, warp: bool = False) -> GaussNewton:
        """Solver of the rig."""
        return GaussNewton(self.structure, dtype=dtype, device=CPU, warp=warp)

    def identities(self, count: int, *, dtype: torch.dtype = torch.float64, seed: int = 0) -> Identity:
        """Bodies of other proportions, a few millimetres rough, with bones of other lengths."""
        size = 1 + 0.1 * randn(count, 1, 3, seed=seed)
        rest = size * torch.tensor(self.mesh.vertices)
        rest = rest + 0.003 * randn(count, self.mesh.vertex_count, 3, seed=seed + 1)
        bind = torch.tensor(self.rig.bind_world).repeat(count, 1, 1, 1)
        jitter = 0.003 * randn(count, self.rig.joint_count - 1, 3, seed=seed + 2)
        bind[:, 1:, :3, 3] = size * bind[:, 1:, :3, 3] + jitter
        rest, bind = rest.to(dtype), bind.to(dtype)
        return Identity(rest=rest, bind_world=bind, fitted_rest=rest, fitted_world=bind)

    def poses(
        self, count: int, *, spread: float = 0.3, dtype: torch.dtype = torch.float64, seed: int = 5
    ) -> tuple[Tensor, Tensor]:
        """Rotations (count, J - 1, 3, 3), `spread` an axis [rad], and Hips positions (count, 3) [m]."""
        turns = axis_angle_to_matrix(spread * randn(count, self.rig.joint_count - 1, 3, seed=seed))
        return turns.to(dtype), (0.3 * randn(count, 3, seed=seed + 1)).to(dtype)

    def plain_weights(self, dtype: torch.dtype = torch.float64) -> Tensor:
        """Vertex weights (1, v): one, and zero in the face interior."""
        return torch.tensor(self.structure.fitted, dtype=dtype)[None]

    def vertex_weights(self, count: int, *, dtype: torch.dtype = torch.float64, seed: int = 8) -> Tensor:
        """Vertex weights (count, v) of 0.5 to 1.5; one vertex in ten is left out, and the face interior."""
        random = torch.Generator().manual_seed(seed)
        weights = 0.5 + torch.rand(count, self.mesh.vertex_count, generator=random, dtype=torch.float64)
        weights[:, ::10] = 0
        return (weights * self.plain_weights()).to(dtype)

    def posed(self, identity: Identity, rotations: Tensor, hips: Tensor) -> Tensor:
        """Vertices (F, v, 3) [m] of the forward model."""
        return self.animation(rotations.dtype).pose(identity, rotations, hips, absolute=False).vertices

    def rest(self, identity: Identity, weights: Tensor) -> RestMoments:
        """Moments of identities by the reference."""
        dtype = identity.rest.dtype
        offsets = self.animation(dtype).kinematics.local_offsets(identity.bind_world)
        return self.moments(dtype).rest(identity, weights, offsets)

    def energy(
        self, identity: Identity, weights: Tensor, vertices: Tensor, pose: Pose, origin: Tensor
    ) -> Tensor:
        """Weighted squared vertex error (F,) [m^2] of a pose about `origin`, by its definition."""
        reached = self.posed(identity, pose.relative[:, 1:], pose.translation + origin)
        return (weights * (reached - vertices).square().sum(-1)).sum(1)

    def start(self, count: int, dtype: torch.dtype = torch.float64) -> Pose:
        """All joints at T-pose, the Hips at the origin of each frame."""
        eye = torch.eye(3, dtype=dtype).repeat(count, self.rig.joint_count, 1, 1)
        return Pose.begin(eye, torch.zeros(count, 3, dtype=dtype))


def canonical_structure(mesh: CanonicalMesh, rig: Rig) -> MomentStructure:
    """Index lists of a rig: all influences outside the face interior."""
    fitted = np.ones(mesh.vertex_count, bool)
    fitted[mesh.face_interior] = False
    return skin_structure(rig, fitted)


def pose_about(rotations: Tensor, hips: Tensor, origin: Tensor) -> Pose:
    """A pose with the root's rotation, its Hips position about an origin."""
    eye = torch.eye(3, dtype=rotations.dtype).expand(len(rotations), 1, 3, 3)
    return Pose.begin(torch.cat((eye, rotations), 1), hips - origin)


def part(pose: Pose, frames: slice | Tensor) -> Pose:
    """Some frames of a pose."""
    return Pose(**{name: getattr(pose, name)[frames] for name in pose.__dataclass_fields__})
