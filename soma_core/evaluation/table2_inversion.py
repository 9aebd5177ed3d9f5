"""Paper, table 2: error and speed of pose inversion, by method."""

from __future__ import annotations

from dataclasses import replace

from omegaconf import DictConfig

from soma_core.evaluation.inversion_runs import DEFAULT_METHOD, MethodRun, run_methods
from soma_core.evaluation.inversion_sequences import anny_meshes, full_model_meshes, own_meshes
from soma_core.evaluation.report import Figure, Report, Table

__all__ = ["run"]

_COLUMNS = ("method", "mean, mm", "median, mm", "P95, mm", "max, mm", "frames/s")

_PAPER = (
    ("skeleton transfer only", 16.5, 13.9, None, 80.1, 17393.0),
    ("analytical", 5.3, 3.2, None, 88.1, 882.0),
    ("autograd, no initialisation", 501.8, 479.4, None, 1354.2, 79.0),
    ("autograd, from skeleton transfer", 4.1, 2.1, None, 81.5, 78.0),
    ("analytical, then autograd (10)", 7.8, 6.4, None, 88.6, 435.0),
)
"""Table 2 of the paper: SMPL-X meshes of AMASS, one A100."""

_OWN_MEAN_MM, _OWN_MAX_MM, _OWN_ANGLE_DEGREES = 0.01, 0.2, 0.1
_NATIVE_MEAN_MM = 4.0
_FULL_MODEL_SHARE = 0.1

_IGNORING, _THROUGH = "gauss_newton, ignoring twist and correctives", "gauss_newton, through the full model"


def run(config: DictConfig) -> Report:
    """Fit ``config.experiment.count`` frames of every mesh by every method, at the mid level of detail."""
    count, methods = config.experiment.count, list(config.experiment.methods)
    own, own_each = run_methods(own_meshes(count, config.seed), methods, device=config.device)
    native, native_each = run_methods(anny_meshes(count, config.seed), methods, device=config.device)
    full = _full_model(count, config)
    shown = own_each[0].method
    return Report(
        title=f"Pose inversion: {count} frames a mesh",
        tables=(
            Table(title="the paper: SMPL-X on AMASS, A100", columns=_COLUMNS, rows=_PAPER),
            _by_method("meshes that our own skinning posed", own),
            _by_method("meshes that the anny package posed with its own rig of 104 bones", native),
            _by_method("meshes that the full model posed, with twist joints and correctives", full),
            Table(
                title=f"{shown}, mesh by mesh",
                columns=("mesh", *_COLUMNS[1:]),
                rows=[(run.name, *run.error_row()[1:]) for run in (*own_each, *native_each)],
            ),
        ),
        figures=[*_figures(own.get(DEFAULT_METHOD), native.get(DEFAULT_METHOD)), _gain(full)],
        notes=(
            "Plain skinning by the 78 public joints, but where the full model is named. Errors are distances "
            "of vertices outside the mouth and eye bags. The angles are those of joints that move at least "
            "50 vertices. Frames per second are those of this run, in passing; `benchmarks/run.py` times.",
        ),
    )


def _full_model(count: int, config: DictConfig) -> dict[str, MethodRun]:
    """The default method through the full model, and ignoring what that adds to plain skinning."""
    meshes, found = list(full_model_meshes(count, config.seed)), {}
    for name, refreshes in ((_IGNORING, 0), (_THROUGH, None)):
        runs, _ = run_methods(
            meshes, [DEFAULT_METHOD], device=config.device, plain=False, refreshes=refreshes
        )
        found[name] = replace(runs[DEFAULT_METHOD], method=name)
    return found


def _gain(full: dict[str, MethodRun]) -> Figure:
    through, ignoring = (full[name].summary["error_mm"]["all"]["mean"] for name in (_THROUGH, _IGNORING))
    return Figure(
        name="full model, mean relative to a fit that ignores it", value=through / ignoring, unit="",
        bound=_FULL_MODEL_SHARE,
    )  # fmt: skip


def _by_method(title: str, runs: dict[str, MethodRun]) -> Table:
    return Table(title=title, columns=_COLUMNS, rows=[run.error_row() for run in runs.values()])


def _figures(own: MethodRun | None, native: MethodRun | None) -> list[Figure]:
    """What the default method is held to; nothing where it was not run."""
    if own is None or native is None:
        return []
    error, foreign = own.summary["error_mm"]["all"], native.summary["error_mm"]["all"]
    return [
        Figure(name="own meshes, mean", value=error["mean"], unit="mm", bound=_OWN_MEAN_MM),
        Figure(name="own meshes, max", value=error["max"], unit="mm", bound=_OWN_MAX_MM),
        Figure(
            name="own meshes, mean angle of a joint",
            value=float(own.angles.mean()),
            unit="degrees",
            bound=_OWN_ANGLE_DEGREES,
        ),
        Figure(name="own meshes, frames not converged", value=own.not_converged, unit="%", bound=0.0),
        Figure(name="anny's own rig, mean", value=foreign["mean"], unit="mm", bound=_NATIVE_MEAN_MM),
        Figure(name="anny's own rig, frames not converged", value=native.not_converged, unit="%", bound=0.0),
    ]
