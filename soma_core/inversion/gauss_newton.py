"""Levenberg-Marquardt on the moments of the skinning error: the torch reference (paper, section 3.6).

A step costs O(joints), whatever the number of vertices: its matrix and slope are sums of moments up the tree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from soma_core.geometry.rotations import cayley
from soma_core.inversion.driven import DrivenJoints
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.priors import JointTerms
from soma_core.inversion.problem import Pose
from soma_core.inversion.skin_equations import SkinEquations
from soma_core.inversion.structure import MomentStructure

if TYPE_CHECKING:
    from soma_core.kernels.pose_solver_wp import PoseSolver, Soft

__all__ = ["HINGE_STIFFNESS", "LONGEST_STEP", "GaussNewton", "damped_inverse"]

_START_DAMPING = 1e-4
_LOWER, _RAISE, _MOST_DAMPING = 0.2, 8.0, 1e6
"""Levenberg damping, relative to the diagonal: start, factors after a good and a bad step, largest value."""

_LEAST_DAMPING = 1e-6
"""Of a rig with driven joints: how a limb's twist is shared between its two ends is left open by its skin."""

_RIDGE = 1e-9
"""Relative to the mean diagonal: keeps the factorisation defined where a joint moves nothing."""

HINGE_STIFFNESS = 1e3
"""Stiffness of a hinge across its axis, relative to what the vertices have to say of the joint."""

LONGEST_STEP = 1.0
"""A joint turns by at most this angle [rad] in one step."""


