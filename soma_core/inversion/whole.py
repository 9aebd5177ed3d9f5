"""The way down on the full model: twist joints and correctives, or residuals that are clipped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from soma_core.inversion.limbs import Limb
from soma_core.inversion.model import PoseModel
from soma_core.inversion.priors import JointTerms
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.refine import Refinement, clumping
from soma_core.inversion.result import InversionResult
from soma_core.inversion.targets import LadderOptions, Targets

__all__ = ["FEW", "WholeFit", "is_worse", "lopsided", "of_another_rig", "right_vertices"]

_ROUNDS, _STEPS = 2, 3
"""How often offsets and limbs' twists are looked at before the descent, and steps on moments after each."""

_KEPT = 8e-3
"""Strength that keeps the joint below an upper arm or a thigh while moments are fitted [m/rad]: far above
what tells its twist, far below what tells how it bends."""

_RESTING, _RESTING_SHARE, _COARSE_SHARE = 1.5e-7, 1e-2, 2e-2
"""A frame rests where a Newton step would change it by less, as a root mean square of its vertices [m], or
relative to the error that is left; the last on the way, on few vertices, whose minimum is another."""

_AT_ONCE = (5, 0)
"""Steps that all frames take together: on the way, and at the end, where most rest before the first."""

_SAMPLED = 8
"""Every so many vertices have a say in a frame's median residual."""

_DOUBTFUL = (1e-6, 8e-4)
"""A root mean square error [m] between these is more than rounding and less than noise: such a frame may rest
in a fold of the correctives beside its minimum, and is tried from further limb twists."""

_LOPSIDED, _FAINT = 0.1, 1e-5
"""Median over root mean square error that is too little: 0.9 where noise is left, 0.14 to 0.47 on meshes of
another rig; 0.01 to 0.08, seldom up to 0.14, where limbs stopped in a wrong place. Then the error [m] below
which all is well: every fit of what the model posed ends there."""

_OF_ONE_PIECE = 0.1
"""Least :func:`clumping` of what another rig's skin leaves: at least 0.4 on meshes of Anny's own rig, at most
0.03 where noise is left."""

_WRONG = 2.0
"""A vertex is wrong where its residual is this many times as long as one that begins to count linearly: four
times the median, which noise hardly reaches."""

_TRIED, _FAR = ((0.2, -0.2), (0.45, -0.45)), (0.8, -0.8, 1.6, -1.6, 2.4, -2.4, 3.1)
"""Those twists, against what was found [rad]: pairs, the second for what the first leaves in doubt; then, of
one limb after the other, for what lies on few of the vertices."""


FEW, _FEWEST, _ANOTHER, _AGAIN = 0.5, 0.15, 0.3, 2
"""A limb may be what is wrong where median over root mean square error is less than the first: up to 0.41
where limbs stopped in a wrong place, 0.9 where noise is left. Not where it is more than the second and
:func:`clumping` more than the third while another rig is not ruled out: at least 0.17 and 0.33 there, where
plain skinning is fitted. How often that is looked at."""

_AT_FIRST, _BEST, _HOPELESS, _ARRIVING = 5, 2, (3.0, 1e-4), 0.1
"""Steps from every start of a limb, and how many starts of a frame go on after them: none whose error is that
many times what was found before and above a length [m], and one alone where its error is that share of it."""


class _Clip(NamedTuple):
    """Lengths (F,) [m]: residuals beyond `bound` count linearly; the median residual is `typical`."""

    bound: Tensor
    typical: Tensor


def median_distance(distances: Tensor, weights: Tensor) -> Tensor:
    """About the median (F,) of distances (F, v) of the vertices that count under weights (1 or F, v)."""
    counted = (weights > 0).expand_as(distances)[:, ::_SAMPLED]
    some = distances[:, ::_SAMPLED].masked_fill(~counted, torch.nan)
    return some.nanmedian(1).values.nan_to_num(0.0)


def lopsided(distances: Tensor, weights: Tensor, residual: Tensor, least: float = _LOPSIDED) -> Tensor:
    """Whether what is left of frames lies on few of their vertices, (F,): neither noise nor another rig.

    Args:
        distances: vertex errors (F, v) [m].
        weights: (1 or F, v).
        residual: root mean square error (F,) [m].
        least: median over root mean square error that is enough.
    """
    large = residual > _FAINT
    if not bool(large.any()):
        return large
    return large & (median_distance(distances, weights) < least * residual)


