"""What an experiment found: figures, the bounds they are held to, and a table for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["Figure", "Report", "ShownBody", "Table", "distance_figures"]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One measured number.

    Attributes:
        name: what was measured.
        value: the number.
        unit: its unit.
        bound: largest value that passes; None for a figure that only informs.
    """

    name: str
    value: float
    unit: str = ""
    bound: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the figure is inside its bound."""
        return self.bound is None or bool(np.isfinite(self.value) and self.value <= self.bound)


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows laid out as in the paper.

    Attributes:
        title: what the rows have in common.
        columns: heading of each column; the first one is that of the names of the rows.
        rows: a name, then numbers or None.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str | float | None]]

    def as_markdown(self) -> str:
        """The table, numbers to four digits."""
        lines = [f"**{self.title}**", "", _row(self.columns), _row(["---"] * len(self.columns))]
        return "\n".join([*lines, *map(_row, self.rows)])


def _row(cells: Sequence[str | float | None]) -> str:
    return f"| {' | '.join(map(_cell, cells))} |"


def _cell(value: str | float | None) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownBody:
    """One body of the picture of an experiment.

    Attributes:
        caption: text below it; a second line is drawn smaller.
        vertices: (v, 3) [m], +Y up.
        triangles: (t, 3) vertex ids.
        errors_mm: (v,) error of each vertex [mm], by which it is coloured; NaN where there is none.
    """

    caption: str
    vertices: np.ndarray
    triangles: np.ndarray
    errors_mm: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Report:
    """All figures of one experiment.

    Attributes:
        title: one line.
        figures: in the order a reader wants them.
        notes: sentences that explain the figures.
        tables: what is compared but not held to a bound; shown before the figures.
        bodies: what is worth looking at; drawn as ``errors.png``.
        pictures: further ones: name of the PNG, and what draws it at a path.
    """

    title: str
    figures: Sequence[Figure]
    notes: Sequence[str] = field(default_factory=tuple)
    tables: Sequence[Table] = field(default_factory=tuple)
    bodies: Sequence[ShownBody] = field(default_factory=tuple)
    pictures: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)

    @property
    def failed(self) -> list[Figure]:
        """Figures outside their bound."""
        return [figure for figure in self.figures if not figure.passed]

    def as_json(self) -> dict[str, Any]:
        """Plain values for ``report.json``."""
        rows = [
            {"name": f.name, "value": float(f.value), "unit": f.unit, "bound": f.bound, "passed": f.passed}
            for f in self.figures
        ]
        tables = [
            {"title": t.title, "columns": list(t.columns), "rows": [list(row) for row in t.rows]}
            for t in self.tables
        ]
        return {"title": self.title, "figures": rows, "notes": list(self.notes), "tables": tables}

    def as_markdown(self) -> str:
        """The tables, then the figures with their bounds beside them."""
        lines = [f"# {self.title}", ""]
        for table in self.tables:
            lines += [table.as_markdown(), ""]
        lines += ["| figure | value | bound | |", "|---|---|---|---|"]
        for figure in self.figures:
            bound = "" if figure.bound is None else f"<= {figure.bound:g} {figure.unit}"
            mark = "" if figure.bound is None else ("ok" if figure.passed else "FAILED")
            lines.append(f"| {figure.name} | {figure.value:.4g} {figure.unit} | {bound} | {mark} |")
        return "\n".join([*lines, "", *self.notes, ""])


def distance_figures(
    name: str, metres: np.ndarray, *, mean: float | None = None, p95: float | None = None
) -> list[Figure]:
    """Mean, standard deviation, P95 and maximum of distances [m], in millimetres."""
    mm = 1e3 * np.asarray(metres, np.float64).ravel()
    return [
        Figure(name=f"{name}, mean", value=float(mm.mean()), unit="mm", bound=mean),
        Figure(name=f"{name}, std", value=float(mm.std()), unit="mm"),
        Figure(name=f"{name}, P95", value=float(np.percentile(mm, 95)), unit="mm", bound=p95),
        Figure(name=f"{name}, max", value=float(mm.max()), unit="mm"),
    ]