class GaussNewton(SkinEquations):
    """Minimises the skinning error over the rotations of one rig and the Hips position.

    Args:
        structure: which joints share vertices; with `driven`, of the rig that has the helpers as joints.
        dtype, device: of the state; float32 reaches 1e-4 mm on a body near the origin.
        warp: run the Warp twin instead of the torch reference.
        driven: joints whose turn follows from the others'; a pose does not hold them.
        apart: turn each joint in the world by the sum of the steps above it, so that the direction of a bone
            moves by its own sum alone, however the steps of the joints above it go together. Knows no hinges.
    """

    def __init__(
        self,
        structure: MomentStructure,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
        warp: bool = False,
        driven: DrivenJoints | None = None,
        apart: bool = False,
    ) -> None:
        super().__init__(structure, dtype=dtype, device=device, driven=driven)
        self.apart = apart
        self.kernels = _kernels(structure, driven, dtype, torch.device(device)) if warp else None

    def forward(
        self,
        target: Tensor,
        rest: RestMoments,
        start: Pose,
        *,
        iterations: int,
        tolerance: float = 0.0,
        terms: JointTerms | None = None,
        residual: Tensor | None = None,
    ) -> Pose:
        """Refine `start`; never worse than it.

        Args:
            target: ``R`` (F, T, 3, 4) of the targets.
            rest: moments of one identity or of one a frame.
            start: poses to begin from.
            iterations: number of steps tried; a step that would raise the energy is undone and damped.
            tolerance: a frame rests once a step changed its energy by less, as a root mean square [m].
            terms: soft terms on single joints, and hinges; `start` must keep the hinges.
            residual: ``P`` (F, T, 3, 4) at `start`, in place of that of `target`: what another model than
                skinning leaves there.
        """
        if self.kernels is not None and iterations:
            given = target if residual is None else residual
            return self._by_warp(
                given, rest, start, iterations, tolerance, terms, forced=residual is not None
            )
        pose, second = start, self.dense(rest.second)
        turns, places = self.walk(pose, rest)
        residual = self.gradient(turns, places, second, target) if residual is None else residual
        mass = rest.own[..., 3, 3].sum(1)
        damping = torch.full_like(pose.last_change, _START_DAMPING)
        moving = torch.ones_like(pose.last_change, dtype=torch.bool)
        for _ in range(iterations):
            system = self.normal_equations(turns, places, rest, residual)
            trial = self.retract(pose, turns, self._step(system, pose, turns, damping, terms, mass))
            trial_turns, trial_places = self.walk(trial, rest)
            change = torch.cat((trial_turns - turns, (trial_places - places)[..., None]), -1)[:, self.joints]
            product = self.times_second(change, second)
            energy = (change * (product + 2 * residual)).sum((1, 2, 3))
            if terms is not None:
                new, old = (terms.energy(one.relative[:, self.variables]) for one in (trial, pose))
                energy = energy + mass * (new - old)
            better = moving & (energy < 0)
            keep = better[:, None, None, None]
            pose = Pose(
                relative=torch.where(keep, trial.relative, pose.relative),
                translation=torch.where(better[:, None], trial.translation, pose.translation),
                accepted=pose.accepted + better,
                last_change=torch.where(moving, (energy.abs() / mass).sqrt(), pose.last_change),
            )
            moving = moving & ~(pose.last_change < tolerance)
            turns = torch.where(keep, trial_turns, turns)
            places = torch.where(keep[..., 0], trial_places, places)
            residual = torch.where(keep, residual + product, residual)
            damping = damping * torch.where(better, _LOWER, _RAISE).to(damping)
            damping = damping.clamp(self._least_damping, _MOST_DAMPING)
        return pose

    def _step(
        self,
        system: tuple[Tensor, Tensor],
        pose: Pose,
        turns: Tensor,
        damping: Tensor,
        terms: JointTerms | None,
        mass: Tensor,
    ) -> Tensor:
        """Damped step (F, n + 1, 3) from normal equations, with the terms added to them."""
        matrix, slope = system
        if terms is not None:
            self.add_terms(matrix, slope, pose.relative, turns, terms, mass)
        return self.shortened(-damped_inverse(matrix, damping)(slope), turns, terms)

    def add_terms(
        self, matrix: Tensor, slope: Tensor, relative: Tensor, turns: Tensor, terms: JointTerms, mass: Tensor
    ) -> None:
        """Add the terms to the normal equations, and make turns of hinges off their axis too costly."""
        n = self.variables
        above = turns[:, self.parents[n]]
        blocks, slopes = terms.normal_equations(relative[:, n], above)
        each = torch.arange(len(n), device=matrix.device)
        # Indexing two axes at once puts them first: (n, F, 3, 3).
        own = matrix[:, each, :, each] + (mass[:, None, None, None] * blocks).transpose(0, 1)
        axis = (above @ terms.hinge_axis[..., None]).squeeze(-1).transpose(0, 1)
        hinge = (terms.hinge_axis != 0).any(-1)[:, None]
        stiff = hinge * HINGE_STIFFNESS * own.diagonal(dim1=-2, dim2=-1).sum(-1)
        across = self.eye - axis[..., :, None] * axis[..., None, :]
        matrix[:, each, :, each] = own + stiff[..., None, None] * across
        slope[:, : len(n)] += mass[:, None, None] * slopes

    def _along_hinges(self, step: Tensor, turns: Tensor, terms: JointTerms) -> Tensor:
        """The part of each hinge's step that lies along its axis."""
        axis = (turns[:, self.parents[self.variables]] @ terms.hinge_axis[..., None]).squeeze(-1)
        along = (step[:, :-1] * axis).sum(-1, keepdim=True) * axis
        hinge = (terms.hinge_axis != 0).any(-1)[None, :, None]
        return torch.cat((torch.where(hinge, along, step[:, :-1]), step[:, -1:]), 1)

    def _by_warp(
        self,
        target: Tensor,
        rest: RestMoments,
        start: Pose,
        iterations: int,
        tolerance: float,
        terms: JointTerms | None,
        *,
        forced: bool,
    ) -> Pose:
        assert self.kernels is not None
        mass = rest.own[..., 3, 3].sum(1).expand(len(target))
        relative, translation, accepted, energy = self.kernels.fit(
            self.constants(rest), target, start.relative, start.translation, tolerance**2 * mass, mass,
            forced=forced, iterations=iterations,
            damping=(_START_DAMPING, _LOWER, _RAISE, self._least_damping, _MOST_DAMPING),
            longest=LONGEST_STEP, stiffness=HINGE_STIFFNESS, soft=self.soft(terms, target),
            apart=self.apart,
        )  # fmt: skip
        return Pose(
            relative=relative,
            translation=translation,
            accepted=start.accepted + accepted.to(start.accepted),
            last_change=(energy.abs() / mass).sqrt(),
        )

    def constants(self, rest: RestMoments, *more: Tensor) -> tuple[Tensor, bool]:
        """What kernels take of identities; with `more` behind it."""
        assert self.kernels is not None
        driven = () if rest.driven is None else (rest.driven.left, rest.driven.right, rest.driven.axis)
        return self.kernels.constants(rest.second, rest.offsets, *driven, *more)

    def soft(self, terms: JointTerms | None, like: Tensor) -> Soft:
        """Terms as kernels take them: by columns, which are the movable joints in descending order."""
        from soma_core.kernels.pose_solver_wp import Soft

        count, whole = len(self.variables), len(self.movable)
        none = like.new_zeros(0)
        if terms is None:
            index = torch.zeros(0, dtype=torch.int32, device=like.device)
            return Soft(index, like.new_zeros(1), none, hinged=False)
        hinges = torch.nn.functional.pad(terms.hinge_axis.flip(0), (0, 0, whole - count, 0))
        return Soft(
            columns=self.columns(terms.variable),
            numbers=torch.cat((terms.stiffness, terms.free, hinges.flatten())).contiguous(),
            reference=terms.reference.expand(len(like), -1, 3, 3),
            hinged=bool((terms.hinge_axis != 0).any()),
        )

    def columns(self, variable: Tensor) -> Tensor:
        """Columns of variables in the kernels, int32."""
        return (len(self.movable) - 1 - variable).to(torch.int32)

    @property
    def _least_damping(self) -> float:
        return 0.0 if self.driven is None else _LEAST_DAMPING

    def shortened(self, step: Tensor, turns: Tensor, terms: JointTerms | None) -> Tensor:
        """The step with no joint turned too far, and hinges kept to their axis where `terms` are given."""
        length = step[:, :-1].norm(dim=-1, keepdim=True)
        short = torch.clamp(LONGEST_STEP / length.clamp_min(1e-12), max=1)
        step = torch.cat((step[:, :-1] * short, step[:, -1:]), 1)
        return step if terms is None else self._along_hinges(step, turns, terms)

    def retract(self, pose: Pose, turns: Tensor, step: Tensor) -> Pose:
        """Turn every variable joint by its step, in the axes of its parent, and remove rounding."""
        n, own = self.variables, step[:, :-1]
        inner = turns[:, self.parents[n]].mT
        if self.apart:
            whole = turns.new_zeros(*turns.shape[:2], 3).index_copy(1, n, own)
            for index in range(self.level_count):
                level = getattr(self, f"level_{index}")
                whole[:, level] += whole[:, self.parents[level]]
            above = cayley((inner @ whole[:, self.parents[n], :, None]).squeeze(-1))
            moved = above.mT @ cayley((inner @ whole[:, n, :, None]).squeeze(-1)) @ pose.relative[:, n]
        else:
            moved = cayley((inner @ own[..., None]).squeeze(-1)) @ pose.relative[:, n]
        moved = 1.5 * moved - 0.5 * moved @ (moved.transpose(-1, -2) @ moved)
        relative = pose.relative.index_copy(1, n, moved)
        return replace(pose, relative=relative, translation=pose.translation + step[:, -1])


