"""How well a fit explains its targets: errors in millimetres, by region, over any number of frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from soma_core.errors import InputError
from soma_core.geometry.rotations import orthonormality_error
from soma_core.inversion.histogram import BIN_COUNT, bin_counts, quantile
from soma_core.inversion.regions import body_regions, shoulder_region
from soma_core.inversion.result import InversionResult
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["InversionReport"]

_LISTED = 100
"""Frames that could not be used are listed by number up to this many."""

_ANGLE_EDGES = np.geomspace(1e-4, 360.0, 1513)
"""Bins of the standard deviations of joint angles [degrees], 1 % wide."""

_MM = 1e3
_SUMMED = ("frames", "valid", "converged", "plain", "iterations", "counts", "sums", "histogram", "changes")
_LARGEST = ("most_iterations", "orthonormality", "maxima", "peaks")


class InversionReport:
    """Gathers results in the order of their frames, in memory that does not grow with them.

    Means and maxima are exact; medians and percentiles come from a histogram and are good to 0.1 %.
    ``merge`` joins reports of consecutive chunks, so that chunks may be computed apart and in any run.

    Args:
        mesh, rig: of the layer that the poses were fitted with; they decide the regions.
    """

    def __init__(self, mesh: CanonicalMesh, rig: Rig) -> None:
        regions = body_regions(mesh, rig)
        self._names = tuple(regions)
        self._order = np.concatenate(list(regions.values()))
        self._ends = np.cumsum([len(ids) for ids in regions.values()])
        self._shoulders = shoulder_region(rig)
        self._joints = rig.user_joint_names
        count = len(regions)
        self._state: dict[str, np.ndarray] = {
            "frames": np.zeros((), np.int64),
            "valid": np.zeros((), np.int64),
            "converged": np.zeros((), np.int64),
            "plain": np.zeros((), np.int64),
            "iterations": np.zeros((), np.int64),
            "most_iterations": np.zeros((), np.int64),
            "orthonormality": np.zeros(()),
            "counts": np.zeros(count, np.int64),
            "sums": np.zeros(count),
            "maxima": np.zeros(count),
            "histogram": np.zeros((count, BIN_COUNT), np.int64),
            "changes": np.zeros(2),  # how many pairs of frames, sum of the mean change [m]
            "peaks": np.zeros(2),  # largest change of the region's mean and of one vertex [m]
            "angles": np.zeros((0, len(_ANGLE_EDGES) - 1), np.int64),  # joints, once there are any
            "unusable": np.zeros(0, np.int64),
            "first_shoulders": np.zeros((0, len(self._shoulders)), np.float32),
            "last_shoulders": np.zeros((0, len(self._shoulders)), np.float32),
        }

    def add(self, result: InversionResult) -> None:
        """Take in the next frames."""
        error = result.vertex_error.detach().cpu().float().numpy()
        if error.shape[1] != len(self._order):
            raise InputError(
                "result.vertex_error",
                got=f"{error.shape[1]} vertices",
                expected=f"{len(self._order)}, as in the mesh of the report",
                fix="Make the report with the mesh and rig of the layer.",
            )
        self.merge(self._errors(error) | _counted(result) | {"angles": _angle_counts(result)})

    def _errors(self, error: np.ndarray) -> dict[str, np.ndarray]:
        """Statistics of the vertex errors (frames, v) [m]."""
        ordered = error[:, self._order]
        begins = [0, *self._ends[:-1]]
        found = [_finite(ordered[:, begin:end]) for begin, end in zip(begins, self._ends, strict=True)]
        shoulders = error[:, self._shoulders]
        return {
            "counts": np.array([values.size for values in found]),
            "sums": np.array([values.sum(dtype=np.float64) for values in found]),
            "maxima": np.array([values.max(initial=0) for values in found], np.float64),
            "histogram": np.stack([bin_counts(values) for values in found]),
            "first_shoulders": shoulders[:1],
            "last_shoulders": shoulders[-1:],
            **_changes(shoulders),
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """The state, to be stored; ``merge`` takes it up again."""
        return dict(self._state)

    def merge(self, later: Mapping[str, np.ndarray], *, consecutive: bool = True) -> None:
        """Append the state of a report over the frames that follow, or over those of another sequence."""
        mine = self._state
        merged = {name: mine[name] + later[name] for name in _SUMMED}
        merged |= {name: np.maximum(mine[name], later[name]) for name in _LARGEST}
        pair = [mine["last_shoulders"], later["first_shoulders"]]
        seam = _changes(np.concatenate(pair) if consecutive else later["first_shoulders"][:0])
        merged["changes"] = merged["changes"] + seam["changes"]
        merged["peaks"] = np.maximum(merged["peaks"], seam["peaks"])
        counts = [part["angles"] for part in (mine, later) if len(part["angles"])]
        merged["angles"] = sum(counts[1:], counts[0]) if counts else mine["angles"]
        merged["unusable"] = np.concatenate([mine["unusable"], mine["frames"] + later["unusable"]])
        for name, first, second in (("first_shoulders", mine, later), ("last_shoulders", later, mine)):
            merged[name] = np.array(first[name] if len(first[name]) else second[name])
        self._state = merged

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``report.json``: errors in mm, the rest as named; None where nothing was seen."""
        state, valid = self._state, int(self._state["valid"])
        pairs, total = state["changes"].tolist()
        skin = [index for index, name in enumerate(self._names) if name != "face_interior"]
        errors = {"all": self._figures(skin)}
        errors |= {name: self._figures([index]) for index, name in enumerate(self._names)}
        return {
            "frames": int(state["frames"]),
            "unusable_frames": int(state["frames"]) - valid,
            "unusable": state["unusable"][:_LISTED].tolist(),
            "converged_share": int(state["converged"]) / valid if valid else None,
            "plain_share": int(state["plain"]) / valid if valid else None,
            "iterations": {
                "mean": int(state["iterations"]) / valid if valid else None,
                "max": int(state["most_iterations"]),
            },
            "orthonormality": float(state["orthonormality"]),
            "error_mm": errors,
            "shoulder_change_mm_per_frame": {
                "mean": _MM * total / pairs if pairs else None,
                "peak": _MM * float(state["peaks"][0]) if pairs else None,
                "peak_of_a_vertex": _MM * float(state["peaks"][1]) if pairs else None,
            },
            **self._angles(),
        }

    def _angles(self) -> dict[str, dict[str, float | None]]:
        """Median standard deviation of each joint's angle [degrees] by name, where the fit tells any."""
        counts = self._state["angles"]
        if not len(counts):
            return {}
        medians = [_angle_median(row) for row in counts]
        return {"angle_std_degrees": dict(zip(self._joints, medians, strict=True))}

    def _figures(self, regions: list[int]) -> dict[str, float | None]:
        """Mean, median, P95 and maximum over some regions together [mm]."""
        state = self._state
        count, histogram = state["counts"][regions].sum(), state["histogram"][regions].sum(axis=0)
        if not count:
            return dict.fromkeys(("mean", "median", "p95", "max"))
        largest = float(state["maxima"][regions].max())
        values = {
            "mean": float(state["sums"][regions].sum() / count),
            "median": min(quantile(histogram, 0.5), largest),
            "p95": min(quantile(histogram, 0.95), largest),
            "max": largest,
        }
        return {name: _MM * value for name, value in values.items()}

    def as_text(self) -> str:
        """The figures as a table for people."""
        found = self.as_dict()
        lines = [f"{'error, mm':<14}{'mean':>10}{'median':>10}{'P95':>10}{'max':>10}"]
        for name, row in found["error_mm"].items():
            lines.append(f"{name.replace('_', ' '):<14}" + "".join(_cell(value) for value in row.values()))
        change = found["shoulder_change_mm_per_frame"]
        share, iterations = found["converged_share"], found["iterations"]["mean"]
        lines += [
            f"{found['frames']} frames, {found['unusable_frames']} of them unusable; converged "
            f"{_number(share, '.1%')}, after {_number(iterations, '.1f')} iterations on average",
            f"shoulder error changes by {_number(change['mean'], '.3g')} mm a frame, "
            f"at most {_number(change['peak'], '.3g')} mm",
        ]
        if found["plain_share"]:
            lines.append(
                f"another rig moved the skin of {found['plain_share']:.1%} of the frames: plain skinning "
                "describes them better than the full model, and their poses and errors are its"
            )
        return "\n".join(lines)