def of_another_rig(model: PoseModel, problem: Problem, result: InversionResult) -> Tensor:
    """Numbers of the frames whose error is no noise, of one piece and not on few of the vertices.

    Args:
        model: that was fitted.
        problem: that was answered.
        result: the answer.
    """
    left = result.vertex_error, problem.weights, result.residual
    large = result.valid & ((result.residual > _DOUBTFUL[1]) | lopsided(*left, FEW)) & ~lopsided(*left)
    rows = torch.nonzero(large).flatten()
    if not len(rows):
        return rows
    many = problem.several(rows)
    part = problem.part(many)
    view = model.view(part, result.part(many).pose(part.origin))
    pieces = clumping(model, view, part.weights.sum(1).expand(len(many)))[: len(rows)]
    return rows[pieces > _OF_ONE_PIECE]


def _clip(distances: Tensor, weights: Tensor, robust: float) -> _Clip:
    """Where distances (F, v) begin to count linearly."""
    typical = median_distance(distances, weights)
    return _Clip(bound=(2 * typical).clamp_min(robust), typical=typical)


def right_vertices(distances: Tensor, weights: Tensor, robust: float) -> Tensor:
    """Weights (F, v) of the vertices that are not wrong; a frame without any distance keeps its own.

    Args:
        distances: vertex errors (F, v) of a robust fit [m], NaN where there is none.
        weights: (1 or F, v).
        robust: see :class:`LadderOptions`.
    """
    bound = _clip(distances, weights, robust).bound
    right = distances < _WRONG * bound[:, None]
    return torch.where(right | ~right.any(1, keepdim=True), weights, 0.0)


def is_worse(second: Tensor, first: Tensor, weights: Tensor, robust: float) -> Tensor:
    """Whether a second fit explains frames (F,) clearly less than the first, wrong vertices apart.

    Args:
        second, first: their vertex errors (F, v) [m]; none counts more than the longest that is right.
        weights: (1 or F, v).
        robust: see :class:`LadderOptions`.
    """
    bound = _WRONG * _clip(first, weights, robust).bound[:, None]
    after, before = ((weights * torch.minimum(one, bound).square()).nansum(1) for one in (second, first))
    return after > 1.1 * before + weights.sum(1) * _DOUBTFUL[0] ** 2


def _promising(found: Tensor, before: Tensor) -> Tensor:
    """Which starts of frames (s, F) go on, by mean square errors after some steps and the frames' before."""
    least = found.min(0).values
    rank = found.argsort(dim=0, stable=True).argsort(dim=0)
    most = torch.where(least < _ARRIVING**2 * before, 1, _BEST)
    times, length = _HOPELESS
    return (rank < most) & (found < (times**2 * before).clamp_min(length**2))