def damped_inverse(matrix: Tensor, damping: Tensor) -> Callable[[Tensor], Tensor]:
    """Maps slopes (F, n + 1, 3) to solutions of a matrix (F, n + 1, 3, n + 1, 3) damped on its diagonal.

    Cholesky only, and no error check, so that nothing waits for the device.
    """
    dense = matrix.flatten(3, 4).flatten(1, 2)
    diagonal = dense.diagonal(dim1=-2, dim2=-1)
    extra = damping[:, None] * diagonal + _RIDGE * diagonal.mean(1, keepdim=True)
    factor, _ = torch.linalg.cholesky_ex(dense + torch.diag_embed(extra))
    return lambda slope: torch.cholesky_solve(slope.flatten(1)[..., None], factor).view_as(slope)


def _kernels(
    structure: MomentStructure, driven: DrivenJoints | None, dtype: torch.dtype, device: torch.device
) -> PoseSolver | None:
    """Kernels of a rig; none where twist is read by Euler angles, which they do not know."""
    if driven is not None and not driven.turning:
        return None
    from soma_core.inversion.tables import solver_tables
    from soma_core.kernels.pose_solver_wp import PoseSolver

    tables = solver_tables(structure, driven)
    return PoseSolver(tables.counts, tables.lists, tables.numbers, dtype=dtype, device=device)
