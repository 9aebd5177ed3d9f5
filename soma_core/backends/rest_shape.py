"""From parameters to a canonical rest shape and its fitted skeleton, (paper, 3.2 to 3.4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import TypeAlias

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.backends.parameters import batch_parameters
from soma_core.geometry.constants import constant
from soma_core.geometry.torch_func import exporting, untracked
from soma_core.plugin.errors import PluginError, Stage
from soma_core.plugin.spec import BackendSpec, Generator, HasLinearBasis, LinearBasis
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.fit import SkeletonFit
from soma_core.topology.compose import compose
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.lod_transfer import LodTransfer
from soma_core.topology.transfer import CanonicalPassThrough, TopologyTransfer, make_transfer

__all__ = ["ComposedRestShape", "ExactRestShape", "Isolation", "make_rest_shape"]

Isolation: TypeAlias = Callable[[Stage], AbstractContextManager[None]]
"""Makes whatever goes wrong inside an error of the backend; see ``Registry.isolated``."""


class ExactRestShape(torch.nn.Module):
    """Generator, transfer and skeleton fit one after the other, on every vertex.

    With `reduction` the vertices that come out are those of its target; the skeleton is fitted before it.
    """

    def __init__(
        self,
        generator: Generator,
        transfer: TopologyTransfer | CanonicalPassThrough,
        fit: SkeletonFit,
        isolated: Isolation,
        reduction: LodTransfer | None = None,
    ) -> None:
        super().__init__()
        self.generator, self.transfer, self.fit, self._isolated = generator, transfer, fit, isolated
        self.reduction = reduction

    def forward(self, params: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Vertices as planes (3, v, B) [m] and fitted transforms (B, J, 4, 4) [m]."""
        vertices = self.transfer(self._native(params))
        points = vertices if self.reduction is None else self.reduction(vertices)
        return points.permute(2, 1, 0), self.fit(vertices)

    def _native(self, params: Mapping[str, Tensor]) -> Tensor:
        if torch.compiler.is_compiling():  # a context around the plugin would break the graph
            return self.generator.rest(params)
        with self._isolated("rest"):
            native = self.generator.rest(params)
            if not isinstance(native, Tensor):
                cause = f"rest returned {type(native).__name__}, expected a tensor (batch, n, 3)"
                raise PluginError(cause, fix="Return the vertices")
        with self._isolated("wrap"):
            self.transfer.check(tuple(native.shape))
        return native


_PIECES = (12, 6, 3, 1)
"""Parts of a basis that each take a thread; three times as many numbers as points leave no rest."""

_SUMMED = 32
"""Directions of a basis that are added up in one run where the product is another engine's."""


