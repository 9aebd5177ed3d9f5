"""Fit moving meshes by each method of the ladder (paper, section 3.6) and gather what a table needs."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from soma_core.errors import InputError
from soma_core.evaluation.inversion_sequences import MovingMesh
from soma_core.evaluation.joint_turns import TurnExcess, angles_between, turn_excess
from soma_core.evaluation.pose_angle_fits import WRONG_DEGREES, visible_joints
from soma_core.evaluation.shipped_layers import LayerMaker, layer_label
from soma_core.inversion import InversionResult, PoseInversion
from soma_core.inversion.options import inversion_options
from soma_core.inversion.report import InversionReport
from soma_core.layer import SomaLayer
from soma_core.options import InversionChoice
from soma_core.paths import configs_dir
from soma_core.progress import progress

__all__ = ["COLUMNS", "DEFAULT_METHOD", "MethodRun", "joint_angle_errors", "method_options", "run_methods"]

DEFAULT_METHOD = "gauss_newton"
"""The method that bounds are held against; it is the default of ``soma invert``."""

_WARM_UP = 2
"""Frames fitted before the clock runs."""


COLUMNS = (
    "method", "layer", "mean, mm", "median, mm", "P95, mm", "max, mm", "angle, mean, degrees", "max",
    "turn beyond the true one, degrees", "converged, %", "converged but wrong, frames", "frames/s",
)  # fmt: skip
"""Of a table of runs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MethodRun:
    """One method on a group of meshes.

    Attributes:
        method: its name in the hydra group ``inversion``.
        layer: ``default`` or ``plain``.
        name: what was fitted.
        summary: ``InversionReport.as_dict`` over all frames.
        frames_per_second: of the fit, on this machine, in passing.
        angles: errors of the joint rotations [degrees] where the truth is known, else empty; flat.
        wrong: frames that are flagged converged and have a joint beyond two degrees.
        excess: the greatest turn of a body joint between two frames beyond the true one; None without a
            truth or a second frame.
    """

    method: str
    layer: str
    name: str
    summary: dict[str, Any]
    frames_per_second: float
    angles: np.ndarray
    wrong: int
    excess: TurnExcess | None

    def row(self, name: str | None = None) -> tuple[str | float | None, ...]:
        """A row under `COLUMNS`, which begins with `name` in place of the method."""
        known = self.angles.size > 0
        return (
            name or self.method,
            self.layer,
            *(self.summary["error_mm"]["all"][key] for key in ("mean", "median", "p95", "max")),
            float(self.angles.mean()) if known else None,
            float(self.angles.max()) if known else None,
            None if self.excess is None else self.excess.excess,
            100 - self.not_converged,
            self.wrong if known else None,
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
    make: LayerMaker,
    *,
    device: str,
    refreshes: int | None = None,
) -> tuple[dict[str, MethodRun], list[MethodRun]]:
    """Fit all meshes by all methods.

    Args:
        meshes: what is fitted.
        methods: names in the hydra group ``inversion``.
        make: makes the layer that fits.
        device: of the layer.
        refreshes: in place of the method's own.

    Returns:
        Method -> its run over all meshes together; and the default method (or the last one) on each mesh.

    Raises:
        InputError: no config ``inversion/<method>`` exists.
    """
    meshes = list(meshes)
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
    assert isinstance(values, dict)
    return inversion_options({str(key): value for key, value in values.items()})


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
        far = self.angles.max(axis=1, initial=0.0) > WRONG_DEGREES
        self.wrong = int((result.converged.cpu().numpy() & far).sum())
        known = mesh.turns and self.frames > 1
        self.excess = turn_excess(layer, result.rotations, mesh.turns) if known else None


def _gathered(runs: Sequence[_Run], method: str, name: str) -> MethodRun:
    report = InversionReport(runs[0].layer.mesh, runs[0].layer.rig)
    for run in runs:
        report.merge(run.report, consecutive=False)
    return MethodRun(
        method=method,
        layer=layer_label(runs[0].layer),
        name=name,
        summary=report.as_dict(),
        frames_per_second=sum(run.frames for run in runs) / sum(run.seconds for run in runs),
        angles=np.concatenate([run.angles.ravel() for run in runs]),
        wrong=sum(run.wrong for run in runs),
        excess=max((run.excess for run in runs if run.excess), key=lambda one: one.excess, default=None),
    )


def joint_angle_errors(mesh: MovingMesh, result: InversionResult, layer: SomaLayer) -> np.ndarray:
    """Angles (F, K) [degrees] between fitted and true rotations, of joints that move enough vertices.

    K is 0 where the truth is not known.
    """
    if mesh.rotations is None:
        return np.empty((len(result.rotations), 0))
    joints = visible_joints(layer)
    return angles_between(result.rotations[:, joints], mesh.rotations[:, joints])
