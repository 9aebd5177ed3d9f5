"""Pose inversion: posed vertices to the rig's rotations, by a ladder of stages (paper, section 3.6)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, get_args

import torch
from torch import Tensor

from soma_core._derived import Derived, kind_of, own_precision
from soma_core._inputs import check_bone_scale, check_choice
from soma_core.geometry.constants import constant
from soma_core.inversion._inputs import (
    check_count,
    check_vertices,
    check_weights,
    refuse_gradient,
    refuse_transforms,
    refuse_unit_error,
    without_gaps,
)
from soma_core.inversion.analytical import AnalyticalOptions
from soma_core.inversion.autograd import AutogradOptions
from soma_core.inversion.implicit import attach_gradient
from soma_core.inversion.ladder import Ladder
from soma_core.inversion.model import PoseModel
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.priors import PosePriors, joint_terms, neighbour_mean, twist_doubt, with_references
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.refine import clumping
from soma_core.inversion.result import InversionResult, joined
from soma_core.inversion.start import cloud_extent
from soma_core.inversion.targets import Frames, LadderOptions, Skinning, Stage, Targets
from soma_core.inversion.whole import FEW, is_worse, lopsided, of_another_rig, right_vertices
from soma_core.kernels._threads import in_parts, shared_out, side_by_side
from soma_core.layer import Kernels, SomaLayer
from soma_core.rig import load_canonical
from soma_core.skeleton.identity import Identity
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.transfer import make_transfer

__all__ = ["PoseInversion", "Topology"]

Topology = Literal["canonical", "native"]

_CHUNK, _SEVERAL = 512, 64
"""Frames fitted at a time, enough to fill all SIMD lanes and few enough for memory; those worth a thread."""

_SCALES = (0.2, 5.0)
"""A body this much smaller or larger than its identity is in another unit, or no body."""

_RESTING_SHARE = 0.015
"""A frame has converged when a step would change it by less than this share of the error that is left: where
correctives have a fold, the slope never vanishes, and where another rig moved the skin, steps end slowly."""

_AS_GOOD, _NO_OTHER = 1.1, 1.5
"""Mean error of plain skinning over that of the full model, up to which a frame of another rig is told by the
former: 0.7 to 1.08 on meshes of Anny's own rig. Of what the full model posed, only bodies that are wrong by
some millimetres come below, and their angles are as good by either. From the second on it is no other rig."""

_COLLAPSED, _LEFT = 0.1, 0.5
"""A joint whose cloud has less than this share of its extent left cannot be determined; nor can one that a
robust fit leaves less than this share of its weight, and those that turn against it."""


class PoseInversion(Derived):
    """Recovers the rig's rotations from posed vertices; keeps no state between calls.

    The default ladder aligns every joint's own points, then takes Levenberg-Marquardt steps on the exact
    skinning error, twist joints included. The target's vertices are read once; a step costs O(joints). Where
    the layer has more than plain skinning, a descent on the error of the whole model follows; each of its
    steps looks at the vertices once.

    Args:
        layer: makes identities, and poses them; its LOD is the LOD of the fit.
        kernels: ``torch`` (the reference), ``warp`` or ``auto``.
        priors: joint limits, hinges, a rest pose, smooth motion, joints that hardly twist; the last is on by
            default, see :class:`PosePriors`.
        stages, iterations, tolerance, analytical, autograd, robust, robust_rounds, refreshes, skinning: see
            :class:`LadderOptions`.

    Raises:
        InputError: an option out of range, or a prior on a joint that no fit can determine.
    """

    def __init__(
        self,
        layer: SomaLayer,
        *,
        stages: Sequence[Stage] = ("procrustes", "gauss_newton"),
        iterations: int = 40,
        tolerance: float = 2e-5,
        analytical: AnalyticalOptions | None = None,
        autograd: AutogradOptions | None = None,
        robust: float | None = None,
        robust_rounds: int = 10,
        refreshes: int = 30,
        skinning: Skinning = "auto",
        priors: PosePriors | None = None,
        kernels: Kernels = "auto",
    ) -> None:
        super().__init__(locals(), *kind_of(layer))
        self.options = LadderOptions(
            stages=stages, iterations=iterations, tolerance=tolerance, robust=robust,
            robust_rounds=robust_rounds, refreshes=refreshes, skinning=skinning,
            analytical=analytical or AnalyticalOptions(), autograd=autograd or AutogradOptions(),
        )  # fmt: skip
        check_choice("kernels", kernels, get_args(Kernels))
        self.layer, self.priors, self.kernels = layer, priors or PosePriors(), kernels
        self._build(self.device, self.dtype)

    def _build(self, device: torch.device, dtype: torch.dtype) -> None:
        layer = self.layer.to(device, dtype)
        self.device, self.dtype = device, dtype
        self.warp = self.kernels != "torch"
        self.ladder = Ladder(layer, self.options, warp=self.warp)
        names = layer.rig.joint_names
        variables = [names[j] for j in self.model.solver.variables.tolist()]
        self.terms = joint_terms(self.priors, variables, dtype=dtype, device=device)
        doubtful = self.model.driven is not None
        self.doubt = twist_doubt(self.priors, variables, dtype=dtype, device=device) if doubtful else None
        self.default_weights = constant(self.model.fitted.astype(float), device=device, dtype=dtype)
        self.__dict__.pop("_to_canonical", None)
        self._twins: dict[str, PoseInversion] = {}

    @property
    def model(self) -> PoseModel:
        """The forward model that is fitted."""
        return self.ladder.model

    def skinned(self, skinning: Skinning) -> PoseInversion:
        """The same fit with another `skinning`, made when first asked for; a plain one is not robust."""
        if self.ladder.plain or skinning == self.options.skinning:
            return self
        if skinning not in self._twins:
            given = self._given | {"layer": self.layer, "skinning": skinning}
            given["robust"] = None if skinning == "plain" else self.options.robust
            self._twins[skinning] = PoseInversion(**given)
        return self._twins[skinning]

    def _follow(self) -> None:
        """Derive everything again where the layer was moved or converted by itself."""
        if (self.layer.device, self.layer.dtype) != (self.device, self.dtype):
            self._build(self.layer.device, self.layer.dtype)

    @own_precision
    def prepare(self, identity: Identity, weights: Tensor | None = None) -> RestMoments:
        """What a fit needs of an identity under vertex weights."""
        self._follow()
        weights = check_weights(weights, self.default_weights, identity.batch_size)
        return self.model.rest(identity, weights)

    @own_precision
    def forward(
        self,
        vertices: Tensor,
        identity: Identity,
        *,
        topology: Topology = "canonical",
        weights: Tensor | None = None,
        bone_scale: Tensor | None = None,
        initial: InversionResult | None = None,
    ) -> InversionResult:
        """Fit every frame on its own, unless a temporal prior ties neighbours together.

        Args:
            vertices: (F, n, 3); canonical: [m], +Y up, in the order of ``layer.mesh``; native: the
                backend's own vertices, unit and axes.
            identity: batch of 1, shared by all frames, or of F.
            topology: which of the two `vertices` are.
            weights: (v,) or (F, v) weights of canonical vertices; zero leaves a vertex out, NaN or not.
                Default 1, and 0 in the face interior.
            bone_scale: (1 or F, J - 1) known factors of the bone vectors, as in ``SomaLayer.pose``.
            initial: an earlier result for these frames, in place of the starting stages.

        Returns:
            Rotations and translation carry gradients by `vertices` (the implicit derivative of the minimum
            of the model that was fitted, with the exact second derivative); the report does not. A
            ``RuntimeWarning`` in the backward pass names frames that rest in a fold of the model.

        Raises:
            InputError: a wrong shape, a negative weight or bone scale, or vertices in another unit than they
                should be; a gradient asked for with `robust` or a temporal prior; ``torch.func`` around it.
        """
        refuse_transforms()
        canonical = self.canonical(vertices, topology)
        with torch.no_grad():
            frames = self._frames(canonical.detach().contiguous(), identity, weights, bone_scale, initial)
            result = self._fit_all(frames)
            strength = self.priors.temporal_strength
            for _ in range(self.priors.temporal_rounds if strength else 0):
                variables = result.rotations[:, self.model.solver.variables - 1]
                reference = neighbour_mean(variables, result.valid)
                result = self._fit_all(replace(frames, initial=result, reference=reference))
        if not (torch.is_grad_enabled() and canonical.requires_grad):
            return result
        if self.options.robust is not None or strength:
            refuse_gradient()
        if self.ladder.plain or not bool(result.plain.any()):
            return self._with_gradient(canonical, frames, result)
        for fit, rows in ((self, ~result.plain), (self.skinned("plain"), result.plain)):
            some = torch.nonzero(rows).flatten()
            if len(some):
                part = fit._with_gradient(canonical[some], frames.part(some), result.part(some))
                result = result.put(some, part)
        return result

    if TYPE_CHECKING:  # torch says that a module returns anything
        __call__ = forward

    def _with_gradient(self, vertices: Tensor, frames: Frames, result: InversionResult) -> InversionResult:
        """The result with the gradient of this fit's own model."""

        def problem(chunk: slice) -> Problem:
            part = frames.part(chunk)
            known, _ = without_gaps(part.vertices, part.weights, self.layer)
            rest = part.rest.get(self.model)
            made = self.model.problem(known, part.identity, part.weights, part.bone_scale, self.terms, rest)
            if self.doubt is None:
                return made
            view = self.model.view(made, result.part(chunk).pose(made.origin))
            weight = clumping(self.model, view, made.weights.sum(1).expand(len(known)))
            return replace(made, doubt=self.doubt.weighed(weight))

        rotations, translation = attach_gradient(
            vertices, result.rotations, result.translation, model=self.model, problem=problem,
            valid=result.valid,
        )  # fmt: skip
        return replace(result, rotations=rotations, translation=translation)

    def _frames(
        self,
        vertices: Tensor,
        identity: Identity,
        weights: Tensor | None,
        bone_scale: Tensor | None,
        initial: InversionResult | None,
    ) -> Frames:
        """Check what belongs to the frames, and bring it together."""
        self.layer.check_identity(identity)
        count = check_count(vertices, identity, initial)
        weights = check_weights(weights, self.default_weights, count)
        kind = self.layer.dtype, self.layer.device
        bone_scale = check_bone_scale(bone_scale, count, self.layer.rig.joint_count - 1, *kind)
        shared = identity.batch_size == 1 and len(weights) == 1
        return Frames(
            vertices=vertices, identity=identity, weights=weights, bone_scale=bone_scale, initial=initial,
            rest={model: model.prepared(identity, weights) for model in self.ladder.models} if shared else {},
        )  # fmt: skip

    def _fit_all(self, frames: Frames) -> InversionResult:
        """Fit chunk by chunk, side by side."""
        count, most = len(frames.vertices), max(_CHUNK, self.model.frames_on_gpu())
        with side_by_side(count, _SEVERAL, frames.vertices) as threads:
            parts = [frames.part(part) for part in shared_out(count, most, threads)]
            fits = in_parts(self._fit, parts, threads)
        if not any(bool(result.valid.any()) for result, _ in fits):
            refuse_unit_error(torch.cat([scale for _, scale in fits]))
        return joined([result for result, _ in fits])

    @own_precision
    def canonical(self, vertices: Tensor, topology: Topology) -> Tensor:
        """Vertices (F, v, 3) [m] on the layer's mesh from what :meth:`forward` takes."""
        self._follow()
        layer = self.layer
        check_choice("topology", topology, get_args(Topology))
        if topology == "native":
            vertices = check_vertices(vertices, -1, fix="Pass the backend's own vertices.")
            return self._to_canonical(vertices.to(layer.device, layer.dtype))
        fix = f"Vertices of the backend itself need topology='native'; this layer's LOD is {layer.mesh.lod}."
        vertices = check_vertices(vertices, layer.mesh.vertex_count, fix=fix)
        return vertices.to(layer.device, layer.dtype)

    @functools.cached_property
    def _to_canonical(self) -> torch.nn.Module:
        """Native vertices to the canonical mesh; made when first asked for."""
        layer, wrap = self.layer, self.layer.spec.wrap
        mid = layer.mesh if layer.mesh.lod == "mid" else load_canonical("mid", layer.mesh.root)[0]
        correspondence = None if wrap is None else load_correspondence(wrap, mid)
        return make_transfer(layer.spec, layer.mesh, correspondence, dtype=layer.dtype, device=layer.device)

    def _fit(self, frames: Frames) -> tuple[InversionResult, Tensor]:
        """Result and scale of a chunk of frames; a robust fit takes what a first one finds right.

        Where that explains less, since vertices were taken for wrong that are not, the first one stays and
        has not converged.
        """
        robust = self.options.robust
        if robust is None:
            pose, problem = self._posed(frames)
            result, scale = self._result(frames, pose, problem)
            return self._described(frames, problem, result), scale
        pose, problem = self._posed(frames, robust)
        near = replace(pose, translation=pose.translation - problem.origin)
        error, _ = self.model.distances(problem, near)
        assert error is not None
        _, finite = without_gaps(frames.vertices, frames.weights, self.layer)
        error.masked_fill_(~finite[:, None], torch.nan)
        right = replace(frames, weights=right_vertices(error, frames.weights, robust), rest={})
        second, known = self._posed(right)
        result, scale = self._result(right, second, known, among=problem)
        result = self._described(right, known, result)
        worse = is_worse(result.vertex_error, error, frames.weights, robust) & result.valid
        if bool(worse.any()):
            first, _ = self._result(frames, pose, problem)
            result = result.where(~worse, replace(first, converged=torch.zeros_like(worse)))
        return result, scale

    def _described(self, frames: Frames, problem: Problem, result: InversionResult) -> InversionResult:
        """The result, with plain skinning's for frames of another rig that it describes as well or better."""
        if self.ladder.plain or self.options.skinning != "auto" or "gauss_newton" not in self.options.stages:
            return result
        rows = of_another_rig(self.model, problem, result)
        if not len(rows):
            return result
        other = self.skinned("plain")
        for model in other.ladder.models if frames.rest else ():
            if model not in frames.rest:
                frames.rest[model] = model.prepared(frames.identity, frames.weights)
        part, full = frames.part(rows), result.part(rows)
        plain, _ = other._fit(part)
        better = plain.mean_error(part.weights) < _AS_GOOD * full.mean_error(part.weights)
        better &= plain.converged | ~full.converged
        plain = replace(plain, determined=plain.determined & full.determined)
        result = result.put(rows[better], plain.part(better))
        own = plain.mean_error(part.weights) > _NO_OTHER * full.mean_error(part.weights)
        return self._searched(frames, result, rows[own & ~better])

    def _searched(self, frames: Frames, result: InversionResult, rows: Tensor) -> InversionResult:
        """The result, with limbs searched in frames of no other rig, where they may rest in a wrong place."""
        if not len(rows):
            return result
        part, before = frames.part(rows), result.part(rows)
        pose, problem = self._posed(replace(part, initial=before), foreign=False)
        found, _ = self._result(part, pose, problem)
        found = before.where(~(found.residual < before.residual), found)
        stuck = lopsided(found.vertex_error, part.weights, found.residual, FEW)
        return result.put(rows, replace(found, converged=found.converged & ~stuck))

    def _posed(
        self, frames: Frames, robust: float | None = None, *, foreign: bool = True
    ) -> tuple[Pose, Problem]:
        """Pose of a chunk of frames, its translation in the world, and the problem that it answers."""
        vertices, _ = without_gaps(frames.vertices, frames.weights, self.layer)
        terms, strength = self.terms, self.priors.temporal_strength
        if frames.reference is not None:
            terms = with_references(terms, frames.reference, strength)
        targets = Targets(
            vertices=vertices, identity=frames.identity, weights=frames.weights, terms=terms,
            bone_scale=frames.bone_scale, doubt=self.doubt, rest=frames.rest, robust=robust,
            foreign=foreign,
        )  # fmt: skip
        return self.ladder(targets, None if frames.initial is None else frames.initial.pose())

    def _result(
        self, frames: Frames, pose: Pose, problem: Problem, among: Problem | None = None
    ) -> tuple[InversionResult, Tensor]:
        """What a pose is worth, and the scale of the bodies.

        Joints of which `problem` leaves out most vertices that `among` has are not determined.
        """
        vertices, finite = without_gaps(frames.vertices, frames.weights, self.layer)
        eye, rest = torch.eye(3, dtype=vertices.dtype, device=vertices.device), problem.rest
        extent, side = cloud_extent(problem.target, rest)
        scale = torch.where(rest.own[..., 3, 3] > 0, extent, torch.nan).nanmedian(1).values
        upright = (side * rest.own[..., 3, 3]).sum(1) > 0
        usable = finite & upright & (scale > _SCALES[0]) & (scale < _SCALES[1])
        relative = torch.where(usable[:, None, None, None], pose.relative, eye)
        translation = torch.where(usable[:, None], pose.translation, torch.zeros_like(pose.translation))
        near = replace(pose, relative=relative, translation=translation - problem.origin)
        error, energy = self.model.distances(problem, near)
        assert error is not None
        mass = problem.weights.sum(1).clamp_min(torch.finfo(vertices.dtype).tiny)
        error = error.masked_fill_(~usable[:, None], torch.nan)
        if vertices is not frames.vertices:
            error.masked_fill_(~torch.isfinite(frames.vertices).all(-1), torch.nan)
        kept = extent > _COLLAPSED
        determined = self.model.determined(kept) & usable[:, None]
        if among is not None:
            kept = kept & (rest.own[..., 3, 3] > _LEFT * among.rest.own[..., 3, 3])
            determined &= self.model.determined(kept, below=determined)
        residual = (energy / mass).sqrt()
        resting = (_RESTING_SHARE * residual).clamp_min(self.options.tolerance if self.ladder.plain else 0.0)
        rests = (pose.last_change < resting) | (pose.last_change == 0)
        rests = rests & ~lopsided(error, problem.weights, residual)
        return InversionResult(
            rotations=relative[:, 1:],
            translation=translation,
            vertex_error=error,
            valid=usable,
            determined=determined,
            converged=rests & usable,
            iterations=pose.accepted,
            residual=residual.masked_fill(~usable, torch.nan),
            plain=torch.full_like(usable, self.ladder.plain and not self.layer.plain),
            angle_std=self.model.angle_std(problem, near, energy).masked_fill(~determined, torch.nan),
        ), scale
