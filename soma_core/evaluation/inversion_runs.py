"""Fit moving meshes by each method of the ladder (paper, section 3.6) and gather what a table needs."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from soma_core.config.schema import InversionChoice
from soma_core.errors import InputError
from soma_core.evaluation.inversion_sequences import MovingMesh, plain_layer
from soma_core.inversion import InversionResult, PoseInversion
from soma_core.inversion.options import inversion_options
from soma_core.inversion.report import InversionReport
from soma_core.layer import SomaLayer
from soma_core.paths import configs_dir
from soma_core.progress import progress

__all__ = ["DEFAULT_METHOD", "MethodRun", "joint_angle_errors", "method_options", "run_methods"]

DEFAULT_METHOD = "gauss_newton"
"""The method that bounds are held against; it is the default of ``soma invert``."""

_LEAST_VERTICES = 50
"""A joint that moves fewer vertices hardly shows in them."""

_NOTICEABLE = 0.01
"""Skin weight above which a vertex moves with a joint."""

_WARM_UP = 2
"""Frames fitted before the clock runs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MethodRun:
    """One method on a group of meshes.

    Attributes:
        method: its name in the hydra group ``inversion``.
        name: what was fitted.
        summary: ``InversionReport.as_dict`` over all frames.
        frames_per_second: of the fit, on this machine, in passing.
        angles: errors of the joint rotations [degrees] where the truth is known, else empty.
    """

    method: str
    name: str
    summary: dict[str, Any]
    frames_per_second: float
    angles: np.ndarray

    def error_row(self) -> tuple[str, float, float, float, float, float]:
        """Method, mean, median, P95 and maximum [mm], frames per second."""
        found = self.summary["error_mm"]["all"]
        return (
            self.method,
            *(found[key] for key in ("mean", "median", "p95", "max")),
            self.frames_per_second,
        )

    @property
    def not_converged(self) -> float:
        """Percentage of the frames on which the fit did not converge, or that it could not use."""
        usable = self.summary["frames"] - self.summary["unusable_frames"]
        return 100 * (1 - (self.summary["converged_share"] or 0) * usable / self.summary["frames"])


def run_methods(
    meshes: Iterable[MovingMesh],
    methods: Sequence[str],
    *,
    device: str,
    plain: bool = True,
    refreshes: int | None = None,
) -> tuple[dict[str, MethodRun], list[MethodRun]]:
    """Fit all meshes by all methods.

    Args:
        plain: fit with plain skinning, else with the full model.
        refreshes: in place of the method's own.

    Returns:
        Method -> its run over all meshes together; and the default method (or the last one) on each mesh.

    Raises:
        InputError: no config ``inversion/<method>`` exists.
    """
    meshes = list(meshes)
    make = plain_layer if plain else SomaLayer
    layers = {name: make(name, device=device) for name in {mesh.backend for mesh in meshes}}
    shown = DEFAULT_METHOD if DEFAULT_METHOD in methods else methods[-1]
    together, each = {}, []
    for method in progress(methods, label="method", total=len(methods), after=5.0):
        choice = method_options(method)
        if refreshes is not None:
            choice["refreshes"] = refreshes
        runs = [_Run(mesh, layers[mesh.backend], choice) for mesh in meshes]
        together[method] = _gathered(runs, method, "all")
        if method == shown:
            each = [_gathered([run], method, run.mesh.name) for run in runs]
    return together, each


def method_options(method: str) -> dict[str, Any]:
    """Options of ``PoseInversion`` under the name that the command line gives them.

    Raises:
        InputError: no config ``inversion/<method>`` exists.
    """
    path = configs_dir() / "inversion" / f"{method}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in path.parent.glob("*.yaml")))
        raise InputError(
            "experiment.methods", got=repr(method), expected=f"among {known}", fix="Correct the name."
        )
    choice = OmegaConf.merge(OmegaConf.structured(InversionChoice), OmegaConf.load(path))
    values = OmegaConf.to_container(choice, enum_to_str=True)
    return inversion_options(values)


class _Run:
    """One method on one mesh."""

    def __init__(self, mesh: MovingMesh, layer: SomaLayer, choice: dict[str, Any]) -> None:
        self.mesh, self.layer = mesh, layer
        inversion = PoseInversion(layer, **choice)
        with torch.no_grad():
            identity = layer.identity(mesh.params)
            vertices = mesh.vertices.to(layer.device, layer.dtype)
            inversion(vertices[:_WARM_UP], identity, topology=mesh.topology)
            begin = time.perf_counter()
            result = inversion(vertices, identity, topology=mesh.topology)
            result.residual.sum().item()  # waits for the device
        self.seconds, self.frames = time.perf_counter() - begin, len(vertices)
        report = InversionReport(layer.mesh, layer.rig)
        report.add(result)
        self.report = report.arrays()
        self.angles = joint_angle_errors(mesh, result, layer)


def _gathered(runs: Sequence[_Run], method: str, name: str) -> MethodRun:
    report = InversionReport(runs[0].layer.mesh, runs[0].layer.rig)
    for run in runs:
        report.merge(run.report, consecutive=False)
    return MethodRun(
        method=method,
        name=name,
        summary=report.as_dict(),
        frames_per_second=sum(run.frames for run in runs) / sum(run.seconds for run in runs),
        angles=np.concatenate([run.angles for run in runs]),
    )


def joint_angle_errors(mesh: MovingMesh, result: InversionResult, layer: SomaLayer) -> np.ndarray:
    """Angles [degrees] between fitted and true rotations, of joints that move enough vertices; flat."""
    if mesh.rotations is None:
        return np.empty(0)
    moved = np.asarray((layer.rig.weights > _NOTICEABLE).sum(axis=0)).ravel()[1:]
    joints = np.flatnonzero(moved >= _LEAST_VERTICES)
    difference = (result.rotations.cpu() - mesh.rotations).double()[:, joints]
    chord = difference.square().sum((-1, -2)).sqrt() / (2 * 2**0.5)
    return np.degrees(2 * np.arcsin(chord.clamp(max=1).numpy())).ravel()
