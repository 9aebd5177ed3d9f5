"""Errors of native vertices in millimetres, by region of the body, gathered over chunks of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from soma_core.inversion.histogram import bin_counts, quantile
from soma_core.inversion.regions import body_regions
from soma_core.native import NativeTransfer
from soma_core.rig import load_canonical
from soma_core.rig.mesh import Lod

__all__ = ["NativeErrors"]

_MM = 1e3
_FIGURES = ("mean", "median", "p95", "max")


class NativeErrors:
    """Statistics of a fit on a native mesh.

    A native vertex belongs to the region of the canonical vertices that it lies between.

    Args:
        transfer: to the native mesh.
        lod: of the canonical vertices that it takes.

    Attributes:
        names: of the regions.
    """

    def __init__(self, transfer: NativeTransfer, lod: Lod) -> None:
        mesh, rig = load_canonical(lod)
        regions = body_regions(mesh, rig)
        owner = np.empty(mesh.vertex_count, np.int64)
        for index, ids in enumerate(regions.values()):
            owner[ids] = index
        self.names = tuple(regions)
        self._owner = owner[transfer.corners[:, 0].cpu().numpy()]
        self._skin = [index for index, name in enumerate(self.names) if name != "face_interior"]

    def statistics(self, error: np.ndarray) -> dict[str, np.ndarray]:
        """What is kept of errors (frames, n) [m]; NaN where there is no target."""
        each = [error[:, self._owner == index] for index in range(len(self.names))]
        each = [values[np.isfinite(values)] for values in each]
        skin = error[:, np.isin(self._owner, self._skin)]
        known = np.isfinite(skin)
        number, zeroed = known.sum(axis=1), np.where(known, skin, 0)
        return {
            "mean_error": _where(number > 0, zeroed.sum(axis=1) / np.maximum(number, 1)),
            "largest_error": _where(number > 0, zeroed.max(axis=1)),
            "numbers": np.array([values.size for values in each]),
            "sums": np.array([values.sum(dtype=np.float64) for values in each]),
            "maxima": np.array([values.max(initial=0) for values in each], np.float64),
            "counts": np.stack([bin_counts(values) for values in each]),
        }

    def figures(self, parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, dict[str, float | None]]:
        """Mean, median, P95 and maximum [mm] of the skin and of each region; None where nothing was seen."""
        sums, numbers, counts = (sum(part[name] for part in parts) for name in ("sums", "numbers", "counts"))
        maxima = np.max([part["maxima"] for part in parts], axis=0)

        def of(regions: list[int]) -> dict[str, float | None]:
            number, histogram = numbers[regions].sum(), counts[regions].sum(axis=0)
            if not number:
                return dict.fromkeys(_FIGURES)
            largest = maxima[regions].max()
            middle, high = (min(quantile(histogram, share), largest) for share in (0.5, 0.95))
            values = (sums[regions].sum() / number, middle, high, largest)
            return {name: _MM * float(value) for name, value in zip(_FIGURES, values, strict=True)}

        return {"all": of(self._skin)} | {name: of([index]) for index, name in enumerate(self.names)}


def _where(known: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.where(known, values, np.nan).astype(np.float32)
