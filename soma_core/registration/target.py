"""A native mesh made ready: checked, its skin apart from eyeballs and tongue, unit and axes found."""

from __future__ import annotations

import functools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from soma_core.errors import InputError
from soma_core.geometry.mesh import enclosed_volume, triangle_sides
from soma_core.plugin.spec import Axis, Unit
from soma_core.registration.surface import Surface
from soma_core.topology.frames import METRES, METRIC, native_to_canonical

_log = logging.getLogger(__name__)

__all__ = ["Frame", "Skin", "find_skin", "find_unit"]

_STATURES = (0.4, 2.6)
"""Bodies [m] that a mesh may show: less than a factor of ten, so only one unit can fit."""

_LEAST_VERTICES = 500
_LARGEST_PART = 0.2
"""Area of a second component, as a share of the first, from which it is no eyeball or tongue."""

_OPEN = 0.02
"""Share of the edges that may lie on a border: cut wrists and eye sockets, not half a scan."""

_MOST_FACES = 50_000
"""Faces that a fit looks at; the wrap is laid on all of them."""

_WORTH = 0.7
"""Share of the faces from which on taking fewer is not worth it."""

_FEW = 10
"""Edges of the same kind that are no matter in a mesh of few faces: what decimates leaves some."""

_TWISTED = 0.001
"""Share of the edges that may belong to three faces or be run through twice in one direction."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Unit and axes of a native mesh.

    Attributes:
        unit, up, forward: as in a backend's declaration.
        centre: native point (3,) that becomes the origin.
    """

    unit: Unit
    up: Axis
    forward: Axis
    centre: tuple[float, float, float]

    @property
    def _turn(self) -> np.ndarray:
        return native_to_canonical(self.up, self.forward)

    def to_canonical(self, points: np.ndarray) -> np.ndarray:
        """Native points (n, 3) in metres, +Y up, +Z forward, around the origin."""
        return METRES[self.unit] * (points - np.array(self.centre)) @ self._turn.T

    def to_native(self, points: np.ndarray) -> np.ndarray:
        """The way back."""
        return points / METRES[self.unit] @ self._turn + np.array(self.centre)