class ComposedRestShape(torch.nn.Module):
    """A linear backend as one matrix: vertices and skeleton moments from coefficients in one product.

    Joint positions and covariances are linear in the vertices and so in the coefficients; their rows are
    stacked under those of the vertices. With `reduction` only the vertices that it needs are evaluated.
    """

    def __init__(
        self,
        linear: LinearBasis,
        transfer: TopologyTransfer | CanonicalPassThrough,
        fit: SkeletonFit,
        at: Tensor,
        isolated: Isolation,
        reduction: LodTransfer | None = None,
    ) -> None:
        super().__init__()
        self._linear_coefficients, self.fit, self._isolated = linear.coefficients, fit, isolated
        self.reduction = reduction
        composed = compose(linear, transfer, at)
        matrix, count = fit.matrix, len(composed.template) // 3
        kept = torch.arange(count, device=at.device) if reduction is None else reduction.source_ids
        self.vertex_count = len(kept)
        self.template = constant(_stack(matrix, composed.template[:, None], kept), device=at.device)
        self.basis = constant(_stack(matrix, composed.basis, kept), device=at.device)
        self.exact = composed.exact
        if self.exact is not None:
            place = torch.full((count,), self.vertex_count, device=at.device)
            place[kept] = torch.arange(self.vertex_count, device=at.device)
            place = place[self.exact.rows]
            chosen = torch.nonzero(place < self.vertex_count).squeeze(1)
            self.offset_chosen = constant(chosen, device=at.device)
            self.offset_place = constant(place[chosen], device=at.device)
            columns = matrix.tocsc()[:, self.exact.rows.cpu().numpy()].toarray()
            self.offset_moments = constant(columns, device=at.device, dtype=self.basis.dtype)

    def forward(self, params: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Vertices as planes (3, v, B) [m] and fitted transforms (B, J, 4, 4) [m]."""
        coefficients = self.coefficients(params)
        rows, many = coefficients, len(self.basis)
        if exporting():  # engines add up in one run, which rounds three times as much
            pairs = zip(self.basis.T.split(_SUMMED), rows.split(_SUMMED, 1), strict=True)
            stacked = (self.template.T + sum(column @ part for part, column in pairs)).T
        elif rows.device.type != "cpu":  # a body's numbers lie together, as the kernels that follow read them
            stacked = torch.addmm(self.template.flatten(), rows, self.basis.T).T
        elif rows.shape[0] == 1:  # of one column MKL makes pieces four times as fast as the whole
            parts = next(count for count in _PIECES if many % count == 0)
            basis, column = self.basis.view(parts, -1, rows.shape[1]), rows.T.expand(parts, -1, 1)
            stacked = torch.baddbmm(self.template.view(parts, -1, 1), basis, column).view(many, 1)
        else:
            stacked = torch.addmm(self.template, self.basis, rows.T)
        size = 3 * self.vertex_count
        points, moments = stacked[:size].unflatten(0, (3, self.vertex_count)), stacked[size:]
        offsets = None
        if self.exact is not None:
            offsets = self.exact.evaluate(coefficients)
            inplace = points.device.type != "cpu" and untracked(
                points, offsets
            )  # spares a copy of all bodies
            add = points.index_add_ if inplace else points.index_add
            points = add(1, self.offset_place, offsets[self.offset_chosen].transpose(0, 1))
        if self.reduction is not None:
            points = self.reduction.from_needed(points.permute(2, 1, 0)).permute(2, 1, 0)
        return points, self._fitted(moments, offsets)

    def some(self, params: Mapping[str, Tensor], ids: Tensor) -> tuple[Tensor, Tensor]:
        """The same for some vertices, as planes (3, u, B), at the cost of these and of the skeleton."""
        if self.reduction is not None and len(ids):
            points, fitted = self(params)
            return points[:, ids], fitted
        coefficients, size = self.coefficients(params), 3 * self.vertex_count
        rows = torch.cat([ids + axis * self.vertex_count for axis in range(3)])
        planes = torch.addmm(self.template[rows], self.basis[rows], coefficients.T)
        planes = planes.unflatten(0, (3, len(ids)))
        moments = torch.addmm(self.template[size:], self.basis[size:], coefficients.T)
        offsets = None if self.exact is None else self.exact.evaluate(coefficients)
        if offsets is not None and len(ids):
            place = ids.new_full((self.vertex_count,), -1)
            place[self.offset_place] = self.offset_chosen
            moved = torch.nonzero(place[ids] >= 0).squeeze(1)
            planes = planes.index_add(1, moved, offsets[place[ids[moved]]].transpose(0, 1))
        return planes, self._fitted(moments, offsets)

    def _fitted(self, moments: Tensor, offsets: Tensor | None) -> Tensor:
        """Transforms (B, J, 4, 4) from moments (12 J, B) of the linear part, and offsets (e, 3, B)."""
        moments = moments.unflatten(0, (4 * self.fit.joint_count, 3))
        if offsets is not None:
            moments = moments + (self.offset_moments @ offsets.flatten(1)).view(*moments.shape)
        return self.fit.from_moments(moments.unflatten(0, (self.fit.joint_count, 4)).permute(3, 0, 1, 2))

    def coefficients(self, params: Mapping[str, Tensor]) -> Tensor:
        """What the plugin makes of the parameters, (B, k)."""
        if torch.compiler.is_compiling():
            return self._linear_coefficients(params)
        with self._isolated("rest"):
            return self._linear_coefficients(params)


def _stack(matrix: scipy.sparse.csr_array, vertex_major: Tensor, kept: Tensor) -> Tensor:
    """Columns (v * 3, k) as planes (3 * len(kept), k), with the moments (m * 3, k) of all underneath."""
    count, columns = vertex_major.shape[0] // 3, vertex_major.shape[1]
    planes = vertex_major.view(count, 3, columns)[kept].transpose(0, 1).reshape(3 * len(kept), columns)
    return torch.cat((planes, _apply_rows(matrix, vertex_major)))


def _apply_rows(matrix: scipy.sparse.csr_array, flat: Tensor) -> Tensor:
    """(m, v) sparse times (v * 3, k) vertex-major columns -> (m * 3, k), in float64."""
    count, columns = flat.shape[0] // 3, flat.shape[1]
    parts = []
    for start in range(0, columns, 32):
        block = flat[:, start : start + 32].double().cpu().numpy().reshape(count, -1)
        parts.append((matrix @ block).reshape(matrix.shape[0] * 3, -1))
    parts = parts or [np.empty((matrix.shape[0] * 3, 0))]
    return torch.as_tensor(np.hstack(parts), dtype=flat.dtype, device=flat.device)


def make_rest_shape(
    spec: BackendSpec,
    generator: Generator,
    mesh: CanonicalMesh,
    rig: Rig,
    *,
    dtype: torch.dtype,
    device: torch.device,
    exact: bool,
    warp: bool,
    wrap_mesh: CanonicalMesh,
    isolated: Isolation,
    reduction: LodTransfer | None = None,
) -> ExactRestShape | ComposedRestShape:
    """The rest-shape module of a backend: composed when it is linear, unless `exact` asks otherwise.

    `mesh` and `rig` are those that the skeleton is fitted on; `reduction` leads from there to another LOD.
    `warp` chooses the Warp twin for the skeleton's rotations. `wrap_mesh` is the mid LOD, which wrap
    pairs are made for. What the wrap pair or the plugin's own code does wrong goes through `isolated`.

    Raises:
        BackendError: stage ``wrap``: the pair is unusable or is not the generator's mesh; stage ``build``:
            the linear basis cannot be had.
    """
    fit = SkeletonFit(mesh, rig, dtype=dtype, device=device, warp=warp)
    with isolated("wrap"):
        correspondence = None if spec.wrap is None else load_correspondence(spec.wrap, wrap_mesh)
        transfer = make_transfer(spec, mesh, correspondence, dtype=dtype, device=device)
    if exact or not isinstance(generator, HasLinearBasis):
        return ExactRestShape(generator, transfer, fit, isolated, reduction)
    with isolated("build"):
        linear = generator.linear_basis()
        with torch.no_grad():
            at = linear.coefficients(batch_parameters(spec, {}, device=device, dtype=dtype))[0]
    with isolated("wrap"):
        return ComposedRestShape(linear, transfer, fit, at, isolated, reduction)
