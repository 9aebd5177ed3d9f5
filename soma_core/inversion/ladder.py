"""The ladder of stages that takes a chunk of frames from its vertices to a pose (paper, section 3.6)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from soma_core.geometry.constants import Kind
from soma_core.inversion.analytical import Analytical
from soma_core.inversion.autograd import Autograd
from soma_core.inversion.model import PoseModel
from soma_core.inversion.priors import hinge_rotation
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.regions import body_regions
from soma_core.inversion.start import best_translation
from soma_core.inversion.targets import LadderOptions, Stage, Targets
from soma_core.inversion.transfer import SkeletonTransfer
from soma_core.inversion.whole import WholeFit
from soma_core.layer import SomaLayer
from soma_core.rig import load_canonical

__all__ = ["Ladder"]

_STARTS = ("procrustes", "transfer")

_ON_THE_WAY = 1e-3
"""Tolerance of steps on moments where the whole model is fitted after them [m]: offsets move more."""


class Ladder(torch.nn.Module):
    """Runs the stages in order, each from the result of the one before.

    Args:
        layer: the forward model.
        options: which stages, and how.
        warp: run the Warp twins.

    Attributes:
        model: what is fitted in the end.
        whole: descends on the full model, or on residuals that are clipped.
    """

    def __init__(self, layer: SomaLayer, options: LadderOptions, *, warp: bool) -> None:
        super().__init__()
        self.options = options
        plain = layer.plain or not options.refreshes or options.skinning == "plain"
        self.model = PoseModel(layer, plain=plain, warp=warp)
        self.coarse = self.skinned = self.model
        if not plain and layer.mesh.lod == "mid":
            low = load_canonical("low", layer.mesh.root)[0]
            self.coarse = PoseModel(layer, plain=False, warp=warp, some=low.mid_ids)
        paper = set(options.stages) - {"procrustes", "gauss_newton"}
        if paper and not plain:
            self.skinned = PoseModel(layer, plain=True, warp=warp)
        self.plain, self.whole = plain, WholeFit(self.coarse, self.model, options)
        solver, structure = self.skinned.solver, self.skinned.structure
        if "transfer" in options.stages:
            kind: Kind = {"dtype": layer.dtype, "device": layer.device}
            self.skeleton = SkeletonTransfer(structure, layer.mesh, layer.rig, **kind)
        if "analytical" in options.stages:
            self.analytical = Analytical(structure, layer.rig, solver, options=options.analytical)
        if "autograd" in options.stages:
            regions = body_regions(layer.mesh, layer.rig)
            self.autograd = Autograd(solver, layer.animation, regions=regions, options=options.autograd)

    @property
    def models(self) -> tuple[PoseModel, ...]:
        """All forward models in use."""
        return tuple(dict.fromkeys((self.model, self.coarse, self.skinned)))

    def forward(self, targets: Targets, pose: Pose | None = None) -> tuple[Pose, Problem]:
        """Fit a chunk of frames; a pose's translation is a place in the world.

        Args:
            targets: what to fit.
            pose: a warm start in place of the starting stages.

        Returns:
            The pose, and the problem of the model that was fitted last.
        """
        problem, model = None, self.model
        for stage in self.options.stages:
            if pose is not None and stage in _STARTS:
                continue
            model = self._model_of(stage)
            problem = targets.problem(model)
            near = None if pose is None else _moved(pose, -problem.origin)
            pose = _moved(getattr(self, f"_{stage}")(problem, near, model), problem.origin)
        assert pose is not None
        if targets.robust is not None or ("gauss_newton" in self.options.stages and not self.plain):
            return self.whole(targets, pose)
        if problem is None or model is not self.model:
            problem = targets.problem(self.model)
        if "gauss_newton" in self.options.stages:
            pose = _moved(self.whole.settled(problem, _moved(pose, -problem.origin)), problem.origin)
        return pose, problem

    def _model_of(self, stage: Stage) -> PoseModel:
        return self.coarse if stage in ("procrustes", "gauss_newton") else self.skinned

    def _procrustes(self, problem: Problem, _pose: Pose | None, model: PoseModel) -> Pose:
        """Weighted Procrustes of every joint's own points."""
        return placed(model, problem, model.start(problem.target, problem.rest))

    def _transfer(self, problem: Problem, _pose: Pose | None, model: PoseModel) -> Pose:
        """The skeleton fit of the posed mesh."""
        return placed(model, problem, self.skeleton(problem))

    def _analytical(self, problem: Problem, pose: Pose | None, model: PoseModel) -> Pose:
        """Inverse skinning, level by level."""
        start = pose or self._procrustes(problem, None, model)
        return self.analytical(problem.target, problem.rest, start)

    def _gauss_newton(self, problem: Problem, pose: Pose | None, model: PoseModel) -> Pose:
        """Levenberg-Marquardt on the moments."""
        return model.solver(
            problem.target,
            problem.rest,
            pose or self._procrustes(problem, None, model),
            iterations=self.options.iterations,
            tolerance=self.options.tolerance if self.plain else max(self.options.tolerance, _ON_THE_WAY),
            terms=problem.terms,
        )

    def _autograd(self, problem: Problem, pose: Pose | None, model: PoseModel) -> Pose:
        """Adam, with the weights of regions."""
        pose = pose or self._procrustes(problem, None, model)
        if self.autograd.regions:
            weights = self.autograd.weighted(problem.weights)
            rest = model.rest(problem.identity, weights, problem.bone_scale)
            target, origin = model.moments.target(problem.vertices, rest)
            pose = _moved(pose, problem.origin - origin)
            problem = replace(problem, weights=weights, rest=rest, target=target, origin=origin)
        return self.autograd(problem, pose)


def placed(model: PoseModel, problem: Problem, relative: Tensor) -> Pose:
    """A start: rotations, hinges kept to their axis, and the Hips where the mean residual is zero."""
    rest, joints, n = problem.rest, model.moments.joints, model.solver.variables
    if problem.terms is not None:
        hinged = hinge_rotation(relative[:, n], problem.terms.hinge_axis)
        relative = relative.index_copy(1, n, hinged)
    pose = Pose.begin(relative, torch.zeros_like(problem.origin))
    turns, places = model.walk(pose, rest)
    shift = best_translation(problem.target, rest, turns[:, joints], places[:, joints])
    return replace(pose, translation=shift)


def _moved(pose: Pose, shift: Tensor) -> Pose:
    return replace(pose, translation=pose.translation + shift)
