"""The skinning error as an explicit quadratic in the joint transforms.

With local rest points ``b_vt`` and posed joints ``G_t = [D_t | c_t]`` a vertex is
``y_v = sum_t w_vt G_t (b_vt; 1)``, so that ``E = sum_v o_v |y_v - x_v|^2 = <G N, G> - 2 <G, R> + const``:

- ``N_tu = sum_v o_v w_vt w_vu (b_vt; 1)(b_vu; 1)^T`` knows the identity and the vertex weights only;
- ``R_t = sum_v o_v w_vt x_v (b_vt; 1)^T`` is linear in the target, which is read once.

Local points are ``b_vt = O_t Rot(B_t)^T (a_v - j_t)``: rest points about the joint, in axes aligned with the
world at T-pose, so that ``D_t`` is the joint's turn from the T-pose and no joint orient is left.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from soma_core.geometry.constants import constant
from soma_core.geometry.sparse import sparse_product
from soma_core.inversion.driven import DrivenRest
from soma_core.inversion.structure import MomentStructure
from soma_core.kernels.patches import in_patches
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

if TYPE_CHECKING:
    from soma_core.kernels.patch_moments_wp import MomentPatches

__all__ = ["RestMoments", "SkinMoments"]


@dataclass(frozen=True, kw_only=True, eq=False)
class RestMoments:
    """What a fit needs of an identity; batch i is 1, shared by all frames, or one a frame.

    Attributes:
        local: rest point of every influence about its joint, (i, e, 3) [m]; empty where only sums were made.
        weight: skin weight times vertex weight of every influence, (i, e); empty likewise.
        own: sums of weight times (local; 1)(local; 1)^T over each joint's influences, (i, T, 4, 4).
        second: ``N`` of every pair of joints that share vertices, (i, p, 4, 4).
        offsets: bone vectors in T-pose world axes, (i, J, 3) [m]; the Hips' entry is not used.
        driven: what joints that follow from the others are read with; None without such joints.
        bind: from the bind pose to each joint's own axes in the T-pose's world, (i, J, 3, 4): the turn, and
            in the last column the joint's place [m]; None where no model asks.
        memo: what was made of the rest, with what it was made of.
    """

    local: Tensor
    weight: Tensor
    own: Tensor
    second: Tensor
    offsets: Tensor
    driven: DrivenRest | None = None
    bind: Tensor | None = None
    memo: dict[object, tuple] = field(default_factory=dict, repr=False)

    @property
    def batch_size(self) -> int:
        """Number of identities."""
        return len(self.second)


class SkinMoments(torch.nn.Module):
    """Computes ``N`` and ``R`` on the influences of one rig. Sums run in float64, in fixed order.

    Args:
        structure: index lists of the rig.
        rig: for the T-pose orientation of each joint.
        dtype: of the results.
        warp: sum over vertices by the Warp twins, where no derivative is asked for.
    """

    def __init__(
        self,
        structure: MomentStructure,
        rig: Rig,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
        warp: bool = False,
    ) -> None:
        super().__init__()
        self.dtype, self.joint_count, self.warp = dtype, len(structure.joints), warp
        self.vertex_count = len(structure.fitted)
        self._patches: MomentPatches | None = None  # made when first asked for
        orient = rig.t_pose_world[structure.joints, :3, :3]

        keep = functools.partial(constant, device=device)
        self.joints = keep(structure.joints)
        self.orient = keep(orient)
        self.influence_joint = keep(structure.influence_joint)
        self.influence_vertex = keep(structure.influence_vertex)
        self.influence_weight = keep(structure.influence_weight)
        self.pair_influences = keep(structure.pair_influences)
        self.joint_start = keep(_starts(structure.influence_joint, len(structure.joints)))
        self.pair_start = keep(_starts(structure.pair_entry, len(structure.pairs)))
        self.pairs = keep(structure.pairs)
        if warp:
            from soma_core.kernels.skin_moments_wp import tile_runs

            starts = _starts(structure.influence_joint, len(structure.joints))
            for i, one in enumerate(tile_runs(starts, structure.influence_vertex)):
                setattr(self, f"tile_runs_{i}", keep(one))
        four = structure.influence_vertex[:, None].repeat(4, 1)
        spans = np.split(four, self.joint_start[1:-1].cpu().numpy())
        self.moment_col = keep(np.concatenate([span.T.ravel() for span in spans]))
        counts = np.diff(self.joint_start.cpu().numpy()).repeat(4)
        self.moment_crow = keep(np.concatenate([[0], np.cumsum(counts)]))
        source = np.split(np.arange(four.size).reshape(-1, 4), self.joint_start[1:-1].cpu().numpy())
        self.moment_order = keep(np.concatenate([span.T.ravel() for span in source]))

    def local_points(self, identity: Identity) -> Tensor:
        """Rest points of every influence about its joint, in T-pose world axes, (i, e, 3) [m], float64."""
        bind = identity.bind_world.double()[:, self.joints]
        turn = self.orient @ bind[..., :3, :3].transpose(-1, -2)
        step = identity.rest.double()[:, self.influence_vertex] - bind[:, self.influence_joint, :3, 3]
        return (turn[:, self.influence_joint] @ step[..., None]).squeeze(-1)

    def rest(self, identity: Identity, weights: Tensor, offsets: Tensor) -> RestMoments:
        """Moments of identities under vertex weights (1 or i, v); `offsets` as in :class:`RestMoments`."""
        vertex_weight = weights.double()[:, self.influence_vertex]
        batch = max(identity.batch_size, len(vertex_weight))
        vertex_weight = vertex_weight.expand(batch, -1)
        weight = vertex_weight * self.influence_weight
        if self.warp and batch == 1 and not _followed(identity.rest, identity.bind_world, weights):
            local, own, second = self._rest_by_warp(identity, weights)
            return RestMoments(
                local=local, weight=weight.to(self.dtype), own=own, second=second, offsets=offsets
            )
        local = self.local_points(identity).expand(batch, -1, 3)
        seconds, owns = [], []
        for points, weight_v, weight_vt in zip(local, vertex_weight, weight, strict=True):
            point = torch.cat((points, torch.ones_like(points[:, :1])), 1)
            seconds.append(self._second(point * self.influence_weight[:, None], weight_v))
            outer = point[:, :, None] * (point * weight_vt[:, None])[:, None]
            owns.append(_sum_rows(outer.flatten(1), self.joint_start).unflatten(1, (4, 4)))
        return RestMoments(
            local=local.to(self.dtype),
            weight=weight.to(self.dtype),
            own=torch.stack(owns).to(self.dtype),
            second=torch.stack(seconds).to(self.dtype),
            offsets=offsets,
        )

    def _rest_by_warp(self, identity: Identity, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Local points (1, e, 3), ``own`` and ``second`` of one identity."""
        from soma_core.kernels.rest_moments_wp import rest_moments

        bind = identity.bind_world[0, self.joints].double()
        found = rest_moments(
            (self.joint_start, self.influence_vertex, self.influence_weight.double()),
            (self.pair_start, self.pair_influences),
            self.orient @ bind[:, :3, :3].mT, bind[:, :3, 3], identity.rest[0].double(), weights[0].double(),
        )  # fmt: skip
        point, own, second = (one[None].to(self.dtype) for one in found)
        return point[..., :3], own, second

    def _second(self, point: Tensor, vertex_weight: Tensor) -> Tensor:
        """``N`` (p, 4, 4) of one identity from weighted points (e, 4)."""
        first, second = self.pair_influences.unbind(1)
        outer = point[first, :, None] * (point[second] * vertex_weight[first, None])[:, None]
        return _sum_rows(outer.flatten(1), self.pair_start).unflatten(1, (4, 4))

    def target(self, vertices: Tensor, rest: RestMoments) -> tuple[Tensor, Tensor]:
        """``R`` (F, T, 3, 4) of targets (F, v, 3) [m] about an origin of each frame (F, 3) [m].

        Vertices of zero weight must be finite. The origin keeps a body far from the world's origin as
        precise as one near it.
        """
        if self.warp and rest.batch_size == 1:
            constants = rest.weight[0], rest.local[0], rest.own[0, :, 3].contiguous()
            if in_patches(vertices):
                return self._target_by_patches(vertices, *constants)
            from soma_core.kernels.skin_moments_wp import target_moments

            runs = tuple(self.get_buffer(f"tile_runs_{i}") for i in range(4))
            return target_moments(self.joint_start, self.influence_vertex, runs, *constants, vertices)
        origin = vertices[:, self.influence_vertex[0]]
        near = vertices.double() - origin.double()[:, None]
        if rest.batch_size == 1:
            return self._one_target(near, rest, 0), origin
        frames = [self._one_target(near[f : f + 1], rest, f) for f in range(len(vertices))]
        return torch.cat(frames), origin

    def _target_by_patches(
        self, vertices: Tensor, weight: Tensor, local: Tensor, mean: Tensor
    ) -> tuple[Tensor, Tensor]:
        """``R`` and origins of one identity on a GPU."""
        from soma_core.kernels.patch_moments_wp import MomentPatches, moments_by_patches

        if self._patches is None:
            starts, ids = (one.cpu().numpy() for one in (self.joint_start, self.influence_vertex))
            self._patches = MomentPatches(starts, ids, device=vertices.device)
        return moments_by_patches(self._patches, weight, local, mean, vertices)

    def of_vectors(self, vectors: Tensor, rest: RestMoments) -> Tensor:
        """``sum o w r (b; 1)^T`` (F, T, 3, 4) of vectors r (F, v, 3) [m] at the vertices of one identity."""
        near, origin = self.target(vectors, rest)
        return near + origin[:, None, :, None] * rest.own[..., 3:, :]

    def each(
        self, vertices: Tensor, identity: Identity, weights: Tensor, offsets: Tensor
    ) -> tuple[RestMoments, Tensor, Tensor]:
        """Moments, ``R`` and origin of frames that each have an identity or vertex weights of their own.

        Args:
            vertices: targets (F, v, 3) [m].
            identity: batch of 1 or F.
            weights: (1 or F, v).
            offsets: (1 or F, J, 3), as in :class:`RestMoments`.
        """
        if not self.warp:
            rest = self.rest(identity, weights, offsets)
            return rest, *self.target(vertices, rest)
        from soma_core.kernels.frame_moments_wp import frame_moments

        first, second = self.pairs.unbind(1)
        bind = identity.bind_world[:, self.joints].expand(len(vertices), -1, 4, 4)
        centres = bind[..., :3, 3]
        turn = self.orient.to(self.dtype) @ bind[..., :3, :3].transpose(-1, -2)
        weight = self.influence_weight.to(self.dtype)
        a, b = self.pair_influences.unbind(1)
        pairs, own, target, origin = frame_moments(
            (self.joint_start, self.influence_vertex, weight),
            (self.pair_start, self.influence_vertex[a], weight[a] * weight[b], first),
            identity.rest, centres, weights, vertices,
        )  # fmt: skip
        shift = centres[:, first] - centres[:, second]
        empty = turn.new_empty(len(vertices), 0)
        rest = RestMoments(
            local=empty,
            weight=empty,
            own=_turned_moments(own, turn, turn, torch.zeros_like(centres)),
            second=_turned_moments(pairs, turn[:, first], turn[:, second], shift),
            offsets=offsets,
        )
        target = torch.cat((target[..., :3] @ turn.transpose(-1, -2), target[..., 3:]), -1)
        return rest, target, origin

    def _one_target(self, vertices: Tensor, rest: RestMoments, which: int) -> Tensor:
        """``R`` of frames that share identity number `which`."""
        local, weight = rest.local[which].double(), rest.weight[which].double()
        values = torch.cat((local, torch.ones_like(local[:, :1])), 1) * weight[:, None]
        pattern = self.moment_crow, self.moment_col, values.ravel()[self.moment_order]
        product = sparse_product(pattern, vertices.permute(1, 2, 0).flatten(1).contiguous())
        # Rows are (joint, 4), columns (3, frame).
        return product.view(self.joint_count, 4, 3, -1).permute(3, 0, 2, 1).to(self.dtype).contiguous()


