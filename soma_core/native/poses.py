"""Best poses of one native body: aligned joint by joint, then by least squares under the whole model."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from soma_core.inversion.problem import Pose
from soma_core.inversion.start import best_translation
from soma_core.native.blend import BlendMoments
from soma_core.native.model import NativeBody, NativeRig
from soma_core.native.refine import Refinement

__all__ = ["PoseFit"]

_SKIN_ITERATIONS = 40
"""Largest number of steps before blend shapes come in; they cost next to nothing."""

_BURST = 4
"""Steps under the whole model after which frames that have converged are left alone: most have by then."""


class PoseFit:
    """Fits poses of one body.

    Args:
        rig: of the model.
        body: which body.
        weights: (n,) of its vertices.
        iterations: largest number of steps under the whole model.
        tolerance: a frame rests once a step changed its energy by less, as a root mean square [m].
        blend: moments of the blend shapes of a similar body under the same weights, which save making
            those of this one: steps depend on them, the minimum does not.

    Attributes:
        rest: moments of the body without blend shapes.
        body, weights: as given.
        blend: moments of the blend shapes; None where there are none.
    """

    def __init__(
        self,
        rig: NativeRig,
        body: NativeBody,
        weights: Tensor,
        *,
        iterations: int,
        tolerance: float,
        blend: BlendMoments | None = None,
    ) -> None:
        self.rig, self.body, self.weights = rig, body, weights
        self._iterations, self._tolerance = iterations, tolerance
        offsets = rig.animation.bone_vectors(body.identity)
        self.rest = rig.moments.rest(body.identity, weights[None], offsets)
        self.blend = blend
        if rig.blended and iterations and blend is None:
            self.blend = BlendMoments(rig.blend_shapes, rig.moments, self.rest, weights, rig.above)

    def __call__(self, target: Tensor) -> Pose:
        """Poses for finite targets (F, n, 3) [m]; translations are places of the root joint."""
        pose = self._skinned(target)
        if self.blend is None:
            return pose
        pose = replace(pose, accepted=torch.zeros_like(pose.accepted))
        rows = torch.arange(len(target), device=target.device)
        for done in range(0, self._iterations, _BURST):
            if not len(rows):
                break
            whole = Refinement(
                rig=self.rig, body=self.body, rest=self.rest, blend=self.blend, target=target[rows],
                weights=self.weights,
            )  # fmt: skip
            steps = min(_BURST, self._iterations - done)
            part = whole(_rows(pose, rows), iterations=steps, tolerance=self._tolerance)
            pose = _put(pose, rows, part)
            rows = rows[part.last_change >= self._tolerance]
        return pose

    def matrix(self, pose: Pose, turns: Tensor, places: Tensor) -> Tensor:
        """Gauss-Newton matrix (F, n + 1, 3, n + 1, 3) of the whole model at poses with these joints."""
        solver = self.rig.solver
        none = turns.new_zeros(len(turns), len(solver.joints), 3, 4)
        matrix, _ = solver.normal_equations(turns, places, self.rest.second, none)
        if self.blend is None:
            return matrix
        return matrix + self.blend.matrix(pose.relative, turns, places, solver)

    def posed(self, pose: Pose) -> Tensor:
        """Vertices (F, n, 3) [m] of poses."""
        return self.rig.posed(self.body, pose.relative[:, 1:], pose.translation)

    def _skinned(self, target: Tensor) -> Pose:
        rig, rest = self.rig, self.rest
        moments, origin = rig.moments.target(target, rest)
        pose = Pose.begin(rig.start(moments, rest), torch.zeros_like(origin))
        joints = rig.moments.joints
        turns, places = rig.solver.walk(pose, rest.offsets)
        shift = best_translation(moments, rest, turns[:, joints], places[:, joints])
        pose = replace(pose, translation=shift)
        pose = rig.solver(moments, rest, pose, iterations=_SKIN_ITERATIONS, tolerance=self._tolerance)
        return replace(pose, translation=pose.translation + origin)


def _rows(pose: Pose, rows: Tensor) -> Pose:
    return Pose(**{name: value[rows] for name, value in vars(pose).items()})


def _put(pose: Pose, rows: Tensor, part: Pose) -> Pose:
    old = vars(pose)
    return Pose(**{name: old[name].index_copy(0, rows, value) for name, value in vars(part).items()})