def _finite(values: np.ndarray) -> np.ndarray:
    """Errors that exist; NaN marks vertices without a target and frames that could not be used."""
    finite = np.isfinite(values)
    return values.reshape(-1) if finite.all() else values[finite]


def _changes(shoulders: np.ndarray) -> dict[str, np.ndarray]:
    """Change of the errors (frames, vertices) [m] between frames: number and sum of means, and the peaks."""
    change = np.abs(np.diff(shoulders, axis=0))
    change = change[np.isfinite(change).any(axis=1)] if change.size else change[:0]
    if not len(change):
        return {"changes": np.zeros(2), "peaks": np.zeros(2)}
    means = np.asarray(np.nanmean(change, axis=1, dtype=np.float64))
    return {
        "changes": np.array([len(means), means.sum()]),
        "peaks": np.array([means.max(), np.nanmax(change)], np.float64),
    }


def _counted(result: InversionResult) -> dict[str, np.ndarray]:
    """What is counted over frames; rotations of frames that could not be used are left out."""
    valid, iterations = result.valid.cpu().numpy(), result.iterations.cpu().numpy()
    skew = orthonormality_error(result.rotations.detach()[result.valid])
    return {
        "frames": np.array(len(valid)),
        "valid": np.array(valid.sum()),
        "converged": np.array((result.converged.cpu().numpy() & valid).sum()),
        "plain": np.array((result.plain.cpu().numpy() & valid).sum()),
        "iterations": np.array(iterations[valid].sum()),
        "most_iterations": np.array(iterations[valid].max(initial=0)),
        "orthonormality": np.array(float(skew.max()) if skew.numel() else 0.0),
        "unusable": np.flatnonzero(~valid),
    }


def _angle_counts(result: InversionResult) -> np.ndarray:
    """Histogram (J - 1, bins) of the standard deviations of joint angles; none where the fit tells none."""
    found = getattr(result, "angle_std", None)
    bins = len(_ANGLE_EDGES) - 1
    if found is None:
        return np.zeros((0, bins), np.int64)
    angles = found.detach()[result.valid].cpu().double().numpy()
    counts = np.zeros((found.shape[1], bins), np.int64)
    frame, joint = np.nonzero(np.isfinite(angles))
    places = np.searchsorted(_ANGLE_EDGES, angles[frame, joint], side="right") - 1
    np.add.at(counts, (joint, np.clip(places, 0, bins - 1)), 1)
    return counts


def _angle_median(counts: np.ndarray) -> float | None:
    """Median of a histogram of angles [degrees], to 1 %; None where nothing was counted."""
    if not counts.any():
        return None
    place = int(np.searchsorted(np.cumsum(counts), counts.sum() / 2))
    return float(np.sqrt(_ANGLE_EDGES[place] * _ANGLE_EDGES[place + 1]))


def _cell(value: float | None) -> str:
    return f"{_number(value, '.4g'):>10}"


def _number(value: float | None, form: str) -> str:
    return "none" if value is None or math.isnan(value) else format(value, form)