def _turned_moments(sums: Tensor, left: Tensor, right: Tensor, shift: Tensor) -> Tensor:
    """``sum s (L d; 1)(R (d + h); 1)^T`` (..., 4, 4) from the ten sums of ``s (d; 1)(d; 1)^T``."""
    xx, xy, xz, yy, yz, zz, x, y, z, mass = sums.unbind(-1)
    spread = torch.stack((xx, xy, xz, xy, yy, yz, xz, yz, zz), -1).unflatten(-1, (3, 3))
    first = torch.stack((x, y, z), -1)
    other = first + mass[..., None] * shift
    block = left @ (spread + first[..., :, None] * shift[..., None, :]) @ right.transpose(-1, -2)
    column = (left @ first[..., None]).squeeze(-1)
    row = torch.cat(((right @ other[..., None]).squeeze(-1), mass[..., None]), -1)
    return torch.cat((torch.cat((block, column[..., None]), -1), row[..., None, :]), -2)


def _followed(*tensors: Tensor) -> bool:
    """Whether a derivative is asked for."""
    return torch.is_grad_enabled() and any(one.requires_grad for one in tensors)


def _sum_rows(rows: Tensor, starts: Tensor) -> Tensor:
    """Sums of consecutive rows, in fixed order."""
    index = torch.arange(len(rows), device=rows.device)
    return embedding_bag(index, rows, starts, mode="sum", include_last_offset=True)


def _starts(sorted_ids: np.ndarray, count: int) -> np.ndarray:
    """CSR row starts of ascending row ids."""
    return np.searchsorted(sorted_ids, np.arange(count + 1))