@dataclass(frozen=True, kw_only=True, eq=False)
class Skin:
    """The part of a mesh that the body's skin is laid on.

    Attributes:
        vertices: (n, 3) native.
        triangles: (t, 3), seen counter-clockwise from outside.
        notes: what was left out or turned, for people.
        masked: whether a user named vertices that are no skin.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    notes: tuple[str, ...] = ()
    masked: bool = False

    @functools.cached_property
    def rim(self) -> np.ndarray:
        """(n,) whether a vertex lies on the rim of a hole, of a scan or of what was masked."""
        _, place = np.unique(self.vertices, axis=0, return_inverse=True)
        place = place.ravel()  # seams of a texture are no rims
        ends = np.sort(place[triangle_sides(self.triangles)], 1)
        keys, uses = np.unique(ends @ [len(place), 1], return_counts=True)
        rim = np.unique(np.stack(np.divmod(keys[uses == 1], len(place))))
        return np.isin(place, rim)

    def lighter(self) -> Skin:
        """The same skin with few enough faces to be fitted to; itself where it has no more."""
        share = _MOST_FACES / len(self.triangles)
        if share > _WORTH:
            return self
        try:
            import pyvista
        except ImportError:
            _log.info(
                "%d faces are fitted as they are, which takes longer; with pyvista, fewer would be",
                len(self.triangles),
            )
            return self
        faces = np.insert(self.triangles, 0, 3, axis=1).ravel()
        fewer = pyvista.PolyData(self.vertices, faces).decimate(1 - share)
        triangles = fewer.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
        return Skin(vertices=np.asarray(fewer.points, np.float64), triangles=triangles)

    def surface(self, frame: Frame) -> Surface:
        """The skin in metres, +Y up, +Z forward."""
        return Surface(frame.to_canonical(self.vertices), self.triangles, self.rim)


def find_skin(vertices: np.ndarray, triangles: np.ndarray, *, masked: Sequence[int] | None = None) -> Skin:
    """Check a mesh and take its skin: the largest connected part, less the masked vertices.

    Args:
        vertices: (n, 3) native.
        triangles: (t, 3).
        masked: ids of native vertices that are no skin, such as clothes.

    Raises:
        InputError: empty, not finite, indices out of range, no area, several bodies, torn open, or with
            faces that do not form a surface.
    """
    _check_arrays(vertices, triangles)
    notes = []
    kept = np.ones(len(vertices), bool)
    if masked is not None and len(masked):
        kept[_checked_mask(masked, len(vertices))] = False
        notes.append(f"{len(vertices) - kept.sum()} masked vertices left out")
    faces = triangles[kept[triangles].all(1)]
    faces = faces[_areas(vertices, faces) > 0]
    part, others = _largest_part(vertices, faces)
    if others:
        notes.append(f"{len(others)} smaller parts of {', '.join(map(str, others))} vertices left out")
    _check_surface(part, allow_open=not kept.all())
    used = np.unique(part)
    if len(used) < _LEAST_VERTICES:
        raise _refusal(f"{len(used)} vertices", f"a body of at least {_LEAST_VERTICES}", "Give a finer mesh.")
    place = np.full(len(vertices), -1)
    place[used] = np.arange(len(used))
    points, part = vertices[used].astype(np.float64), place[part]
    if enclosed_volume(points - points.mean(0), part) < 0:
        part = part[:, ::-1].copy()
        notes.append("faces point inwards; turned")
    skin = Skin(vertices=points, triangles=part, notes=tuple(notes), masked=not kept.all())
    if skin.rim.any() and not skin.masked:
        skin = replace(skin, notes=(*notes, "has holes; skin is drawn over them"))
    return skin


def _refusal(got: object, expected: object, fix: str) -> InputError:
    return InputError("native mesh", got=got, expected=expected, fix=fix)


def _check_arrays(vertices: np.ndarray, triangles: np.ndarray) -> None:
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or triangles.ndim != 2 or triangles.shape[1:] != (3,):
        raise _refusal(
            f"arrays of shape {vertices.shape} and {triangles.shape}",
            "vertices (n, 3) and triangles (t, 3)",
            "Pass a triangle mesh.",
        )
    if not len(vertices) or not len(triangles):
        raise _refusal(
            f"{len(vertices)} vertices and {len(triangles)} faces",
            "a body",
            "Export the mesh with its faces.",
        )
    finite = np.isfinite(vertices).all(1)
    if not finite.all():
        first = int(np.flatnonzero(~finite)[0])
        raise _refusal(f"vertex {first} = {vertices[first]}", "finite numbers", "Export the mesh again.")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        strange = triangles.max() if triangles.max() >= len(vertices) else triangles.min()
        raise _refusal(
            f"a face with vertex {strange}", f"ids from 0 to {len(vertices) - 1}", "Export the mesh again."
        )


def _checked_mask(masked: Sequence[int], count: int) -> np.ndarray:
    ids = np.asarray(masked, np.int64)
    if ids.min() < 0 or ids.max() >= count:
        strange = ids.max() if ids.max() >= count else ids.min()
        raise InputError(
            "mask", got=f"vertex {strange}", expected=f"ids from 0 to {count - 1}", fix="Correct the mask."
        )
    return ids


def _areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corners = vertices[triangles]
    return 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )


def _largest_part(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Faces of the component with most area, and the vertex counts of the others."""
    if not len(triangles):
        raise _refusal("faces without area", "a surface", "Export the mesh again, or mask less of it.")
    _, merged = np.unique(vertices, axis=0, return_inverse=True)
    ends = merged.ravel()[triangles]
    count = int(ends.max()) + 1
    links = np.concatenate([ends[:, [0, 1]], ends[:, [1, 2]]])
    graph = scipy.sparse.coo_array((np.ones(len(links)), tuple(links.T)), shape=(count, count))
    label = connected_components(graph, directed=False)[1][ends[:, 0]]
    area = np.bincount(label, _areas(vertices, triangles))
    order = np.argsort(-area, kind="stable")
    order = order[area[order] > 0]
    second = area[order[1]] / area[order[0]] if len(order) > 1 else 0.0
    if second > _LARGEST_PART:
        raise _refusal(
            f"{len(order)} parts, the second with {second:.0%} of the first one's area",
            "one body; eyeballs, teeth and tongue may be apart",
            "Merge coincident vertices, or name the vertices that are no skin with mask=FILE.",
        )
    others = [len(np.unique(triangles[label == part])) for part in order[1:]]
    return triangles[label == order[0]], others


def _check_surface(triangles: np.ndarray, *, allow_open: bool) -> None:
    """Refuse half scans and soups of faces."""
    ends = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    _, uses = np.unique(np.sort(ends, 1), axis=0, return_counts=True)
    _, same = np.unique(ends, axis=0, return_counts=True)
    twisted = ((uses > 2).sum() + (same > 1).sum()) / len(uses)
    if twisted > max(_TWISTED, _FEW / len(uses)):
        raise _refusal(
            f"{twisted:.1%} of the edges between more than two faces, or faces turned against each other",
            "a surface with one side",
            "Repair the mesh: remove doubled faces and make its normals consistent.",
        )
    border = (uses == 1).sum() / len(uses)
    if border > _OPEN and not allow_open:
        raise _refusal(
            f"{border:.1%} of the edges on a border",
            f"a nearly closed body, at most {_OPEN:.0%}",
            "Close the holes of the scan, or merge coincident vertices.",
        )


def find_unit(extent: float) -> Unit:
    """The unit in which a longest side of `extent` is a person's.

    Raises:
        InputError: no unit fits.
    """
    for unit in METRIC:
        if _STATURES[0] <= extent * METRES[unit] <= _STATURES[1]:
            return unit
    raise _refusal(
        f"a longest side of {extent:.4g}",
        f"a body of {_STATURES[0]} to {_STATURES[1]} m in metres, centimetres or millimetres",
        "Scale the mesh, or pass unit=m, cm or mm.",
    )
