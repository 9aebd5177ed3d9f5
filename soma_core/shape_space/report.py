"""How well a shape space describes bodies it has not seen: errors in millimetres against components."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal, TypedDict

import numpy as np

from soma_core.cache import atomic_write

__all__ = ["COMPONENT_COUNTS", "ErrorRow", "plot_errors", "reconstruction_errors"]

COMPONENT_COUNTS = (1, 2, 4, 8, 16, 32, 64, 96, 128)
_MM_PER_CM = 10.0


class ErrorRow(TypedDict):
    """Distance of vertices from their reconstruction, over all vertices of all bodies."""

    components: int
    mean_mm: float
    p95_mm: float
    max_mm: float


def reconstruction_errors(
    mean: np.ndarray, directions: np.ndarray, shapes: np.ndarray, counts: Iterable[int] = COMPONENT_COUNTS
) -> list[ErrorRow]:
    """Reconstruct shapes from their first k coefficients, for each k in `counts` that is available.

    Args:
        mean: (v, 3) [cm].
        directions: (components, 3 v), orthonormal.
        shapes: (n, v, 3) [cm] that were not trained on.
        counts: numbers of components, ascending.
    """
    residual = (shapes - mean).reshape(len(shapes), -1)
    coefficients = residual @ directions.T
    rows: list[ErrorRow] = []
    done = 0
    for count in (count for count in counts if count <= len(directions)):
        residual = residual - coefficients[:, done:count] @ directions[done:count]
        done = count
        distances = _MM_PER_CM * np.linalg.norm(residual.reshape(-1, 3), axis=-1)
        rows.append(
            ErrorRow(
                components=count,
                mean_mm=round(float(distances.mean()), 4),
                p95_mm=round(float(np.quantile(distances, 0.95)), 4),
                max_mm=round(float(distances.max()), 4),
            )
        )
    return rows


def plot_errors(rows: Sequence[ErrorRow], path: Path) -> bool:
    """Draw the errors against the number of components; False where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        return False
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    lines: tuple[tuple[Literal["mean_mm", "p95_mm", "max_mm"], str], ...] = (
        ("mean_mm", "mean"), ("p95_mm", "95th percentile"), ("max_mm", "largest"),
    )  # fmt: skip
    for key, label in lines:
        axes.loglog([row["components"] for row in rows], [row[key] for row in rows], marker="o", label=label)
    axes.xaxis.set_major_locator(FixedLocator([row["components"] for row in rows]))
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")  # 0.5, not 5 x 10^-1
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("components")
    axes.set_ylabel("vertex error on held-out bodies [mm]")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    atomic_write(path, lambda temporary: figure.savefig(temporary, dpi=150))
    return True
