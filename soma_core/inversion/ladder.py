"""The ladder of stages that takes a chunk of frames from its moments to a pose (paper, section 3.6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.inversion.analytical import Analytical, AnalyticalOptions
from soma_core.inversion.autograd import Autograd, AutogradOptions
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import SkinMoments
from soma_core.inversion.outer import OuterLoop
from soma_core.inversion.priors import hinge_rotation
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.regions import body_regions
from soma_core.inversion.start import ProcrustesStart, best_translation
from soma_core.inversion.structure import MomentStructure
from soma_core.inversion.transfer import SkeletonTransfer
from soma_core.layer import SomaLayer

__all__ = ["Ladder", "LadderOptions", "Stage"]

Stage = Literal["procrustes", "transfer", "analytical", "gauss_newton", "autograd"]

_STARTS = ("procrustes", "transfer")


@dataclass(frozen=True, kw_only=True)
class LadderOptions:
    """What to do with a chunk of frames.

    Attributes:
        stages: in order: ``procrustes`` or ``transfer`` starts; ``analytical``, ``gauss_newton`` and
            ``autograd`` refine.
        iterations: largest number of steps of ``gauss_newton``.
        tolerance: a frame has converged when a step changes its root mean square error, squared, by less
            than this, squared [m].
        analytical, autograd: options of these stages.
        robust: residuals beyond this, and beyond twice the frame's median, count linearly (Huber) [m]; None
            is least squares.
        robust_rounds: how often the residuals are looked at again.
        refreshes: how often what the full model adds to skinning, twist and correctives, is looked at again;
            0 ignores it.

    Raises:
        InputError: an unknown stage, a negative number of iterations or refreshes, a negative tolerance, a
            robust scale of zero or less.
    """

    stages: Sequence[Stage] = ("procrustes", "gauss_newton")
    iterations: int = 40
    tolerance: float = 2e-5
    analytical: AnalyticalOptions = field(default_factory=AnalyticalOptions)
    autograd: AutogradOptions = field(default_factory=AutogradOptions)
    robust: float | None = None
    robust_rounds: int = 10
    refreshes: int = 6

    def __post_init__(self) -> None:
        names = get_args(Stage)
        for stage in self.stages:
            if stage not in names:
                among = "among " + ", ".join(names)
                raise InputError("stages", got=repr(stage), expected=among, fix="Correct the name.")
        if not self.stages:
            raise InputError("stages", got="none", expected="at least one", fix="Use 'procrustes'.")
        if self.iterations < 0:
            raise InputError(
                "iterations", got=self.iterations, expected="at least 0", fix="Pass iterations=40."
            )
        if self.refreshes < 0:
            raise InputError("refreshes", got=self.refreshes, expected="at least 0", fix="Pass refreshes=6.")
        if not self.tolerance >= 0:
            raise InputError(
                "tolerance", got=self.tolerance, expected="a length [m]", fix="Pass tolerance=5e-5."
            )
        if self.robust is not None and not self.robust > 0:
            raise InputError("robust", got=self.robust, expected="a length [m]", fix="Pass 0.01, or None.")


class Ladder(torch.nn.Module):
    """Runs the stages in order, each from the result of the one before.

    Args:
        layer: the forward model.
        structure, moments: of its rig.
        options: which stages, and how.
        warp: run the Warp twins.
    """

    def __init__(
        self,
        layer: SomaLayer,
        structure: MomentStructure,
        moments: SkinMoments,
        options: LadderOptions,
        *,
        warp: bool,
    ) -> None:
        super().__init__()
        self.moments, self.options = moments, options
        plain = layer.plain or not options.refreshes
        self.outer = OuterLoop(layer, moments, plain=plain, robust=options.robust)
        kind = {"dtype": layer.dtype, "device": layer.device}
        self.solver = GaussNewton(structure, warp=warp, **kind)
        self.start = ProcrustesStart(structure, **kind)
        if "transfer" in options.stages:
            self.skeleton = SkeletonTransfer(structure, layer.mesh, layer.rig, **kind)
        if "analytical" in options.stages:
            self.analytical = Analytical(structure, layer.rig, self.solver, options=options.analytical)
        if "autograd" in options.stages:
            regions = body_regions(layer.mesh, layer.rig)
            self.autograd = Autograd(self.solver, layer.animation, regions=regions, options=options.autograd)

    def forward(self, problem: Problem, pose: Pose | None = None) -> Pose:
        """Fit a chunk of frames; `pose` is a warm start in place of the starting stages."""
        for stage in self.options.stages:
            if pose is None or stage not in _STARTS:
                pose = getattr(self, f"_{stage}")(problem, pose)
        assert pose is not None
        rounds = self.options.robust_rounds if self.options.robust is not None else 0
        if not self.outer.plain:
            rounds = max(rounds, self.options.refreshes)
        if rounds:
            pose = self.outer(problem, pose, self._refined, rounds=rounds)
        return pose

    def _procrustes(self, problem: Problem, _pose: Pose | None) -> Pose:
        """Weighted Procrustes of every joint's own points."""
        return self._placed(problem, self.start(problem.target, problem.rest))

    def _transfer(self, problem: Problem, _pose: Pose | None) -> Pose:
        """The skeleton fit of the posed mesh."""
        return self._placed(problem, self.skeleton(problem))

    def _placed(self, problem: Problem, relative: Tensor) -> Pose:
        """A start: rotations, hinges kept to their axis, and the Hips where the mean residual is zero."""
        rest, joints, n = problem.rest, self.moments.joints, self.solver.variables
        if problem.terms is not None:
            hinged = hinge_rotation(relative[:, n], problem.terms.hinge_axis)
            relative = relative.index_copy(1, n, hinged)
        pose = Pose.begin(relative, torch.zeros_like(problem.origin))
        turns, places = self.solver.walk(pose, rest.offsets)
        shift = best_translation(problem.target, rest, turns[:, joints], places[:, joints])
        return replace(pose, translation=shift)

    def _analytical(self, problem: Problem, pose: Pose | None) -> Pose:
        """Inverse skinning, level by level."""
        return self.analytical(problem.target, problem.rest, pose or self._procrustes(problem, None))

    def _gauss_newton(self, problem: Problem, pose: Pose | None) -> Pose:
        """Levenberg-Marquardt on the moments."""
        return self.solver(
            problem.target,
            problem.rest,
            pose or self._procrustes(problem, None),
            iterations=self.options.iterations,
            tolerance=self.options.tolerance,
            terms=problem.terms,
        )

    def _autograd(self, problem: Problem, pose: Pose | None) -> Pose:
        """Adam, with the weights of regions."""
        pose = pose or self._procrustes(problem, None)
        if self.autograd.regions:
            weights = self.autograd.weighted(problem.weights)
            rest = self.moments.rest(problem.identity, weights, problem.rest.offsets)
            target, _ = self.moments.target(problem.vertices, rest)
            problem = replace(problem, weights=weights, rest=rest, target=target)
        return self.autograd(problem, pose)

    def _refined(self, problem: Problem, pose: Pose) -> Pose:
        """The last refining stage, from a pose near its solution; Gauss-Newton where there is none."""
        refining = [stage for stage in self.options.stages if stage not in _STARTS] or ["gauss_newton"]
        return getattr(self, f"_{refining[-1]}")(problem, pose)
