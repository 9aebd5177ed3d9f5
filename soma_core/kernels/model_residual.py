"""The whole forward model against targets: energy, and its slope in transforms and activations.

A vertex v of frame f rests at ``x = rest + s sum_c V_c a_c``, is skinned to ``y = sum_t w_t (D_t x + c_t)``
and misses its target by ``r``. With vertex weights o and shares ``k = min(1, bound / |r|)``,

- the energy is ``sum_v o |r|^2``, beyond the bound ``o (2 bound |r| - bound^2)``;
- half its slope is ``sum_v o k w_t r (x; 1)^T`` in ``[D_t | c_t]``, called forces, and
  ``s sum_v o k V_c . A^T r`` in ``a_c``, called pull, with ``A = sum_t w_t D_t``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.geometry.sparse import Csr, SparseRows, sparse_product
from soma_core.kernels.patches import in_patches
from soma_core.kernels.residual_patches import ResidualPatches

__all__ = ["ModelResidual", "Residual"]

_FRAMES = 32
"""Frames that the reference treats at a time, so that they stay in cache."""


class Residual(NamedTuple):
    """What a pose leaves of F frames.

    Attributes:
        energy: (F,) [m^2].
        forces: half the energy's slope in the transforms, (F, T, 3, 4); None where not asked for.
        pull: half its slope in the activations, (F, C); None likewise, and without correctives.
        distances: (F, v) [m], of vertices without weight too; None where not asked for.
    """

    energy: Tensor
    forces: Tensor | None
    pull: Tensor | None
    distances: Tensor | None


class ModelResidual(torch.nn.Module):
    """Evaluates the forward model of one rig and mesh against targets; no derivative runs through it.

    A frame's numbers depend neither on the frames beside it nor on the number of threads.

    Args:
        weights: skin weights (v, T).
        correctives: offsets of vertices by activations (3 v, C), the three rows of a vertex together; None
            for plain skinning.
        warp: run the Warp twin.
    """

    def __init__(
        self,
        weights: Csr,
        correctives: SparseRows | None = None,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
        warp: bool = False,
    ) -> None:
        super().__init__()
        self.warp, self.dtype = warp, dtype
        start, joint, value = (part.cpu().numpy() for part in weights)
        vertices = len(start) - 1
        joints = int(joint.max(initial=-1)) + 1
        skin = scipy.sparse.csr_array((value.astype(np.float64), joint, start), shape=(vertices, joints))
        moves = scipy.sparse.csr_array((3 * vertices, 0))
        if correctives is not None:
            moves = correctives.scipy()
        self.vertex_count, self.activation_count, self.joint_count = vertices, moves.shape[1], joints
        self._matrices = skin, moves
        self._patches: ResidualPatches | None = None  # made when first asked for
        if warp:
            from soma_core.kernels.model_residual_wp import residual_tables

            tables = residual_tables(skin, moves)
            self._names = list(tables)
            for name, table in tables.items():
                tensor = torch.as_tensor(table, device=device)
                tensor = tensor.to(dtype) if tensor.is_floating_point() else tensor
                self.register_buffer(name, tensor, persistent=False)
        else:
            self.skin = SparseRows(skin, dtype=dtype, device=device)
            self.moves = SparseRows(moves, dtype=dtype, device=device)

    def forward(
        self,
        rest: Tensor,
        weights: Tensor,
        transforms: Tensor,
        activations: Tensor | None,
        scale: Tensor | None,
        targets: Tensor,
        origin: Tensor,
        bound: Tensor | None = None,
        *,
        gradient: bool = True,
        distances: bool = False,
    ) -> Residual:
        """Compare F poses with targets.

        Args:
            rest: (1 or F, v, 3) [m].
            weights: of vertices, (1 or F, v); where zero, a target may be NaN or infinite.
            transforms: ``G B^-1`` of the joints about the frames' origins, (F, T, 3, 4) [m].
            activations: (F, C); None without correctives.
            scale: size of each frame's offsets, (F,); None without correctives.
            targets: (F, v, 3) [m].
            origin: (F, 3) [m].
            bound: residuals beyond it count linearly, (F,) [m], above zero; None counts all squared.
            gradient: return forces and pull.
            distances: return distances.
        """
        if activations is None or scale is None:
            assert self.activation_count == 0, self.activation_count
            activations, scale = targets.new_empty(len(targets), 0), targets.new_ones(len(targets))
        count, vertices = targets.shape[:2]
        assert activations.shape == (count, self.activation_count), activations.shape
        assert transforms.shape[1] >= self.joint_count, transforms.shape
        assert rest.shape[1:] == (vertices, 3) == (self.vertex_count, 3), rest.shape
        sizes = {"transforms": len(transforms), "scale": len(scale), "origin": len(origin)}
        assert set(sizes.values()) == {count}, sizes
        assert {len(rest), len(weights)} <= {1, count}, (len(rest), len(weights))
        given = rest, weights, transforms, activations, scale, targets, origin, bound
        assert {one.dtype for one in given if one is not None} == {self.dtype}, self.dtype
        if self.warp:
            found = self._by_warp(given, gradient=gradient, distances=distances)
        else:
            found = self._by_torch(*given)
        energy, forces, pull, lengths = found
        return Residual(
            energy=energy,
            forces=forces if gradient else None,
            pull=pull if gradient and self.activation_count else None,
            distances=lengths if distances else None,
        )

    def _by_warp(self, given, *, gradient: bool, distances: bool):
        """Energy, forces, pull and distances of all frames, by the kernels that suit the device."""
        targets = given[5]
        if in_patches(targets):
            from soma_core.kernels.patch_residual_wp import residual_by_patches

            if self._patches is None:
                self._patches = ResidualPatches(*self._matrices, dtype=self.dtype, device=targets.device)
            if self._patches.fits:
                return residual_by_patches(self._patches, *given, gradient=gradient, distances=distances)
        from soma_core.kernels.model_residual_wp import residual_sums

        return residual_sums(self.tables, *given, gradient=gradient, distances=distances)

    @property
    def tables(self) -> dict[str, Tensor]:
        """Constants of the Warp twin on a CPU."""
        return {name: self.get_buffer(name) for name in self._names}

    def _by_torch(self, rest, weights, transforms, activations, scale, targets, origin, bound):
        """Energy, forces, pull and distances of all frames."""
        parts = []
        for chunk in torch.arange(len(targets), device=targets.device).split(_FRAMES):
            own = [one if len(one) == 1 else one[chunk] for one in (rest, weights)]
            limit = None if bound is None else bound[chunk]
            frames = (one[chunk] for one in (transforms, activations, scale, targets, origin))
            parts.append(self._few(*own, *frames, limit))
        return [torch.cat(part) for part in zip(*parts, strict=True)]

    def _few(self, rest, weights, transforms, activations, scale, targets, origin, bound):
        """The same of a few frames, in memory (..., F)."""
        count, vertices, joints = len(targets), rest.shape[1], transforms.shape[1]
        moved = sparse_product(self.moves.csr, activations.T.contiguous()).view(vertices, 3, count)
        points = rest.permute(2, 1, 0) + scale * moved.transpose(0, 1)  # (3, v, F)
        one = torch.ones_like(points[:1])
        flat = transforms.permute(1, 2, 3, 0)[: self.skin.shape[1]].flatten(1).contiguous()
        blend = sparse_product(self.skin.csr, flat).view(vertices, 3, 4, count)
        posed = (blend * torch.cat((points, one)).transpose(0, 1)[:, None]).sum(2)  # (v, 3, F)
        step = posed - (targets - origin[:, None]).permute(1, 2, 0)
        distances = step.norm(dim=1)
        share = weights.T.expand(vertices, count)
        step = torch.where((share > 0)[:, None], step, torch.zeros_like(step))
        far = step.norm(dim=1)
        near = far if bound is None else torch.minimum(far, bound)
        energy = (share * near * (2 * far - near)).sum(0)
        if bound is not None:
            share = share * bound / torch.maximum(far, bound)
        force = share[:, None] * step
        outer = force[:, :, None] * torch.cat((points, one)).transpose(0, 1)[:, None]
        forces = outer.new_zeros(joints, 12 * count)
        forces[: self.skin.shape[1]] = sparse_product(self.skin.transpose, outer.flatten(1))
        back = (blend[:, :, :3] * force[:, :, None]).sum(1) * scale  # (v, 3, F)
        pull = sparse_product(self.moves.transpose, back.flatten(0, 1))
        return energy, forces.view(joints, 3, 4, count).permute(3, 0, 1, 2), pull.T, distances.T
