"""Semantic segments of the canonical mesh, from its geometry and skin weights.

Every segment is closed under the mirror map. The thresholds were chosen on pictures of the bind
shape; none of the segments decides a position, they mask regions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from soma_core.errors import InputError
from soma_core.geometry.mesh import triangle_sides

__all__ = ["RiggedMesh", "label_segments"]

_MAJORITY = 0.5  # a vertex belongs to the body part that carries most of its weight

_HEAD = ("Head", "HeadEnd", "Jaw", "LeftEye", "RightEye")
_TORSO = ("Hips", "Spine1", "Spine2", "Chest", "LeftShoulder", "RightShoulder")

# Between the toes, two sheets of skin face each other at less than the width of a toe.
_TOE_GAP = 1.0  # cm along the normal
_TOE_ASIDE = 0.35  # cm across it: about the spacing of the vertices
_TOE_FACING = -0.3  # cosine between the two normals
_TOE_CLOSING = 2  # rings taken in where at least half of the neighbours belong already

# The armpit is the hollow under the arm: the skin around the point that faces straight down.
_ARMPIT_SHARE = 0.1  # least weight of arm and of trunk at that point
_ARMPIT_RADIUS = 6.0  # cm


@dataclass(frozen=True, kw_only=True, eq=False)
class RiggedMesh:
    """The mid mesh as the segments need it.

    Attributes:
        vertices: (v, 3) bind shape [cm], +Y up, +X left.
        triangles: (t, 3).
        weights: (v, J) dense.
        joint_names: J names.
        mirror: (v,) left/right partners.
        face_interior: ids of the mouth bag and the eye bags.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    weights: np.ndarray
    joint_names: tuple[str, ...]
    mirror: np.ndarray
    face_interior: np.ndarray

    def share(self, names: Sequence[str]) -> np.ndarray:
        """Skin weight that the named joints carry together: (v,)."""
        return self.weights[:, [self.joint_names.index(name) for name in names]].sum(axis=1)

    def normals(self) -> np.ndarray:
        """Unit vertex normals, weighted by area: (v, 3)."""
        a, b, c = (self.vertices[self.triangles[:, corner]] for corner in range(3))
        faces = np.cross(b - a, c - a)
        normals = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(normals, self.triangles[:, corner], faces)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def adjacency(self) -> scipy.sparse.csr_array:
        """Which vertices share an edge: (v, v), entries 1."""
        pairs = triangle_sides(self.triangles)
        count = len(self.vertices)
        # Every edge of a closed, oriented mesh appears once in each direction.
        return scipy.sparse.csr_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))


def _interior_parts(mesh: RiggedMesh) -> tuple[np.ndarray, np.ndarray]:
    """Split the face interior into the mouth bag (the largest component) and the two eye bags."""
    graph = mesh.adjacency()[mesh.face_interior][:, mesh.face_interior]
    labels = connected_components(graph, directed=False)[1]
    names, sizes = np.unique(labels, return_counts=True)
    if len(names) != 3:
        raise InputError(
            "face_interior",
            got=f"{len(names)} connected parts",
            expected="3: one mouth bag and two eye bags",
            fix="Check the source rig.",
        )
    mouth = labels == names[sizes.argmax()]
    return mesh.face_interior[mouth], mesh.face_interior[~mouth]


def _between_toes(mesh: RiggedMesh, normals: np.ndarray) -> np.ndarray:
    """Vertices of the toes whose skin faces the skin of the next toe across a narrow gap."""
    found = np.zeros(len(mesh.vertices), bool)
    for side in ("Left", "Right"):
        ids = np.flatnonzero(mesh.share([f"{side}ToeBase", f"{side}ToeEnd"]) > _MAJORITY)
        offsets = mesh.vertices[ids][None] - mesh.vertices[ids][:, None]
        along = np.einsum("ijc,ic->ij", offsets, normals[ids])
        aside = np.linalg.norm(offsets - along[..., None] * normals[ids][:, None], axis=2)
        facing = normals[ids] @ normals[ids].T
        close = (along > 0) & (along < _TOE_GAP) & (aside < _TOE_ASIDE) & (facing < _TOE_FACING)
        found[ids[close.any(axis=1)]] = True
    # The web at the bottom of a gap faces nothing: take in what the two walls enclose.
    adjacency = mesh.adjacency()
    for _ in range(_TOE_CLOSING):
        found |= adjacency @ found >= _MAJORITY * adjacency.sum(axis=1)
    return found


def _armpits(mesh: RiggedMesh, normals: np.ndarray) -> np.ndarray:
    """Skin around the highest point of the hollow between each arm and the trunk."""
    found = np.zeros(len(mesh.vertices), bool)
    trunk = mesh.share(("Spine1", "Spine2", "Chest"))
    for side in ("Left", "Right"):
        shared = (mesh.share([f"{side}Arm"]) > _ARMPIT_SHARE) & (trunk > _ARMPIT_SHARE)
        apex = mesh.vertices[np.where(shared, normals[:, 1], np.inf).argmin()]
        found |= np.linalg.norm(mesh.vertices - apex, axis=1) < _ARMPIT_RADIUS
    return found


def label_segments(mesh: RiggedMesh) -> dict[str, np.ndarray]:
    """Label the canonical mesh: segment name -> sorted int32 vertex ids of the mid LOD.

    `hair` and `haircap` are empty: the source mesh has neither.

    Raises:
        InputError: the face interior does not split into mouth bag and eye bags.
    """
    normals = mesh.normals()
    mouth, eyes = _interior_parts(mesh)
    skin = np.ones(len(mesh.vertices), bool)
    skin[mesh.face_interior] = False
    feet = [f"{side}{joint}" for side in ("Left", "Right") for joint in ("Foot", "ToeBase", "ToeEnd")]
    masks = {
        "head": skin & (mesh.share(_HEAD) > _MAJORITY),
        "feet": mesh.share(feet) > _MAJORITY,
        "torso": mesh.share(_TORSO) > _MAJORITY,
        "between_toes": _between_toes(mesh, normals),
        "armpits": _armpits(mesh, normals),
    }
    segments = {name: np.flatnonzero(mask | mask[mesh.mirror]) for name, mask in masks.items()}
    segments |= {"mouth_bag": np.sort(mouth), "eye_bags": np.sort(eyes)}
    segments |= {"hair": np.empty(0), "haircap": np.empty(0)}
    return {name: ids.astype(np.int32) for name, ids in segments.items()}