class WholeFit:
    """From a pose fitted to moments of skinning to the minimum of the whole model.

    Args:
        coarse: the model on few vertices, for the way; it may be `model`.
        model: the one that is fitted.
        options: of the ladder.
    """

    def __init__(self, coarse: PoseModel, model: PoseModel, options: LadderOptions) -> None:
        self.coarse, self.model, self.options = coarse, model, options
        self.ends = None
        if coarse.share is not None and coarse.share.limbs:
            variables = coarse.solver.variables.tolist()
            ends = [variables.index(limb.end) for limb in coarse.share.limbs if limb.end in variables]
            self.ends = torch.tensor(ends, device=coarse.solver.variables.device)

    def __call__(self, targets: Targets, pose: Pose) -> tuple[Pose, Problem]:
        """The pose, its translation in the world, and the problem of the model.

        Args:
            targets: what to fit.
            pose: where to begin, in the world.
        """
        problem = targets.problem(self.coarse)
        steps = pose.accepted
        pose = replace(pose, translation=pose.translation - problem.origin)
        pose, clip = self._approached(problem, pose, targets.robust)
        pose, way = self._descended(self.coarse, problem, pose, clip)
        if clip is None:
            pose = self._searched(problem, pose, foreign=targets.foreign)
        if self.coarse is not self.model:
            world = pose.translation + problem.origin
            problem = targets.problem(self.model)
            pose = replace(pose, translation=world - problem.origin)
            if clip is None:  # else few vertices tell well enough which of all are wrong
                pose, _ = self._descended(self.model, problem, pose, None, way)
        accepted = steps + pose.accepted
        return replace(pose, translation=pose.translation + problem.origin, accepted=accepted), problem

    def settled(self, problem: Problem, pose: Pose) -> Pose:
        """Plain skinning's poses, descended on where steps on moments were refused before they rested.

        Where another rig moved the skin, every other one is: they know nothing of the error that stays. Where
        nothing is left, what still moves are turns that hardly any vertex tells, and the steps are the best.
        """
        moving = ~(pose.last_change < self.options.tolerance) & (pose.accepted < self.options.iterations)
        if not self.options.refreshes or not bool(moving.any()):
            return pose
        _, energy = self.model.distances(problem, pose, energy_only=True)
        left = (energy / problem.weights.sum(1).clamp_min(1e-12)).sqrt()
        rows = torch.nonzero(moving & (left > _DOUBTFUL[1])).flatten()
        if not len(rows):
            return pose
        rows = problem.several(rows)
        part, _ = self._descended(self.model, problem.part(rows), pose.part(rows), None)
        return pose.put(rows, part)

    def _approached(self, problem: Problem, pose: Pose, robust: float | None) -> tuple[Pose, _Clip | None]:
        """Offsets, clips and the limbs' twist are looked at in turns with steps on moments."""
        model, clip = self.coarse, None
        rounds = _ROUNDS if robust is None else self.options.robust_rounds
        for done in range(rounds):
            if robust is not None:
                clip = self._clip(problem, pose, robust)
            pose = self._shared(problem, pose, clip, near=done > 0 and clip is None)
            if done == rounds - 1 and clip is None:
                break
            view = model.view(problem, pose, None if clip is None else clip.bound)
            pose = model.solver(
                problem.target, problem.rest, pose, iterations=_STEPS, tolerance=self.options.tolerance,
                terms=self._kept(problem, pose), residual=view.residual,
            )  # fmt: skip
        return replace(pose, accepted=torch.zeros_like(pose.accepted)), clip

    def _shared(self, problem: Problem, pose: Pose, clip: _Clip | None, *, near: bool) -> Pose:
        share = self.coarse.share
        if share is None:
            return pose
        view = self.coarse.view(problem, pose, None if clip is None else clip.bound)
        mass = problem.weights.sum(1).expand(len(view.energy))
        weight = clumping(self.coarse, view, mass)
        view = replace(view, energy=weight * (view.energy if clip is None else mass * clip.typical.square()))
        scale = self.coarse.scale(problem).expand(len(pose.translation))
        n = self.coarse.solver.variables
        steps, constants = self.coarse.steps, None
        if steps is None or pose.relative.is_cuda:
            return share(pose, view, problem, scale, n, self._held(problem), near=near)
        constants = self.coarse.constants(problem.rest)
        return share(
            pose, view, problem, scale, n, self._held(problem), near=near, steps=steps, constants=constants
        )

    def _kept(self, problem: Problem, pose: Pose) -> JointTerms | None:
        """Terms that keep the share of a limb's twist, which moments do not tell."""
        if self.ends is None:
            return problem.terms
        rotations = pose.relative[:, self.coarse.solver.variables]
        count = len(problem.vertices)
        terms = JointTerms(
            variable=self.ends,
            stiffness=rotations.new_full((len(self.ends),), _KEPT**2),
            free=rotations.new_zeros(len(self.ends)),
            reference=rotations[:, self.ends],
            hinge_axis=rotations.new_zeros(rotations.shape[1], 3),
        )
        given = problem.terms
        if given is None:
            return terms
        return replace(
            given,
            variable=torch.cat((given.variable, terms.variable)),
            stiffness=torch.cat((given.stiffness, terms.stiffness)),
            free=torch.cat((given.free, terms.free)),
            reference=torch.cat((given.reference.expand(count, -1, 3, 3), terms.reference), 1),
        )

    def _held(self, problem: Problem) -> frozenset[int]:
        """Joints that are hinges."""
        if problem.terms is None:
            return frozenset()
        hinged = (problem.terms.hinge_axis != 0).any(-1)
        return frozenset(self.coarse.solver.variables[hinged].tolist())

    def _clip(self, problem: Problem, pose: Pose, robust: float) -> _Clip:
        distances, _ = self.coarse.distances(problem, pose)
        assert distances is not None
        return _clip(distances, problem.weights, robust)

    def _descended(
        self, model: PoseModel, problem: Problem, pose: Pose, clip: _Clip | None,
        before: Refinement | None = None, steps: int | None = None,
    ) -> tuple[Pose, Refinement]:  # fmt: skip
        """Descent on the model, which goes on with what one `before` remembers; of few steps if given."""
        clips, most = () if clip is None else clip, self.options.refreshes if steps is None else steps
        share = _RESTING_SHARE if model is self.model else _COARSE_SHARE
        refinement = Refinement(model, problem, *clips)
        if before is not None:
            refinement.remember(before)
        pose = refinement(
            pose, iterations=most, tolerance=_RESTING, share=share,
            at_once=_AT_ONCE[model is not self.coarse],
        )  # fmt: skip
        return pose, refinement

    def _searched(self, problem: Problem, pose: Pose, *, foreign: bool) -> Pose:
        """Frames that may rest beside their minimum are tried from other limb twists."""
        share = self.coarse.share
        limbs = [] if share is None else share.free(self._held(problem))
        if not limbs:
            return pose
        mass = problem.weights.sum(1).expand(len(pose.accepted))
        _, energy = self.coarse.distances(problem, pose, energy_only=True)
        error = (energy / mass).sqrt()
        rows = torch.nonzero((error > _DOUBTFUL[0]) & (error < _DOUBTFUL[1])).flatten()
        for tried in _TRIED:
            pose, energy = self._tried(problem, pose, energy, rows, [(limbs, angle) for angle in tried])
            rows = rows[(energy[rows] / mass[rows]).sqrt() > _DOUBTFUL[0]]
        looked = torch.full_like(energy, torch.inf)
        for _ in range(_AGAIN):  # a frame that nothing helped would be tried from the same places again
            error, looked = (energy / mass).sqrt().where(energy < looked, 0.0), energy
            rows = self._stray(problem, pose, error, foreign=foreign)
            for limb in limbs:  # each: one that is right may be held where it is by another that is not
                pose, energy = self._tried(problem, pose, energy, rows, [([limb], angle) for angle in _FAR])
                rows = rows[(energy[rows] / mass[rows]).sqrt() > _FAINT]
        return pose

    def _stray(self, problem: Problem, pose: Pose, error: Tensor, *, foreign: bool) -> Tensor:
        """Numbers of the frames whose error (F,) [m] lies on few vertices, as where limbs are wrong."""
        rows = torch.nonzero(error > _FAINT).flatten()
        if not len(rows):
            return rows
        many = problem.several(rows)
        part = problem.part(many)
        distances, _ = self.coarse.distances(part, pose.part(many))
        assert distances is not None
        share = median_distance(distances, part.weights) / error[many]
        few = share < FEW
        doubtful = few & (share > _FEWEST) & (error[many] > _DOUBTFUL[1])
        if foreign and bool(doubtful.any()):
            view = self.coarse.view(part, pose.part(many))
            pieces = clumping(self.coarse, view, part.weights.sum(1).expand(len(many)))
            few = few & ~(doubtful & (pieces > _ANOTHER))
        return rows[few[: len(rows)]]

    def _tried(
        self, problem: Problem, pose: Pose, energy: Tensor, rows: Tensor,
        starts: Sequence[tuple[Sequence[Limb], float]],
    ) -> tuple[Pose, Tensor]:  # fmt: skip
        """Poses and their energies (F,), some frames descended again from limbs turned by other angles."""
        if not len(rows):
            return pose, energy
        assert self.coarse.share is not None
        rows = problem.several(rows)
        many = rows.repeat(len(starts))
        part, old = problem.part(many), pose.part(many)
        relative = old.relative.clone()
        for number, (limbs, angle) in enumerate(starts):
            own = relative[number * len(rows) : (number + 1) * len(rows)]
            for limb in limbs:
                self.coarse.share.turn(own, limb, own.new_full((len(rows),), angle))
        trial = replace(old, relative=relative)
        trial, way = self._descended(self.coarse, part, trial, None, steps=_AT_FIRST)
        _, found = self.coarse.distances(part, trial, energy_only=True)
        mass = problem.weights.sum(1).expand(len(energy))[rows]
        promising = _promising(found.view(len(starts), -1) / mass, energy[rows] / mass)
        going = torch.nonzero(promising.flatten()).flatten()
        if not len(going):
            return pose, energy
        going = problem.several(going)
        part = part.part(going)
        arrived, _ = self._descended(self.coarse, part, trial.part(going), None, way.part(going))
        _, reached = self.coarse.distances(part, arrived, energy_only=True)
        least, which = (
            torch.full_like(found, torch.inf).index_copy(0, going, reached).view_as(promising).min(0)
        )
        better = least < 0.9 * energy[rows]
        chosen = trial.put(going, arrived).part(
            (which * len(rows) + torch.arange(len(rows)).to(which))[better]
        )
        return pose.put(rows[better], chosen), energy.index_copy(0, rows[better], least[better])
