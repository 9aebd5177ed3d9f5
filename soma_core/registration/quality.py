"""How good a wrap is: distances both ways, by segment too, fingers and toes, flipped faces, stretch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from soma_core.paths import shipped_assets
from soma_core.registration.coverage import Share, coverage, faults, lost, matches, slid
from soma_core.registration.digits import digit_guide
from soma_core.registration.folds import flipped_triangles
from soma_core.registration.register import Registration
from soma_core.registration.surface import Surface
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh

__all__ = ["Quality", "measure"]

_TOLD = 4
"""Faults that are told; all are in the report."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Quality:
    """Measurements of a wrap, millimetres.

    Attributes:
        distance: (v,) of each canonical vertex to the native skin; NaN where it was filled.
        uncovered: (n,) of each vertex of the native skin to the wrap.
        flipped: (t,) whether a triangle faces the other way than the skin at its three corners.
        stretch: (e,) ratio of edge lengths, wrap by canonical mesh, over its median.
        coverage: segment -> shares of it and of the skin at it that lie on each other.
        digits: finger or toe -> shares that lie on the same; only where those of the skin were told apart.
        extremities: hand or foot -> how many the skin has; None where it is not apart from the rest.
        faults: one sentence for each thing that makes the wrap unfit for use.
    """

    distance: np.ndarray
    uncovered: np.ndarray
    flipped: np.ndarray
    stretch: np.ndarray
    coverage: Mapping[str, Share]
    digits: Mapping[str, Share]
    extremities: Mapping[str, int | None]
    faults: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Numbers for a report."""
        known = self.distance[np.isfinite(self.distance)]
        return {
            "surface_distance_mm": _spread(known),
            "native_to_wrap_mm": _spread(self.uncovered),
            "flipped_triangles": int(self.flipped.sum()),
            "flipped_percent": round(100 * float(self.flipped.mean()), 4),
            "edge_stretch": {
                f"p{share}": round(float(np.percentile(self.stretch, share)), 3) for share in (1, 50, 99)
            },
            "filled_vertices": int(np.isnan(self.distance).sum()),
            "coverage": {name: share.as_dict() for name, share in self.coverage.items()},
            "digits": {name: share.as_dict() for name, share in self.digits.items()},
            "extremities": dict(self.extremities),
            "faults": list(self.faults),
        }

    def told(self) -> str:
        """The first faults, for a message."""
        more = len(self.faults) - _TOLD
        return "; ".join([*self.faults[:_TOLD], *([f"{more} more are in report.json"] if more > 0 else [])])


def _spread(values: np.ndarray) -> dict[str, float]:
    numbers = (values.mean(), *np.percentile(values, (50, 95)), values.max())
    return {
        name: round(float(value), 4)
        for name, value in zip(("mean", "median", "p95", "max"), numbers, strict=True)
    }


def measure(found: Registration, mesh: CanonicalMesh) -> Quality:
    """Measure a wrap against the native skin that it was laid on."""
    surface = found.skin.surface(found.frame)
    wrap = found.frame.to_canonical(found.wrap)
    triangles = mesh.triangles.astype(np.int64)
    contact = surface.closest(wrap)
    distance = 1000 * np.linalg.norm(contact.points - wrap, axis=1)
    own = Surface(wrap, triangles)
    guide, (_, rig) = digit_guide(), load_canonical("mid", shipped_assets())
    digits = guide.find(surface, wrap)
    covered = coverage(wrap, surface, mesh, rig, found.filled)
    matched = matches(wrap, surface, digits, guide)
    back = 1000 * np.linalg.norm(own.closest(surface.vertices).points - surface.vertices, axis=1)
    gone = lost(wrap, surface, rig)
    said = faults(covered, matched, digits.counts, told=found.told, gone=gone)
    said += slid(wrap, mesh, rig, found.filled)
    if not found.skin.masked:  # what a user masked is known to be gone
        said += tuple(f"{name}: {part:.0%} is off the mesh, over a hole in it" for name, part in gone.items())
    return Quality(
        distance=np.where(found.filled, np.nan, distance),
        uncovered=back,
        flipped=flipped_triangles(wrap, triangles, surface, found.filled),
        stretch=_stretch(wrap, mesh.vertices, triangles),
        coverage=covered,
        digits=matched,
        extremities=digits.counts,
        faults=said,
    )


def _stretch(wrap: np.ndarray, canonical: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    ends = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    ends = ends[ends[:, 0] < ends[:, 1]]
    lengths = [
        np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1) for points in (wrap, canonical)
    ]
    ratio = lengths[0] / np.maximum(lengths[1], 1e-12)
    return ratio / np.median(ratio)
