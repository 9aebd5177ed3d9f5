"""What a fit is asked: the targets of a chunk of frames, and the options of its stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Literal, get_args

from torch import Tensor

from soma_core._inputs import check_choice
from soma_core.errors import InputError, check_type
from soma_core.inversion.analytical import AnalyticalOptions
from soma_core.inversion.autograd import AutogradOptions
from soma_core.inversion.model import PoseModel
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.priors import JointTerms, TwistDoubt
from soma_core.inversion.problem import Problem, part_of
from soma_core.inversion.result import InversionResult
from soma_core.skeleton.identity import Identity

__all__ = ["Frames", "LadderOptions", "Skinning", "Stage", "Targets"]

Stage = Literal["procrustes", "transfer", "analytical", "gauss_newton", "autograd"]

Skinning = Literal["auto", "full", "plain"]


_TYPES = {
    **dict.fromkeys(("iterations", "refreshes", "robust_rounds"), (int,)),
    "tolerance": (Real,), "robust": (Real, type(None)),
    "analytical": (AnalyticalOptions,), "autograd": (AutogradOptions,),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LadderOptions:
    """What to do with a chunk of frames.

    Attributes:
        stages: in order: ``procrustes`` or ``transfer`` starts; ``analytical``, ``gauss_newton`` and
            ``autograd`` refine. All but ``procrustes`` and ``gauss_newton`` know plain skinning only.
        iterations: largest number of steps of ``gauss_newton``.
        tolerance: a frame has converged when a step changes its root mean square error, squared, by less
            than this, squared [m].
        analytical, autograd: options of these stages.
        robust: a first fit in which residuals beyond this, and beyond twice the frame's median, count
            linearly (Huber) [m] tells which vertices are wrong; the stages are run without them. None
            takes all vertices.
        robust_rounds: how often the residuals of the first fit are looked at again.
        refreshes: largest number of steps of ``gauss_newton`` under the full model, with twist joints and
            correctives; 0 fits plain skinning.
        skinning: ``full`` fits what ``SomaLayer.pose`` poses, ``plain`` what ``SomaLayer.pose_plain`` does;
            ``auto`` is full but for frames of another rig's skin that plain skinning describes better.

    Raises:
        InputError: an unknown stage or skinning, a negative number of iterations or refreshes, a negative
            tolerance, a robust scale of zero or less.
    """

    stages: Sequence[Stage] = ("procrustes", "gauss_newton")
    iterations: int = 40
    tolerance: float = 2e-5
    analytical: AnalyticalOptions = field(default_factory=AnalyticalOptions)
    autograd: AutogradOptions = field(default_factory=AutogradOptions)
    robust: float | None = None
    robust_rounds: int = 10
    refreshes: int = 30
    skinning: Skinning = "auto"

    def __post_init__(self) -> None:
        for name, kinds in _TYPES.items():
            check_type(name, getattr(self, name), *kinds, fix=f"Leave {name} out for the default.")
        check_choice("skinning", self.skinning, get_args(Skinning))
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
            raise InputError("refreshes", got=self.refreshes, expected="at least 0", fix="Pass refreshes=30.")
        if not self.tolerance >= 0:
            raise InputError(
                "tolerance", got=self.tolerance, expected="a length [m]", fix="Pass tolerance=5e-5."
            )
        if self.robust is not None and not self.robust > 0:
            raise InputError("robust", got=self.robust, expected="a length [m]", fix="Pass 0.01, or None.")


@dataclass(frozen=True, kw_only=True, eq=False)
class Targets:
    """What a chunk of frames is fitted to, whatever the model.

    Attributes:
        vertices: (F, v, 3) [m], finite.
        identity: batch of 1, shared by all frames, or of F.
        weights: (1 or F, v).
        bone_scale: (1 or F, J - 1); None without.
        terms: soft terms and hinges; None without.
        doubt: of the joints' twists, under the full model; None without.
        rest: moments of the one identity by model, where there is one.
        robust: residuals beyond this, and beyond twice the frame's median, count linearly [m]; None is least
            squares.
        foreign: some frames may be of another rig, which a fit of plain skinning will tell.
        problems: those already made, by model.
    """

    vertices: Tensor
    identity: Identity
    weights: Tensor
    bone_scale: Tensor | None
    terms: JointTerms | None
    doubt: TwistDoubt | None
    rest: dict[PoseModel, RestMoments]
    robust: float | None = None
    foreign: bool = True
    problems: dict[PoseModel, Problem] = field(default_factory=dict)

    def problem(self, model: PoseModel) -> Problem:
        """The problem for one model."""
        if model not in self.problems:
            problem = model.problem(
                self.vertices, self.identity, self.weights, self.bone_scale, self.terms, self.rest.get(model)
            )
            self.problems[model] = replace(problem, doubt=self.doubt)
        return self.problems[model]


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """What is given for some frames: see ``PoseInversion.forward``; `reference` for a temporal prior."""

    vertices: Tensor
    identity: Identity
    weights: Tensor
    bone_scale: Tensor | None
    rest: dict[PoseModel, RestMoments]
    initial: InversionResult | None = None
    reference: Tensor | None = None

    def part(self, chunk: slice | Tensor) -> Frames:
        """What is given for some of them."""
        scale = self.bone_scale
        return Frames(
            vertices=self.vertices[chunk],
            identity=part_of(self.identity, chunk),
            weights=self.weights[chunk] if len(self.weights) > 1 else self.weights,
            bone_scale=scale[chunk] if scale is not None and len(scale) > 1 else scale,
            rest=self.rest,
            initial=None if self.initial is None else self.initial.part(chunk),
            reference=None if self.reference is None else self.reference[chunk],
        )
