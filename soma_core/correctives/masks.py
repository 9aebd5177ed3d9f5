"""Which joints a corrective listens to and which vertices it moves (paper, section 3.5.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import dijkstra

from soma_core.geometry.mesh import triangle_sides, unique_edges
from soma_core.geometry.tree import descendants
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["Creases", "find_creases", "geodesic_falloff", "joint_mask", "vertex_mask"]

_TREE_EDGES = 2
"""A corrective listens to joints at most so many bones away."""

_BLEND = 0.05
"""Vertices that both sides of a joint hold by more than this share make up its crease."""

_FEWEST = 6
"""A crease of fewer vertices is no limb's."""

_RIGID = ("Jaw", "LeftEye", "RightEye")
"""Joints that move parts of the face, not a limb: they have no crease."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Creases:
    """Where the skin folds, joint by joint.

    Attributes:
        vertices: joint id -> ids of the vertices that the joint's subtree and the rest of the body share.
        radius: joint id -> mean distance of those vertices from the joint [m], the limb's thickness there.
    """

    vertices: dict[int, np.ndarray]
    radius: dict[int, float]

    @property
    def joints(self) -> list[int]:
        """Ids of the joints that have a crease, ascending."""
        return sorted(self.vertices)


def find_creases(rig: Rig) -> Creases:
    """Find the crease of every joint from the skin weights; joints without one are left out."""
    subtree = descendants(rig.parents)
    below = rig.weights @ subtree.T.astype(float)  # share of a vertex that each joint's subtree holds
    vertices, radius = {}, {}
    for joint, name in enumerate(rig.joint_names):
        share = below[:, joint]
        found = np.flatnonzero((share > _BLEND) & (share < 1 - _BLEND))
        if len(found) < _FEWEST or name in _RIGID or rig.parents[joint] <= 0:
            continue
        away = np.linalg.norm(rig.bind_shape[found] - rig.bind_world[joint, :3, 3], axis=1)
        vertices[joint], radius[joint] = found, float(away.mean())
    return Creases(vertices=vertices, radius=radius)


def geodesic_falloff(mesh: CanonicalMesh, creases: Creases, *, reach: float) -> scipy.sparse.csr_array:
    """How near each vertex is to each joint's crease, along the surface; (J or fewer rows, v) in (0, 1].

    ``(1 - (d / r)^2)^2`` for the geodesic distance d from the crease, zero from ``r = reach * radius`` on;
    row i belongs to ``creases.joints[i]``. Distances run along edges of polygons and triangles (Dijkstra),
    so that a hand at the hip, or a finger beside its neighbour, is far.
    """
    count = mesh.vertex_count
    edges = unique_edges(np.concatenate([mesh.edges(), triangle_sides(mesh.triangles)]))
    length = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
    graph = scipy.sparse.csr_array((length, (edges[:, 0], edges[:, 1])), shape=(count, count))
    rows = []
    for joint in creases.joints:
        limit = reach * creases.radius[joint]
        distance = dijkstra(
            graph, directed=False, indices=creases.vertices[joint], min_only=True, limit=limit
        )
        inside = distance < limit
        value = np.where(inside, (1 - np.where(inside, distance / limit, 0.0) ** 2) ** 2, 0.0)
        rows.append(scipy.sparse.csr_array(value[None]))
    return scipy.sparse.vstack(rows, format="csr")


def joint_mask(rig: Rig, creases: Creases) -> np.ndarray:
    """M1, (J, J) booleans: entry (i, j) lets the activations of joint j read the rotation of joint i.

    Joint i is at most two bones away and either above or below j, or its skin touches that of j. Only
    joints with a crease have activations, and only joints that move skin are read.
    """
    count = rig.joint_count
    bones = np.zeros((count, count), int)
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            bones[joint, parent] = bones[parent, joint] = 1
    near = np.linalg.matrix_power(np.eye(count, dtype=int) + bones, _TREE_EDGES) > 0
    below = descendants(rig.parents)
    holds = (rig.weights > 0.01).astype(int)
    touching = (holds.T @ holds).toarray() > 0
    mask = near & (below | below.T | touching)
    mask[~touching.any(1)] = False
    mask[0] = False  # the root does not turn
    active = np.zeros(count, bool)
    active[creases.joints] = True
    return mask & active[None]


def vertex_mask(
    mesh: CanonicalMesh, rig: Rig, creases: Creases, *, reach: float = 1.5
) -> scipy.sparse.csr_array:
    """M2, (J, v): how far joint j may move vertex v, in [0, 1], by geodesic distance from its crease.

    The bags inside the face are left alone.
    """
    falloff = geodesic_falloff(mesh, creases, reach=reach).tocoo()
    rows = np.array(creases.joints)[falloff.row]
    keep = ~np.isin(falloff.col, mesh.face_interior)
    return scipy.sparse.csr_array(
        (falloff.data[keep], (rows[keep], falloff.col[keep])), shape=(rig.joint_count, mesh.vertex_count)
    )
