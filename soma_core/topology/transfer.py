"""Native rest vertices to the canonical mesh: the exact path (paper, section 3.3, equation 1)."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.geometry.barycentric import raised_normal
from soma_core.geometry.constants import constant
from soma_core.geometry.sparse import SparseRows
from soma_core.plugin.spec import BackendSpec
from soma_core.rig.mesh import CanonicalMesh
from soma_core.topology.correspondence import Correspondence, affine_matrix
from soma_core.topology.fill import FillOperator, build_fill
from soma_core.topology.frames import METRES, native_to_canonical

__all__ = ["CanonicalPassThrough", "TopologyTransfer", "filled_vertices", "make_transfer"]


def filled_vertices(spec: BackendSpec, mesh: CanonicalMesh) -> np.ndarray:
    """Sorted ids of the vertices that the backend declares as having no counterpart."""
    unknown = sorted(set(spec.fill_segments) - set(mesh.segments))
    if unknown:
        raise InputError(
            "fill_segments",
            got=", ".join(unknown),
            expected="names among " + ", ".join(sorted(mesh.segments)),
            fix=f"Correct the declaration of backend {spec.name!r}.",
        )
    parts = [mesh.segments[name] for name in spec.fill_segments]
    return np.unique(np.concatenate(parts)).astype(np.int64) if parts else np.empty(0, np.int64)


class TopologyTransfer(torch.nn.Module):
    """Gathers native vertices into canonical order, fills what is uncovered, converts axes and unit.

    Commutes with every similarity of the native mesh. Cost does not depend on the native vertex count.

    Args:
        correspondence: of this LOD.
        spec: the backend's unit, axes and segments to fill.
        mesh: canonical mesh at the same LOD.
    """

    def __init__(
        self,
        correspondence: Correspondence,
        spec: BackendSpec,
        mesh: CanonicalMesh,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        self.native_count = correspondence.native_count
        self.affine = SparseRows(affine_matrix(correspondence), dtype=dtype, device=device)
        regions = build_fill(
            correspondence.wrap_vertices, mesh.triangles, filled_vertices(spec, mesh), lod=mesh.lod
        )
        self.fill = FillOperator(regions, dtype=dtype, device=device)
        frame = METRES[spec.unit] * native_to_canonical(spec.up, spec.forward)

        keep = functools.partial(constant, device=device, dtype=dtype)
        self.corners = keep(correspondence.corners)
        self.height = keep(correspondence.coordinates[:, 2])
        self.frame = keep(frame)

    def forward(self, native: Tensor) -> Tensor:
        """Canonical rest vertices (B, v, 3) [m] from native vertices (B, n, 3). Differentiable."""
        self.check(native.shape)
        batch, count = native.shape[0], len(self.corners)
        flat = native.permute(1, 2, 0).reshape(self.native_count, 3 * batch)
        plane = self.affine(flat).view(count, 3, batch)
        raised = self.height[:, None] * raised_normal(native[:, self.corners])
        points = self.fill((plane + raised.permute(1, 2, 0)).reshape(count, 3 * batch))
        return self.to_canonical(points.view(count, 3, batch)).permute(2, 0, 1)

    def check(self, shape: tuple[int, ...]) -> None:
        """Refuse native vertices that are not those of the wrap pair."""
        if len(shape) != 3 or tuple(shape[1:]) != (self.native_count, 3):
            raise InputError(
                "native vertices",
                got=tuple(shape),
                expected=f"(batch, {self.native_count}, 3), as in the wrap pair",
                fix="The generator and its wrap pair must describe the same mesh.",
            )

    def to_canonical(self, points: Tensor) -> Tensor:
        """Change axes and unit of (v, 3, f) native vectors."""
        return torch.einsum("ac,vcf->vaf", self.frame, points)


class CanonicalPassThrough(torch.nn.Module):
    """The transfer of a backend whose native topology is the canonical one: a change of unit and axes."""

    def __init__(
        self, spec: BackendSpec, mesh: CanonicalMesh, *, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        super().__init__()
        self.least_count, self.is_mid = int(mesh.mid_ids.max()) + 1, mesh.lod == "mid"
        frame = METRES[spec.unit] * native_to_canonical(spec.up, spec.forward)
        self.frame = constant(frame, device=device, dtype=dtype)
        self.mid_ids = constant(mesh.mid_ids, device=device, dtype=dtype)

    def forward(self, native: Tensor) -> Tensor:
        """Canonical rest vertices (B, v, 3) [m] from mid-LOD native vertices (B, n, 3)."""
        self.check(native.shape)
        return native[:, self.mid_ids] @ self.frame.T

    def check(self, shape: tuple[int, ...]) -> None:
        """Refuse native vertices that are not canonical; a lower LOD only knows their least count."""
        fits = len(shape) == 3 and shape[2] == 3 and shape[1] >= self.least_count
        if not fits or (self.is_mid and shape[1] != self.least_count):
            more = "" if self.is_mid else " or more"
            raise InputError(
                "native vertices",
                got=tuple(shape),
                expected=f"(batch, {self.least_count}{more}, 3), the canonical mesh",
                fix="Declare a wrap pair, or generate vertices in canonical order.",
            )


def make_transfer(
    spec: BackendSpec,
    mesh: CanonicalMesh,
    correspondence: Correspondence | None,
    *,
    dtype: torch.dtype,
    device: torch.device | str,
) -> TopologyTransfer | CanonicalPassThrough:
    """The transfer that a backend's declaration calls for, at the mesh's LOD.

    Raises:
        InputError: the extra-low LOD, whose vertices are none of the wrap's.
    """
    if mesh.lod == "xlo":
        raise InputError(
            "lod",
            got="'xlo'",
            expected="'mid' or 'low' for vertices of a native topology",
            fix="Take lod='low'; LodTransfer leads from there to xlo.",
        )
    if correspondence is None:
        return CanonicalPassThrough(spec, mesh, dtype=dtype, device=device)
    local = correspondence.at(mesh.mid_ids) if mesh.lod != "mid" else correspondence
    return TopologyTransfer(local, spec, mesh, dtype=dtype, device=device)
