"""Correspondence of a native topology with the canonical mesh, built once from a wrap pair (paper, 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from soma_core.cache import cached_arrays, content_key, file_sha256
from soma_core.errors import InputError
from soma_core.files import refuse_unreadable
from soma_core.geometry.barycentric import closest_point_on_triangle, tetrahedral_coordinates
from soma_core.obj import read_obj
from soma_core.plugin.spec import WrapPair
from soma_core.rig.mesh import CanonicalMesh
from soma_core.topology.closest import ClosestFaces
from soma_core.topology.wrap_pair import check_wrap

__all__ = ["Correspondence", "affine_matrix", "build_correspondence", "load_correspondence"]

_CODE_VERSION = "3"

_FAR = 0.02
"""Median distance, relative to the bounding diagonal, above which a pair cannot be meant."""

_OTHER_SIZE = 2.0
"""Ratio of the bounding diagonals above which a pair cannot be meant either."""

_DEGENERATE = 1e-10
"""Twice the area over squared edge length under which a face has no usable plane."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondence:
    """Where every canonical vertex lies on a native surface.

    Attributes:
        corners: native vertex ids of the tetrahedron's base, (v, 3) int64.
        coordinates: (v, 3) float64 tetrahedral coordinates (c1, c2, c3).
        native_count: number of native vertices.
        native_vertices: the pair's native mesh, (n, 3) float64, for statistics.
        native_triangles: (t, 3) int64.
        wrap_vertices: the pair's wrap, (v, 3) float64.
        distances: distance of each wrap vertex to the native surface, native unit, (v,).
        key: content key of pair and canonical mesh.
    """

    corners: np.ndarray
    coordinates: np.ndarray
    native_count: int
    native_vertices: np.ndarray
    native_triangles: np.ndarray
    wrap_vertices: np.ndarray
    distances: np.ndarray
    key: str

    def at(self, ids: np.ndarray) -> Correspondence:
        """The correspondence of a subset of canonical vertices, such as a lower LOD."""
        return Correspondence(
            corners=self.corners[ids],
            coordinates=self.coordinates[ids],
            native_count=self.native_count,
            native_vertices=self.native_vertices,
            native_triangles=self.native_triangles,
            wrap_vertices=self.wrap_vertices[ids],
            distances=self.distances[ids],
            key=f"{self.key}-{len(ids)}",
        )


def build_correspondence(
    native_vertices: np.ndarray, native_triangles: np.ndarray, wrap_vertices: np.ndarray, *, key: str = ""
) -> Correspondence:
    """Find the nearest face of each wrap vertex and its coordinates there, in float64.

    Ties go to the lowest face id; degenerate faces are no candidates. Refuses pairs that lie apart,
    naming the likely unit factor.

    Args:
        native_vertices: (n, 3) native mesh.
        native_triangles: (t, 3) integers.
        wrap_vertices: (v, 3) canonical vertices on the native surface, same unit and axes.
    """
    native, wrap = native_vertices.astype(np.float64), wrap_vertices.astype(np.float64)
    usable = _usable_faces(native, native_triangles)
    faces = native_triangles[usable].astype(np.int64)
    found = ClosestFaces(native, faces).query(wrap)
    corners = native[faces[found]]
    closest = closest_point_on_triangle(wrap, corners)
    distances = np.linalg.norm(wrap - closest, axis=1)
    _refuse_distant(native, wrap, distances)
    return Correspondence(
        corners=faces[found],
        coordinates=tetrahedral_coordinates(wrap, corners),
        native_count=len(native),
        native_vertices=native,
        native_triangles=native_triangles.astype(np.int64),
        wrap_vertices=wrap,
        distances=distances,
        key=key,
    )


def _usable_faces(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corners = vertices[triangles]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    lengths = [np.linalg.norm(edge, axis=1) for edge in (first, second, second - first)]
    area = np.linalg.norm(np.cross(first, second), axis=1)
    usable = np.flatnonzero(area > _DEGENERATE * (sum(lengths) / 3) ** 2)
    if not len(usable):
        raise InputError(
            "wrap.native",
            got=f"{len(triangles)} faces, all degenerate",
            expected="a surface with at least one face of positive area",
            fix="Export the native mesh again with its faces.",
        )
    return usable


def _refuse_distant(native: np.ndarray, wrap: np.ndarray, distances: np.ndarray) -> None:
    diagonal = float(np.linalg.norm(np.ptp(native, axis=0)))
    median = float(np.median(distances))
    ratio = diagonal / max(float(np.linalg.norm(np.ptp(wrap, axis=0))), 1e-300)
    # A wrap shrunk a hundred times lies near the surface as well where the origin does, at the feet.
    if median <= _FAR * diagonal and 1 / _OTHER_SIZE < ratio < _OTHER_SIZE:
        return
    factor = min((100.0, 10.0, 0.1, 0.01, 1000.0, 0.001), key=lambda f: abs(np.log(ratio / f)))
    scaled = abs(np.log(ratio / factor)) < 0.4
    cause = f"Scale the wrap by {factor:g}: the two files are in different units." if scaled else (
        "Bring both files into the same axes and pose."
    )  # fmt: skip
    raise InputError(
        "wrap",
        got=f"a median distance of {median / diagonal:.1%} of the body's diagonal to the native surface, "
        f"and {1 / ratio:.3g} times its size",
        expected=f"at most {_FAR:.0%}, and about the same size",
        fix=cause,
    )


def load_correspondence(pair: WrapPair, mesh: CanonicalMesh) -> Correspondence:
    """Correspondence of an OBJ pair with the mid-LOD canonical mesh, from the cache when it was built before.

    The cache key covers both files' bytes, the rig revision and this code's version.

    Raises:
        AssetError: a file is missing or no mesh.
        InputError: the wrap is not the canonical mesh, or the two files lie apart.
    """
    for path in (pair.native, pair.wrap):
        refuse_unreadable(path, fix="Reinstall the backend or name another file.")
    key = content_key(
        "correspondence", _CODE_VERSION, file_sha256(pair.native), file_sha256(pair.wrap), mesh.revision
    )

    def build() -> dict[str, np.ndarray]:
        native, triangles = read_obj(pair.native)
        wrap, wrap_triangles = read_obj(pair.wrap)
        check_wrap(wrap, wrap_triangles, mesh, path=pair.wrap)
        made = build_correspondence(native, triangles, wrap)
        return {
            "corners": made.corners.astype(np.int32),
            "coordinates": made.coordinates,
            "native_vertices": native,
            "native_triangles": triangles.astype(np.int32),
            "wrap_vertices": wrap,
            "distances": made.distances,
        }

    arrays = cached_arrays("correspondence", key, build)
    return Correspondence(
        corners=arrays["corners"].astype(np.int64),
        coordinates=arrays["coordinates"],
        native_count=len(arrays["native_vertices"]),
        native_vertices=arrays["native_vertices"],
        native_triangles=arrays["native_triangles"].astype(np.int64),
        wrap_vertices=arrays["wrap_vertices"],
        distances=arrays["distances"],
        key=key,
    )


def affine_matrix(correspondence: Correspondence) -> scipy.sparse.csr_array:
    """Matrix (v, n) of the in-plane part: weights (1 - c1 - c2, c1, c2) of the three corners."""
    c1, c2 = correspondence.coordinates[:, 0], correspondence.coordinates[:, 1]
    values = np.stack([1 - c1 - c2, c1, c2], 1)
    count = len(values)
    rows = np.repeat(np.arange(count), 3)
    return scipy.sparse.csr_array(
        (values.ravel(), (rows, correspondence.corners.ravel())), shape=(count, correspondence.native_count)
    )
