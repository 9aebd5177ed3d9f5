"""Where the points of a set lie on posed bodies: a sparse product of joints and vertices."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.geometry.sparse import SparseRows
from soma_core.points.point_set import PointSet
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["PointPlaces"]


class PointPlaces(torch.nn.Module):
    """The points of one set on one mesh and rig.

    Args:
        points: the set.
        mesh, rig: of the layer that poses.

    Attributes:
        names: of the points.
        joint_weight: (P, J) weights of the joints.
        offset: (P, 3) [m] from the one joint of a point, in T-pose world axes, on the rig's own body.
        vertex_ids: (u,) vertices that any point uses, ascending.
        vertex_weight: (P, u) scipy CSR weights of these.

    Raises:
        InputError: a joint or a vertex that this mesh and rig do not have.
    """

    joint_weight: Tensor
    offset: Tensor
    vertex_ids: Tensor

    def __init__(
        self,
        points: PointSet,
        mesh: CanonicalMesh,
        rig: Rig,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        self.set, self.names = points, points.names
        joints = np.zeros((len(points), rig.joint_count))
        offsets = np.zeros((len(points), 3))
        rows, columns, values = [], [], []
        for row, (name, point) in enumerate(points.points.items()):
            offsets[row] = point.offset
            for joint, weight in point.joints.items():
                joints[row, _joint(rig, joint, points.name, name)] = weight
            for vertex, weight in point.vertices.items():
                rows.append(row)
                columns.append(_vertex(mesh, vertex, points.name, name))
                values.append(weight)
        ids = np.unique(np.array(columns, np.int64))
        shape = (len(points), len(ids))
        at = np.searchsorted(ids, columns).astype(np.int64)
        self.vertex_weight = scipy.sparse.coo_array((values, (rows, at)), shape=shape).tocsr()
        self._skin = SparseRows(self.vertex_weight, dtype=dtype, device=device) if len(ids) else None
        parents = np.maximum(rig.parents, 0)
        length = np.linalg.norm(rig.bind_world[:, :3, 3] - rig.bind_world[parents, :3, 3], axis=1)
        length[:2] = 0
        orient = rig.t_pose_world[:, :3, :3].copy()
        orient[0] = np.eye(3)
        self.length = float(length.sum())
        kept = {
            "joint_weight": joints, "offset": offsets, "vertex_ids": ids, "parents": parents,
            "back": orient.transpose(0, 2, 1),
        }  # fmt: skip
        for key, array in kept.items():
            tensor = torch.as_tensor(np.ascontiguousarray(array), device=device)
            tensor = tensor.to(dtype) if tensor.is_floating_point() else tensor.long()
            self.register_buffer(key, tensor, persistent=False)
        self.has_offsets = bool(offsets.any())

    def size(self, joints: Tensor) -> Tensor:
        """Size (B,) of bodies beside the rig's own: the ratio of the lengths of all bones.

        Args:
            joints: (B, J, 3) positions of all joints [m].
        """
        bones = joints[:, 2:] - joints[:, self.parents[2:]]
        return bones.norm(dim=-1).sum(1) / self.length

    def forward(self, transforms: Tensor, vertices: Tensor | None) -> Tensor:
        """Points (B, P, 3) [m] of posed bodies.

        Args:
            transforms: world transforms (B, J, 4, 4) of all joints.
            vertices: those of `vertex_ids`, (B, u, 3); None for a set without any.
        """
        joints = transforms[..., :3, 3]
        points = self.joint_weight @ joints
        if self.has_offsets:
            turns = transforms[..., :3, :3] @ self.back
            reach = self.size(joints)[:, None, None] * self.offset
            moved = torch.einsum(
                "bpac,bpc->bpa", torch.einsum("pj,bjac->bpac", self.joint_weight, turns), reach
            )
            points = points + moved
        if self._skin is not None and vertices is not None:
            flat = vertices.permute(1, 2, 0).flatten(1)
            skin = self._skin(flat).unflatten(1, (3, -1)).permute(2, 0, 1)
            points = points + skin
        return points


def _joint(rig: Rig, joint: str, points: str, name: str) -> int:
    if joint in rig.joint_names[1:]:
        return rig.joint_names.index(joint)
    raise InputError(
        f"points={points}, {name!r}", got=f"joint {joint!r}", expected="a joint of the rig",
        fix="Take a name from layer.joint_names.",
    )  # fmt: skip


def _vertex(mesh: CanonicalMesh, vertex: int, points: str, name: str) -> int:
    ids = mesh.mid_ids
    place = int(np.searchsorted(ids, vertex)) if ids is not None else vertex
    if place < len(ids) and ids[place] == vertex:
        return place
    raise InputError(
        f"points={points}, {name!r}", got=f"vertex {vertex} at lod={mesh.lod}",
        expected="a vertex of that level of detail; ids below 4505 are in mid and low",
        fix="Take lod=mid, or another vertex.",
    )  # fmt: skip
