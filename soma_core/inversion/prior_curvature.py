"""What priors add to the error of a pose, to second order.

A fit lowers ``(E + t) (1 + S)``: the error E of the vertices, terms t of single joints, and the doubt S of
their twists. Over ``1 + S``, half its second derivative is ``H + 2 (g s^T + s g^T) + e S''``, with H and g
those of ``E + t``, ``s`` half the slope of S over ``1 + S``, ``e = (E + t) / (1 + S)``, and S'' half the
second derivative of S.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.priors import JointTerms, TwistDoubt
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.protocol import Curvature

__all__ = ["Priors"]


class Priors:
    """The error of poses with what priors make of it, everything over ``1 + S`` and in float64.

    Args:
        solver: whose variables count.
        problem: with terms and doubt.
        pose: in float64.
        turns: world turns of the joints that it holds.
        curvature: of the error of the vertices.

    Attributes:
        slope: half the first derivative (F, n + 1, 3).
    """

    def __init__(
        self, solver: GaussNewton, problem: Problem, pose: Pose, turns: Tensor, curvature: Curvature
    ) -> None:
        self._curvature, self._blocks, self._doubt = curvature, None, None
        variables = solver.variables
        rotations, above = pose.relative[:, variables], turns[:, solver.parents[variables]]
        energy, slope = curvature.energy, curvature.slope
        if problem.terms is not None:
            mass = problem.weights.double().sum(1).expand(len(turns))
            terms = _terms_in_float64(problem.terms)
            energy = energy + mass * terms.energy(rotations)
            _, more = terms.normal_equations(rotations, above)
            slope = slope + _padded(mass[:, None, None] * more)
            self._blocks = mass[:, None, None, None] * term_blocks(terms, rotations, above)
        self._own = slope
        if problem.doubt is not None:
            self._doubt = _Doubt(solver, problem.doubt, pose, turns, energy)
            slope = slope + energy[:, None, None] * self._doubt.slope
        self.slope = slope

    def times(self, motion: Tensor) -> Tensor:
        """Half the second derivative times a motion (F, n + 1, 3)."""
        bent = self._curvature.times(motion)
        if self._blocks is not None:
            bent = bent + _padded((self._blocks @ motion[:, :-1, :, None]).squeeze(-1))
        doubt = self._doubt
        if doubt is None:
            return bent
        along = [(one * motion).sum((1, 2), keepdim=True) for one in (self._own, doubt.slope)]
        both = 2 * (self._own * along[1] + doubt.slope * along[0])
        return bent + both + doubt.energy[:, None, None] * doubt.times(motion)

    def pulled(self, motion: Tensor) -> Tensor:
        """Minus the derivative (F, v, 3) of ``slope . motion`` by the target, vertex weights left out."""
        moved = self._curvature.moved(motion)
        if self._doubt is None:
            return moved
        along = (self._doubt.slope * motion).sum((1, 2))[:, None, None]
        return moved + 2 * along * self._curvature.residual()


class _Doubt:
    """``S`` about poses.

    Attributes:
        energy: the error over ``1 + S``.
        slope: half the slope of S, over ``1 + S``.
    """

    def __init__(
        self, solver: GaussNewton, doubt: TwistDoubt, pose: Pose, turns: Tensor, energy: Tensor
    ) -> None:
        with torch.enable_grad():
            count = len(solver.variables)
            self._motion = torch.zeros_like(turns[:, : count + 1, 0]).requires_grad_()
            near = solver.retract(pose, turns, self._motion).relative[:, solver.variables]
            exact = replace(doubt, axis=doubt.axis.double(), square=doubt.square.double())
            share = exact.share(near)
            (self._half,) = torch.autograd.grad(0.5 * share.sum(), self._motion, create_graph=True)
        more = 1 + share.detach()
        self.energy, self.slope = energy / more, self._half.detach() / more[:, None, None]

    def times(self, motion: Tensor) -> Tensor:
        """Half the second derivative of S times a motion."""
        return torch.autograd.grad(self._half, self._motion, motion, retain_graph=True)[0]


def term_blocks(terms: JointTerms, rotations: Tensor, above: Tensor) -> Tensor:
    """Half the second derivative of terms, (F, n, 3, 3) by world turns of the joints.

    Along the arc back a term is quadratic; across it, it curves with ``(angle - free) / (2 tan(angle / 2))``.

    Args:
        terms: relative to the sum of vertex weights.
        rotations: (F, n, 3, 3) of the variable joints.
        above: (F, n, 3, 3) world turns of their parents.
    """
    axis, over, angle = terms._deviation(rotations)
    world = (above[:, terms.variable] @ axis[..., None]).squeeze(-1)
    small = angle < 1e-6
    bent = 0.5 * over / torch.tan(0.5 * torch.where(small, 1.0, angle))
    open_start = (terms.free == 0).to(angle)
    across = terms.stiffness * torch.where(small, open_start, bent)
    along = terms.stiffness * torch.where(over > 0, 1.0, open_start)
    eye = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    outer = world[..., :, None] * world[..., None, :]
    block = across[..., None, None] * eye + (along - across)[..., None, None] * outer
    return torch.zeros_like(rotations).index_add(1, terms.variable, block)


def _terms_in_float64(terms: JointTerms) -> JointTerms:
    names = "stiffness", "free", "reference", "hinge_axis"
    return replace(terms, **{name: getattr(terms, name).double() for name in names})


def _padded(turns: Tensor) -> Tensor:
    """Slopes by turns with a zero for the translation."""
    return torch.nn.functional.pad(turns, (0, 0, 0, 1))
