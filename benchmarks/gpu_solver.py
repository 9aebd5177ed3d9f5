"""The pose solver's kernels on the device against the torch reference in float64 on the CPU."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import torch
from gpu_kernels import Twin, Values, randn, turns_of
from torch import Tensor

from soma_core.inversion.model import PoseModel
from soma_core.inversion.problem import Pose, Problem
from soma_core.layer import SomaLayer

__all__ = ["solver_twins"]

KINDS = {
    "plain": {"procedural": False, "correctives": None},
    "driven": {"correctives": None},
    "whole": {},
}
"""Public joints alone, with twist joints, and with correctives as well."""
BOUNDS = {
    "walk": (1e-5, 1e-10), "view": (1e-4, 1e-9), "moved": (1e-5, 1e-10), "steps": (1e-3, 1e-8),
    "solve": (2e-3, 1e-6), "variance": (2e-3, 1e-6),
}  # fmt: skip
LEFT_OUT = 0.03
"""The kernel's matrix of the whole model leaves small products of modes out."""


@functools.cache
def _model(kind: str, dtype: torch.dtype, device: torch.device, *, warp: bool) -> tuple[SomaLayer, PoseModel]:
    kernels = "auto" if warp else "torch"
    layer = SomaLayer("soma", lod="low", dtype=dtype, device=device, kernels=kernels, **KINDS[kind])
    return layer, PoseModel(layer, plain=kind == "plain", warp=warp)


def solver_twins(_lod: str, count: int) -> Iterator[Twin]:
    """For each kind of forward model: walking, looking, moving, stepping, solving, variances."""
    count = min(count, 20)
    joints = 77
    near = turns_of(count, joints, 0.25, 1)
    away = turns_of(count, joints, 0.05, 2) @ near
    hips = 0.3 * randn(count, 3, seed=3)
    for kind in KINDS:
        layer, _ = _model(kind, torch.float64, torch.device("cpu"), warp=False)
        identity = layer.identity({"shape": randn(1, 16, seed=4)})
        seen = layer.pose(identity, near, hips).vertices
        seen = seen + 0.005 * randn(*seen.shape, seed=5)
        given = (seen.detach(), away, hips + 0.02)
        steps = ("steps",) if kind != "whole" else ()
        for what in ("walk", "view", "moved", *steps, "solve", "variance"):
            single, double = BOUNDS[what]
            if kind == "whole" and what in ("solve", "variance"):
                single, double = single + LEFT_OUT, LEFT_OUT
            yield Twin(
                name=f"solver {what} {kind}", build=functools.partial(_build, kind, what), inputs=given,
                bounds=(single, double), relative=what in ("view", "solve", "variance"),
                double_only=what == "variance" and kind != "plain",
            )  # fmt: skip


def _build(kind: str, what: str, dtype: torch.dtype, device: torch.device, *, warp: bool):
    layer, model = _model(kind, dtype, device, warp=warp)

    def run(seen: Tensor, turns: Tensor, hips: Tensor) -> Values:
        identity = layer.identity({"shape": randn(1, 16, seed=4).to(device, dtype)})
        weights = torch.as_tensor(model.fitted, dtype=dtype, device=device)[None]
        problem = model.problem(seen, identity, weights, None, None, None)
        eye = torch.eye(3, dtype=dtype, device=device).expand(len(turns), 1, 3, 3)
        pose = Pose.begin(torch.cat((eye, turns), 1), hips - problem.origin)
        return _asked(what, model, problem, pose)

    return run


def _asked(what: str, model: PoseModel, problem: Problem, pose: Pose) -> Values:
    frames, variables = len(pose.translation), len(model.solver.variables)
    step = randn(frames, variables + 1, 3, seed=9).to(pose.translation)
    if what == "walk":
        return tuple(model.walk(pose, problem.rest))
    if what == "view":
        view = model.view(problem, pose)
        return view.energy, view.slope, view.residual
    if what == "moved":
        turns, _ = model.walk(pose, problem.rest)
        moved = model.moved(problem, pose, turns, model.solver.shortened(0.3 * step, turns, None))
        return moved.relative, moved.translation
    if what == "steps":
        end = model.solver(problem.target, problem.rest, pose, iterations=4)
        return (model.walk(end, problem.rest)[1],)
    if what == "variance":
        return (model.angle_variance(problem, pose),)
    mass = problem.weights.sum(1).expand(frames)
    damping = torch.full_like(mass, 1e-4)
    return (model.inverse(problem, pose, model.view(problem, pose), damping, mass)(step),)
