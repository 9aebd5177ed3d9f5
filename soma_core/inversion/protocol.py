"""What a fit asks of a forward model, whatever moves its vertices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from torch import Tensor

from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.priors import TwistDoubt
from soma_core.inversion.problem import Pose, Problem, View
from soma_core.inversion.structure import MomentStructure

__all__ = ["Curvature", "ForwardModel"]


class Curvature(Protocol):
    """How the error of some poses curves, about where they are.

    Motions (F, n + 1, 3) are turns of the variable joints in world axes, the translation last, as steps of
    :meth:`GaussNewton.retract` are. Everything is in float64.

    Attributes:
        energy: the error, (F,) [m^2].
        slope: half its derivative (F, n + 1, 3).
    """

    energy: Tensor
    slope: Tensor

    def times(self, motion: Tensor) -> Tensor:
        """Half the second derivative of the error, times a motion; terms are left out."""

    def moved(self, motion: Tensor) -> Tensor:
        """Velocities (F, v, 3) of the vertices in a motion."""

    def residual(self) -> Tensor:
        """What is left of the targets, (F, v, 3) [m]."""


class ForwardModel(Protocol):
    """Skinning by the joints of one rig, and whatever else follows from a pose.

    Attributes:
        solver: of its poses.
        structure: which vertices it moves, and with which weights.
    """

    structure: MomentStructure

    @property
    def solver(self) -> GaussNewton:
        """Turns slopes into steps, and steps into poses."""

    def view(self, problem: Problem, pose: Pose, bound: Tensor | None = None) -> View:
        """Error of poses, and its exact derivative; residuals beyond `bound` (F,) [m] count linearly."""

    def inverse(
        self, problem: Problem, pose: Pose, view: View, damping: Tensor, mass: Tensor
    ) -> Callable[[Tensor], Tensor]:
        """Maps slopes (F, n + 1, 3) to steps: about the inverse of the damped curvature, terms included.

        Args:
            problem, pose, view: where.
            damping: (F,) relative to the diagonal.
            mass: (F,) sums of the vertex weights.
        """

    def doubted(self, doubt: TwistDoubt, relative: Tensor, turns: Tensor) -> tuple[Tensor, Tensor]:
        """A doubt's share (F,) and half its derivative (F, n + 1, 3) at local rotations and world turns."""
        ...

    def moved(self, problem: Problem, pose: Pose, turns: Tensor, step: Tensor) -> Pose:
        """Poses after a step (F, n + 1, 3); `turns` are the world turns of the joints before it."""

    def curvature(self, problem: Problem, pose: Pose) -> Curvature:
        """The exact curvature at poses."""
