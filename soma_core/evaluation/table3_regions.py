"""Paper, table 3 and section 4.2: error of pose inversion by region, and how it changes at the shoulders."""

from __future__ import annotations

from omegaconf import DictConfig

from soma_core.evaluation.inversion_runs import DEFAULT_METHOD, MethodRun, run_methods
from soma_core.evaluation.inversion_sequences import anny_meshes
from soma_core.evaluation.report import Figure, Report, Table

__all__ = ["run"]

_REGIONS = ("all", "body", "hands", "feet", "head")
_COLUMNS = ("method", *(f"{region}, mm" for region in _REGIONS))

_PAPER = (
    ("analytical", 8.8, 16.8, 4.7, 8.2, 6.9),
    ("analytical, then autograd (100)", 6.6, 15.3, 2.0, 5.8, 4.8),
)
"""Table 3 of the paper: MHR meshes of 200 frames."""

_PAPER_PEAKS = (("singular value decomposition", None, 1.6), ("Newton-Schulz", None, 0.8))
"""Section 4.2: largest change at the shoulders over 1,606 frames."""

_SHOULDER_PEAK_MM = 0.8


def run(config: DictConfig) -> Report:
    """Fit ``config.experiment.count`` frames of meshes that Anny's own rig posed, by every method."""
    count, methods = config.experiment.count, list(config.experiment.methods)
    runs, _ = run_methods(anny_meshes(count, config.seed), methods, device=config.device)
    default = runs.get(DEFAULT_METHOD)
    figures = []
    if default is not None:
        peak = _shoulders(default)[1]
        figures = [
            Figure(name="shoulders, peak change", value=peak, unit="mm/frame", bound=_SHOULDER_PEAK_MM)
        ]
    return Report(
        title=f"Pose inversion by region: anny's own rig, two bodies of {count} frames",
        tables=(
            Table(title="the paper: MHR", columns=_COLUMNS, rows=_PAPER),
            Table(
                title="anny's own rig",
                columns=_COLUMNS,
                rows=[(name, *_means(run)) for name, run in runs.items()],
            ),
            Table(
                title="change of the error at the shoulders from frame to frame",
                columns=("method", "mean, mm", "peak, mm"),
                rows=[
                    *((f"the paper, {row[0]}", *row[1:]) for row in _PAPER_PEAKS),
                    *((name, *_shoulders(run)) for name, run in runs.items()),
                ],
            ),
        ),
        figures=figures,
        notes=(
            "Means over vertices outside the mouth and eye bags, by the joints that carry most of their skin "
            "weight. The change is averaged over the skin of both shoulders; its peak is over frames.",
        ),
    )


def _means(run: MethodRun) -> tuple[float, ...]:
    return tuple(run.summary["error_mm"][region]["mean"] for region in _REGIONS)


def _shoulders(run: MethodRun) -> tuple[float, float]:
    change = run.summary["shoulder_change_mm_per_frame"]
    return change["mean"], change["peak"]
