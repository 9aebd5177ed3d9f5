"""A skinned rig as a fit sees it: what it moves, how far that is from a target, and how that changes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.engine import Animation
from soma_core.geometry.constants import Kind, constant
from soma_core.geometry.sparse import SparseRows
from soma_core.inversion.curvature import SkinCurvature, in_float64
from soma_core.inversion.driven import DrivenJoints
from soma_core.inversion.gauss_newton import HINGE_STIFFNESS, LONGEST_STEP, GaussNewton, damped_inverse
from soma_core.inversion.limbs import LimbStart
from soma_core.inversion.moments import RestMoments, SkinMoments
from soma_core.inversion.offsets import PoseOffsets
from soma_core.inversion.priors import TwistDoubt
from soma_core.inversion.problem import Activity, Pose, Problem, View
from soma_core.inversion.protocol import Curvature
from soma_core.inversion.start import ProcrustesStart
from soma_core.inversion.structure import MomentStructure
from soma_core.inversion.tables import solver_tables
from soma_core.kernels.model_residual import ModelResidual, Residual
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

if TYPE_CHECKING:
    from soma_core.kernels.pose_solver_wp import Factor, PoseSolver

__all__ = ["Kind", "SkinModel"]

_RIDGE = 1e-9
"""Added to the undamped matrix, relative to its mean diagonal, as in its factorisation by kernels."""

_HELD = 1e-6
"""Relative damping where skin alone counts, which leaves open how limbs share a twist."""

_INDEFINITE = 1e15
"""A variance [rad^2/m^2] that no ridge lets through: the factorisation met a pivot that is not positive."""


class SkinModel(torch.nn.Module):
    """Skinning by the joints of one rig, and the solver of its poses.

    Args:
        rig: joints and weights that carry the skin, driven ones included.
        structure: of the rig, and which vertices take part by default.
        animation: tells bone vectors.
        driven: joints whose turn follows from the pose; None without.
        offsets: what a pose adds to the rest shape; None without.
        limbs: start of the limbs' twist; None without.
        warp: run the Warp twins.

    Attributes:
        moments, solver, start: of the rig; driven joints are joints of it.
        steps, linear: kernels of the whole model, or None; whether offsets are all that it adds to skinning.
        fitted: (v,) bool, vertices that take part by default.
    """

    linear = True

    def __init__(
        self,
        rig: Rig,
        structure: MomentStructure,
        animation: Animation,
        *,
        driven: DrivenJoints | None = None,
        offsets: PoseOffsets | None = None,
        limbs: LimbStart | None = None,
        warp: bool,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        kind: Kind = {"dtype": dtype, "device": device}
        self.structure, self.fitted, self.animation = structure, structure.fitted, animation
        self.driven, self.offsets = driven, offsets
        self.moments = SkinMoments(structure, rig, warp=warp, **kind)
        self.solver = GaussNewton(structure, warp=warp, driven=driven, **kind)
        self.start = ProcrustesStart(
            structure, public_count=self.solver.public_count, limbs=limbs, warp=warp, **kind
        )
        self._warp, self._kind, self._skin = warp, kind, rig.skin
        self.steps = self._step_kernels() if self.solver.kernels is not None else None
        orient = rig.t_pose_world[:, :3, :3].copy()
        orient[0] = np.eye(3)
        self.orient = constant(orient, **kind)

    @functools.cached_property
    def skin(self) -> SparseRows:
        """Skin weights (v, T)."""
        return SparseRows(self._skin, **self._kind)

    @functools.cached_property
    def residual(self) -> ModelResidual:
        """Compares poses with targets; made when first asked for."""
        shapes = None if self.offsets is None else self.offsets.shapes
        return ModelResidual(self.skin.csr, shapes, warp=self._warp, **self._kind)

    @functools.cached_property
    def precise(self) -> SkinModel:
        """The same in float64, for products that cancel; it poses and compares, and has no moments."""
        if self.solver.eye.dtype == torch.float64:
            return self
        twin = in_float64(self, ("solver", "offsets", "driven"))
        twin._kind = {**self._kind, "dtype": torch.float64}
        for made in ("skin", "residual"):
            twin.__dict__.pop(made, None)
        twin.steps = None
        return twin

    def _step_kernels(self) -> PoseSolver:
        from soma_core.kernels.pose_solver_wp import PoseSolver

        if self.offsets is None:
            assert self.solver.kernels is not None
            return self.solver.kernels
        tables = solver_tables(self.structure, self.driven, self.offsets)
        where = self.solver.variables.device
        return PoseSolver(
            tables.counts, tables.lists, tables.numbers, dtype=self.offsets.gram.dtype, device=where
        )

    def bone_offsets(self, identity: Identity, bone_scale: Tensor | None) -> Tensor:
        """Bone vectors in T-pose world axes, of twist joints too, (i, J, 3) [m]."""
        offsets = self.animation.bone_vectors(identity, bone_scale)
        if self.driven is None:
            return offsets
        own = self.driven.offsets(identity.bind_world, bone_scale)
        batch = max(len(offsets), len(own))
        return torch.cat((offsets.expand(batch, -1, 3), own.expand(batch, -1, 3)), 1)

    def rest(self, identity: Identity, weights: Tensor, bone_scale: Tensor | None = None) -> RestMoments:
        """Moments of identities under vertex weights (1 or i, v)."""
        rest = self.moments.rest(self._whole(identity), weights, self.bone_offsets(identity, bone_scale))
        return self._with_driven(rest, identity)

    def each(
        self, vertices: Tensor, identity: Identity, weights: Tensor, bone_scale: Tensor | None
    ) -> tuple[RestMoments, Tensor, Tensor]:
        """Moments, ``R`` and origin of frames that each have an identity or vertex weights of their own."""
        offsets = self.bone_offsets(identity, bone_scale)
        rest, target, origin = self.moments.each(vertices, self._whole(identity), weights, offsets)
        return self._with_driven(rest, identity), target, origin

    def _whole(self, identity: Identity) -> Identity:
        return identity if self.driven is None else self.driven.extended(identity)

    def _with_driven(self, rest: RestMoments, identity: Identity) -> RestMoments:
        bind = self._whole(identity).bind_world
        turn = self.orient @ bind[..., :3, :3].mT
        rest = replace(rest, bind=torch.cat((turn, bind[..., :3, 3:]), -1))
        if self.driven is None:
            return rest
        return replace(rest, driven=self.driven.rest(identity.bind_world))

    def view(self, problem: Problem, pose: Pose, bound: Tensor | None = None) -> View:
        """Error of poses, and its exact derivative.

        Args:
            problem: targets, weights and identity.
            pose: about the problem's origin.
            bound: residuals beyond it count linearly, (F,) [m]; None counts all squared.
        """
        turns, places, activity, given = self._posed(problem, pose)
        found = self.residual(*given, bound)
        assert found.forces is not None
        slope, residual = self._slopes(problem, pose, turns, places, activity, found)
        return View(
            energy=found.energy, slope=slope, residual=residual, pull=found.pull, turns=turns, places=places,
            activity=activity,
        )  # fmt: skip

    def _slopes(
        self,
        problem: Problem,
        pose: Pose,
        turns: Tensor,
        places: Tensor,
        activity: Activity | None,
        found: Residual,
    ) -> tuple[Tensor, Tensor]:
        """Half the slope (F, n + 1, 3) of the error, and ``P`` (F, T, 3, 4)."""
        rest, joints = problem.rest, self.moments.joints
        assert found.forces is not None
        assert rest.bind is not None
        if self.steps is not None:
            rising = None if activity is None else activity.rising
            return self.steps.slopes(
                self.constants(rest), pose.relative, pose.translation, found.forces, found.pull, rising
            )
        bind, forces = rest.bind[:, joints], found.forces[:, joints]
        about = forces[..., :3] - forces[..., 3:] * bind[..., None, :, 3]
        residual = torch.cat((about @ bind[..., :3].mT, forces[..., 3:]), -1)
        slope = self.solver.slopes(turns, places, rest, residual)
        if self.offsets is not None and activity is not None and found.pull is not None:
            above = turns[:, self.solver.parents[: self.solver.public_count]]
            more = self.offsets.slopes(found.pull, activity, pose.relative, above)[:, self.solver.variables]
            slope = slope + torch.nn.functional.pad(more, (0, 0, 0, 1))
        return slope, residual

    def doubted(self, doubt: TwistDoubt, relative: Tensor, turns: Tensor) -> tuple[Tensor, Tensor]:
        """A doubt's share (F,) and half its derivative (F, n + 1, 3) at local rotations and world turns."""
        n = self.solver.variables
        if self.steps is None:
            rotations = relative[:, n]
            slope = doubt.slope(rotations, turns[:, self.solver.parents[n]])
            return doubt.share(rotations), torch.nn.functional.pad(slope, (0, 0, 0, 1))
        columns = self.solver.columns(doubt.variable)
        return self.steps.doubted(relative, turns, columns, doubt.axis, doubt.square.view(-1, len(columns)))

    def moved(self, problem: Problem, pose: Pose, turns: Tensor, step: Tensor) -> Pose:
        """Poses after a step (F, n + 1, 3) of :meth:`inverse`; `turns` are the world's before it."""
        if self.steps is None:
            return self.solver.retract(pose, turns, step)
        constants = self.constants(problem.rest)
        relative, hips = self.steps.moved(
            constants, pose.relative, pose.translation, step, longest=LONGEST_STEP
        )
        return replace(pose, relative=relative, translation=hips)

    def walk(self, pose: Pose, rest: RestMoments) -> tuple[Tensor, Tensor]:
        """World turns (F, J', 3, 3) and places (F, J', 3) of all joints, twist joints too."""
        if self.steps is None:
            return self.solver.walk(pose, rest)
        return self.steps.walked(self.constants(rest), pose.relative, pose.translation)

    def distances(
        self, problem: Problem, pose: Pose, *, energy_only: bool = False
    ) -> tuple[Tensor | None, Tensor]:
        """Vertex errors (F, v) [m] of poses, and the weighted sum of their squares (F,) [m^2]."""
        given = self._posed(problem, pose)[-1]
        found = self.residual(*given, gradient=False, distances=not energy_only)
        return found.distances, found.energy

    def _posed(
        self, problem: Problem, pose: Pose
    ) -> tuple[Tensor, Tensor, Activity | None, tuple[Tensor | None, ...]]:
        """Turns and places of all joints, activations, and what :class:`ModelResidual` takes."""
        if self.steps is None:
            turns, places = self.solver.walk(pose, problem.rest)
            activity = None if self.offsets is None else self.offsets.activity(pose.relative)
            return turns, places, activity, self.posing(problem, turns, places, activity)
        constants = self.constants(problem.rest)
        turns, places, transforms, value, before, rising = self.steps.posed(
            constants, pose.relative, pose.translation
        )
        activity = None
        if self.offsets is not None:
            activity = Activity(value=value)
            if self.offsets.first is not None:
                activity = Activity(value=value, before=before, slope=rising)
        return turns, places, activity, self._given(problem, transforms, activity)

    def posing(
        self, problem: Problem, turns: Tensor, places: Tensor, activity: Activity | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None, Tensor, Tensor]:
        """What :class:`ModelResidual` takes."""
        bind = self._whole(problem.identity).bind_world
        turn = turns @ (self.orient @ bind[..., :3, :3].mT)
        shift = places - (turn @ bind[..., :3, 3:]).squeeze(-1)
        return self._given(problem, torch.cat((turn, shift[..., None]), -1), activity)

    def _given(
        self, problem: Problem, transforms: Tensor, activity: Activity | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None, Tensor, Tensor]:
        value = scale = None
        if activity is not None:
            value, scale = activity.value, self.scale(problem).expand(len(transforms))
        return (
            problem.identity.rest, problem.weights, transforms, value, scale, problem.vertices,
            problem.origin,
        )  # fmt: skip

    def inverse(
        self, problem: Problem, pose: Pose, view: View, damping: Tensor, mass: Tensor
    ) -> Callable[[Tensor], Tensor]:
        """Maps slopes (F, n + 1, 3) to steps: the inverse of the damped matrix, terms included.

        Args:
            problem, pose, view: where.
            damping: (F,) relative to the diagonal.
            mass: (F,) sums of the vertex weights.
        """
        if self.steps is None:
            matrix = self._with_terms(problem, pose, view.turns, view.places, view.activity, mass)
            return damped_inverse(matrix, damping)
        steps, factor = self.steps, self._factor(problem, pose, view.activity, damping, mass)
        return lambda slope: steps.solve(factor, slope)

    def angle_variance(self, problem: Problem, pose: Pose) -> Tensor:
        """Mean square angle (F, n) [rad^2] of each variable's own turn under vertex noise of variance 1 m^2.

        Traces of the 3 x 3 diagonal blocks of the inverse of the undamped matrix, terms included. Products of
        modes are those of equal weights: where that leaves no positive definite matrix, skin alone counts.
        """
        typical = problem.weights.sum(1) / max(int(self.fitted.sum()), 1)
        own, second = (one / typical[:, None, None, None] for one in (problem.rest.own, problem.rest.second))
        problem = replace(problem, rest=replace(problem.rest, own=own, second=second))
        mass = (problem.weights.sum(1) / typical).expand(len(pose.translation))
        if self.offsets is None:
            return self._variance(problem, pose, None, mass) / typical[:, None]
        _, _, activity, _ = self._posed(problem, pose)
        assert activity is not None
        found = self._variance(problem, pose, activity, mass)
        if not bool(found.isfinite().all()):
            still = replace(activity, slope=torch.zeros_like(activity.value))
            found = torch.where(found.isfinite(), found, self._variance(problem, pose, still, mass, _HELD))
        return found / typical[:, None]

    def _variance(
        self, problem: Problem, pose: Pose, activity: Activity | None, mass: Tensor, damping: float = 0.0
    ) -> Tensor:
        """The same for weights of one on average; NaN for frames whose matrix is not positive definite."""
        if self.steps is not None:
            damped = torch.full_like(mass, damping)
            found = self.steps.variances(self._factor(problem, pose, activity, damped, mass))
            return found.where(found.amax(1, keepdim=True) < _INDEFINITE, torch.nan)
        dense = self._with_terms(problem, pose, *self.walk(pose, problem.rest), activity, mass)
        dense = dense.flatten(3, 4).flatten(1, 2)
        diagonal = dense.diagonal(dim1=-2, dim2=-1)
        diagonal += damping * diagonal + _RIDGE * diagonal.mean(1, keepdim=True)
        factor, failed = torch.linalg.cholesky_ex(dense)
        still = torch.eye(dense.shape[1], dtype=dense.dtype, device=dense.device)
        factor = torch.where(failed[:, None, None] > 0, still, factor)  # a zero pivot would raise
        own = torch.cholesky_inverse(factor).diagonal(dim1=-2, dim2=-1)
        return own.unflatten(1, (-1, 3)).sum(-1)[:, :-1].masked_fill((failed > 0)[:, None], torch.nan)

    def _factor(
        self, problem: Problem, pose: Pose, activity: Activity | None, damping: Tensor, mass: Tensor
    ) -> Factor:
        """The damped matrix, terms included, factorised by kernels."""
        assert self.steps is not None
        slope = scale = None
        if activity is not None:
            slope, scale = activity.rising, self.scale(problem).expand(len(mass))
        return self.steps.factorise(
            self.constants(problem.rest), pose.relative, pose.translation, damping, mass, slope, scale,
            stiffness=HINGE_STIFFNESS, soft=self.solver.soft(problem.terms, pose.translation),
        )  # fmt: skip

    def constants(self, rest: RestMoments) -> tuple[Tensor, bool]:
        """What kernels take of identities."""
        made_of = (rest.second, rest.own, rest.offsets)
        known = rest.memo.get(self)
        if known is not None and all(one is two for one, two in zip(known[0], made_of, strict=True)):
            return known[1]
        assert rest.bind is not None
        sizes = () if self.offsets is None else self.offsets.sizes(rest)
        found = self.solver.constants(rest, rest.bind, *sizes)
        rest.memo[self] = made_of, found
        return found

    def _with_terms(
        self,
        problem: Problem,
        pose: Pose,
        turns: Tensor,
        places: Tensor,
        activity: Activity | None,
        mass: Tensor,
    ) -> Tensor:
        """Matrix (F, n + 1, 3, n + 1, 3) of the model and the terms."""
        matrix = self.matrix(problem, pose, turns, places, activity)
        if problem.terms is not None:
            slope = torch.zeros_like(matrix[:, 0, 0])
            self.solver.add_terms(matrix, slope, pose.relative, turns, problem.terms, mass)
        return matrix

    def curvature(self, problem: Problem, pose: Pose) -> Curvature:
        """The exact curvature of the error at poses."""
        return SkinCurvature(self, problem, pose)

    def matrix(
        self, problem: Problem, pose: Pose, turns: Tensor, places: Tensor, activity: Activity | None
    ) -> Tensor:
        """Gauss-Newton matrix (F, n + 1, 3, n + 1, 3) of the whole model at a pose."""
        matrix, _ = self.solver.normal_equations(turns, places, problem.rest)
        if self.offsets is None or activity is None:
            return matrix
        fold = None if self.driven is None else self.solver.fold(turns, problem.rest)
        scale = self.scale(problem).expand(len(turns))
        sizes = self.offsets.sizes(problem.rest)
        return matrix + self.offsets.matrix(
            activity, pose.relative, turns, places, self.solver, fold, scale, sizes
        )

    def scale(self, problem: Problem) -> Tensor:
        """Size of the bodies beside the canonical one, (1 or F,)."""
        return problem.origin.new_ones(1)
