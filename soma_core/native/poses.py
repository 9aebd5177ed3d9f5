"""Best poses of one native body: aligned joint by joint, then by least squares under the whole model."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from soma_core.inversion.priors import JointTerms
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.refine import Refinement
from soma_core.inversion.start import best_translation
from soma_core.native.model import NativeBody, NativeRig

__all__ = ["PoseFit"]

_SKIN_ITERATIONS = 40
"""Largest number of steps before blend shapes come in; they cost next to nothing."""


class PoseFit:
    """Fits poses of one body.

    Args:
        rig: of the model.
        body: which body.
        weights: (n,) of its vertices.
        iterations: largest number of steps under the whole model.
        tolerance: a frame rests once a step would change the vertices by less, as a root mean square [m].

    Attributes:
        rest: moments of the body without blend shapes.
        body, weights: as given.
    """

    def __init__(
        self, rig: NativeRig, body: NativeBody, weights: Tensor, *, iterations: int, tolerance: float
    ) -> None:
        self.rig, self.body, self.weights = rig, body, weights
        self._iterations, self._tolerance = iterations, tolerance
        self.rest = rig.rest(body.identity, weights[None])

    def __call__(self, target: Tensor, terms: JointTerms | None = None) -> Pose:
        """Poses for finite targets (F, n, 3) [m] under terms; translations are places of the root joint."""
        problem = self.problem(target, terms)
        pose = self._skinned(problem)
        if self.rig.blended and self._iterations:
            pose = replace(pose, accepted=torch.zeros_like(pose.accepted))
            pose = Refinement(self.rig, problem)(pose, iterations=self._iterations, tolerance=self._tolerance)
        return replace(pose, translation=pose.translation + problem.origin)

    def problem(self, target: Tensor, terms: JointTerms | None = None) -> Problem:
        """The problem of targets (F, n, 3) [m] under terms."""
        return replace(self.rig.problem(target, self.body.identity, self.weights, self.rest), terms=terms)

    def posed(self, pose: Pose) -> Tensor:
        """Vertices (F, n, 3) [m] of poses."""
        return self.rig.posed(self.body.identity, pose.relative[:, 1:], pose.translation)

    def _skinned(self, problem: Problem) -> Pose:
        """Best poses without blend shapes, about the problem's origin."""
        rig, rest = self.rig, self.rest
        pose = Pose.begin(rig.start(problem.target, rest), torch.zeros_like(problem.origin))
        joints = rig.moments.joints
        turns, places = rig.walk(pose, rest)
        shift = best_translation(problem.target, rest, turns[:, joints], places[:, joints])
        pose = replace(pose, translation=shift)
        return rig.solver(
            problem.target, rest, pose, iterations=_SKIN_ITERATIONS, tolerance=self._tolerance,
            terms=problem.terms,
        )  # fmt: skip
