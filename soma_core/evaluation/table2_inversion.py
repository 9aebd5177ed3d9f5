"""Paper, table 2: error and speed of pose inversion, by method; the shipped default beside plain skinning."""

from __future__ import annotations

from dataclasses import replace

from omegaconf import DictConfig

from soma_core.evaluation.inversion_runs import COLUMNS, DEFAULT_METHOD, MethodRun, run_methods
from soma_core.evaluation.inversion_sequences import anny_meshes, own_meshes
from soma_core.evaluation.report import Figure, Report, Table
from soma_core.evaluation.shipped_layers import default_layer, plain_layer

__all__ = ["run"]

_PAPER_COLUMNS = ("method", "mean, mm", "median, mm", "P95, mm", "max, mm", "frames/s")

_PAPER = (
    ("skeleton transfer only", 16.5, 13.9, None, 80.1, 17393.0),
    ("analytical", 5.3, 3.2, None, 88.1, 882.0),
    ("autograd, no initialisation", 501.8, 479.4, None, 1354.2, 79.0),
    ("autograd, from skeleton transfer", 4.1, 2.1, None, 81.5, 78.0),
    ("analytical, then autograd (10)", 7.8, 6.4, None, 88.6, 435.0),
)
"""Table 2 of the paper: SMPL-X meshes of AMASS, one A100."""

_OWN_MEAN_MM, _OWN_MAX_MM, _OWN_DEGREES, _OWN_MAX_DEGREES = 0.01, 0.2, 0.1, 0.2
_OWN_EXCESS, _NATIVE_EXCESS = 1.0, 10.0
_NATIVE_MEAN_MM, _NATIVE_MISSED = 4.0, 1.0

_IGNORING = f"{DEFAULT_METHOD}, ignoring twist and correctives"


def run(config: DictConfig) -> Report:
    """Fit ``config.experiment.count`` frames of every mesh, at the mid level of detail.

    Plain skinning by every method; the shipped default, on what it posed itself, by the default method.
    """
    own, own_each = _own(config)
    native, native_each = _native(config)
    return Report(
        title=f"Pose inversion: {config.experiment.count} frames a mesh",
        tables=(
            Table(title="the paper: SMPL-X on AMASS, A100", columns=_PAPER_COLUMNS, rows=_PAPER),
            _by_method("meshes that the layer itself posed", own),
            _by_method("meshes that the anny package posed with its own rig of 104 bones", native),
            Table(
                title="mesh by mesh",
                columns=("mesh", *COLUMNS[1:]),
                rows=[run.row(run.name) for run in (*own_each, *native_each)],
            ),
        ),
        figures=[*_own_figures(own), *_native_figures(native)],
        notes=(
            "The default layer has twist joints and pose correctives, the plain one skins by the 78 public "
            "joints; each fits what it posed itself, and what Anny's own rig posed. Errors are distances of "
            "vertices outside the mouth and eye bags; angles are those of joints that move at least 50 "
            "vertices; turns are those of body joints between frames, beyond the true joint's or, on Anny's "
            "own rig, beyond the bone's that carries the same skin. Frames per second are those of this run, "
            "in passing; `benchmarks/run.py` times.",
        ),
    )


def _own(config: DictConfig) -> tuple[list[MethodRun], list[MethodRun]]:
    """Runs on meshes that the layer itself posed: over all meshes, and of the default method on each."""
    count, seed, kind = config.experiment.count, config.seed, {"device": config.device}
    meshes = list(own_meshes(count, seed, default_layer))
    shipped, each = run_methods(meshes, [DEFAULT_METHOD], default_layer, **kind)
    ignoring, _ = run_methods(meshes, [DEFAULT_METHOD], default_layer, refreshes=0, **kind)
    plain, plain_each = run_methods(
        own_meshes(count, seed, plain_layer), list(config.experiment.methods), plain_layer, **kind
    )
    ignored = replace(ignoring[DEFAULT_METHOD], method=_IGNORING)
    return [*shipped.values(), ignored, *plain.values()], [*each, *plain_each]


def _native(config: DictConfig) -> tuple[list[MethodRun], list[MethodRun]]:
    """The same on meshes of Anny's own rig."""
    meshes, kind = list(anny_meshes(config.experiment.count, config.seed)), {"device": config.device}
    shipped, each = run_methods(meshes, [DEFAULT_METHOD], default_layer, **kind)
    plain, plain_each = run_methods(meshes, list(config.experiment.methods), plain_layer, **kind)
    return [*shipped.values(), *plain.values()], [*each, *plain_each]


def _by_method(title: str, runs: list[MethodRun]) -> Table:
    return Table(title=title, columns=COLUMNS, rows=[run.row() for run in runs])


def _own_figures(runs: list[MethodRun]) -> list[Figure]:
    """What the default method is held to on either layer."""
    figures = []
    for one in runs:
        if one.method != DEFAULT_METHOD:
            continue
        name, error = f"{one.layer}, own meshes", one.summary["error_mm"]["all"]
        figures += [
            Figure(name=f"{name}, mean", value=error["mean"], unit="mm", bound=_OWN_MEAN_MM),
            Figure(name=f"{name}, max", value=error["max"], unit="mm", bound=_OWN_MAX_MM),
            _degrees(f"{name}, mean angle of a joint", one.angles.mean(), _OWN_DEGREES),
            _degrees(f"{name}, max angle of a joint", one.angles.max(), _OWN_MAX_DEGREES),
            *_turns(name, one, _OWN_EXCESS),
            Figure(name=f"{name}, frames not converged", value=one.not_converged, unit="%", bound=0.0),
            Figure(name=f"{name}, converged but wrong", value=one.wrong, unit="frames", bound=0.0),
        ]
    return figures


def _native_figures(runs: list[MethodRun]) -> list[Figure]:
    figures = []
    for one in runs:
        if one.method != DEFAULT_METHOD:
            continue
        name, mean = f"{one.layer}, anny's own rig", one.summary["error_mm"]["all"]["mean"]
        figures += [
            Figure(name=f"{name}, mean", value=mean, unit="mm", bound=_NATIVE_MEAN_MM),
            *_turns(name, one, _NATIVE_EXCESS),
            Figure(
                name=f"{name}, frames not converged", value=one.not_converged, unit="%", bound=_NATIVE_MISSED
            ),
        ]
    return figures


def _turns(name: str, one: MethodRun, bound: float) -> list[Figure]:
    if one.excess is None:
        return []
    return [_degrees(f"{name}, turn between frames beyond the true one", one.excess.excess, bound)]


def _degrees(name: str, value: float, bound: float) -> Figure:
    return Figure(name=name, value=float(value), unit="degrees", bound=bound)
