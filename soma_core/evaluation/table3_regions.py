"""Paper, table 3 and section 4.2: error of pose inversion by region, and its change at the shoulders."""

from __future__ import annotations

from omegaconf import DictConfig

from soma_core.evaluation.inversion_runs import DEFAULT_METHOD, MethodRun, run_methods
from soma_core.evaluation.inversion_sequences import anny_meshes
from soma_core.evaluation.report import Figure, Report, Table
from soma_core.evaluation.shipped_layers import default_layer, plain_layer

__all__ = ["run"]

_REGIONS = ("all", "body", "hands", "feet", "head")
_ERRORS = tuple(f"{region}, mm" for region in _REGIONS)

_PAPER = (
    ("analytical", 8.8, 16.8, 4.7, 8.2, 6.9),
    ("analytical, then autograd (100)", 6.6, 15.3, 2.0, 5.8, 4.8),
)
"""Table 3 of the paper: MHR meshes of 200 frames."""

_PAPER_PEAKS = (("singular value decomposition", None, 1.6), ("Newton-Schulz", None, 0.8))
"""Section 4.2: largest change at the shoulders over 1,606 frames."""

_SHOULDER_PEAK_MM, _EXCESS_DEGREES, _MISSED_PERCENT = 0.8, 10.0, 1.0


def run(config: DictConfig) -> Report:
    """Fit ``config.experiment.count`` frames of meshes that Anny's own rig posed.

    Through plain skinning by every method; through the shipped default by the default method.
    """
    count, meshes = config.experiment.count, list(anny_meshes(config.experiment.count, config.seed))
    kind = {"device": config.device}
    shipped, _ = run_methods(meshes, [DEFAULT_METHOD], default_layer, **kind)
    plain, _ = run_methods(meshes, list(config.experiment.methods), plain_layer, **kind)
    runs = [*shipped.values(), *plain.values()]
    return Report(
        title=f"Pose inversion by region: anny's own rig, two bodies of {count} frames",
        tables=(
            Table(title="the paper: MHR", columns=("method", *_ERRORS), rows=_PAPER),
            Table(
                title="anny's own rig",
                columns=("method", "layer", *_ERRORS, "converged, %", "frames/s"),
                rows=[
                    (run.method, run.layer, *_means(run), 100 - run.not_converged, run.frames_per_second)
                    for run in runs
                ],
            ),
            Table(
                title="change from frame to frame",
                columns=(
                    "method", "layer", "error at the shoulders, mean, mm", "peak, mm",
                    "turn of a body joint beyond the bone's, degrees", "of the joint",
                ),
                rows=[
                    *((f"the paper, {row[0]}", None, *row[1:], None, None) for row in _PAPER_PEAKS),
                    *((run.method, run.layer, *_shoulders(run), *_excess(run)) for run in runs),
                ],
            ),
        ),
        figures=[figure for run in runs if run.method == DEFAULT_METHOD for figure in _figures(run)],
        notes=(
            "The default layer has twist joints and pose correctives, the plain one skins by the 78 public "
            "joints. Means over vertices outside the mouth and eye bags, by the joints that carry most of "
            "their skin weight. The change is averaged over the skin of both shoulders; its peak is over "
            "frames. Turns are those of body joints in the world, beyond that of the bone that carries the "
            "same skin.",
        ),
    )  # fmt: skip


def _figures(run: MethodRun) -> list[Figure]:
    """What the default method is held to on either layer."""
    found = [
        Figure(
            name=f"{run.layer}, shoulders, peak change", value=_shoulders(run)[1], unit="mm/frame",
            bound=_SHOULDER_PEAK_MM,
        ),
        Figure(
            name=f"{run.layer}, not converged", value=run.not_converged, unit="%", bound=_MISSED_PERCENT
        ),
    ]  # fmt: skip
    if run.excess is not None:
        found.append(
            Figure(
                name=f"{run.layer}, turn between frames beyond the bone's", value=run.excess.excess,
                unit="degrees", bound=_EXCESS_DEGREES,
            )
        )  # fmt: skip
    return found


def _excess(run: MethodRun) -> tuple[float | None, str | None]:
    return (None, None) if run.excess is None else (run.excess.excess, run.excess.joint)


def _means(run: MethodRun) -> tuple[float, ...]:
    return tuple(run.summary["error_mm"][region]["mean"] for region in _REGIONS)


def _shoulders(run: MethodRun) -> tuple[float, float]:
    change = run.summary["shoulder_change_mm_per_frame"]
    return change["mean"], change["peak"]
