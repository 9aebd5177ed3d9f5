"""Pose inversion: posed vertices to the rig's rotations, by a ladder of stages (paper, section 3.6)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Literal

import torch
from torch import Tensor

from soma_core._inputs import check_bone_scale
from soma_core.errors import InputError
from soma_core.inversion._inputs import check_vertices, check_weights, refuse_unit_error
from soma_core.inversion.comparison import compare, part_of
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import RestMoments, SkinMoments
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.result import InversionResult
from soma_core.inversion.start import ProcrustesStart, best_translation, cloud_extent
from soma_core.inversion.structure import moment_structure
from soma_core.layer import SomaLayer
from soma_core.rig import load_canonical
from soma_core.skeleton.identity import Identity
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.transfer import make_transfer

__all__ = ["PoseInversion", "Stage", "Topology"]

Stage = Literal["procrustes", "gauss_newton"]
Topology = Literal["canonical", "native"]

_STAGES: tuple[Stage, ...] = ("procrustes", "gauss_newton")

_CHUNK = 512
"""Frames fitted at a time: enough to fill the SIMD lanes of every core, little enough for memory."""

_SCALES = (0.2, 5.0)
"""A body this much smaller or larger than its identity is in another unit, or no body."""

_COLLAPSED = 0.1
"""A joint whose cloud has less than this share of its extent left cannot be determined."""


class PoseInversion(torch.nn.Module):
    """Recovers the rig's rotations from posed vertices; keeps no state between calls.

    The default ladder aligns every joint's own points, then takes Levenberg-Marquardt steps on the exact
    skinning error. The target's vertices are read once; a step costs O(joints).

    Args:
        layer: makes identities, and poses them; its LOD is the LOD of the fit.
        stages: what to do, in order: ``procrustes`` starts, ``gauss_newton`` refines.
        iterations: largest number of steps of ``gauss_newton``.
        tolerance: a frame has converged when a step changes its root mean square error, squared, by less than
            this, squared [m].
        kernels: ``torch`` (the reference), ``warp`` or ``auto``.

    Raises:
        InputError: an unknown stage, or a negative number of iterations.
    """

    def __init__(
        self,
        layer: SomaLayer,
        *,
        stages: Sequence[Stage] = ("procrustes", "gauss_newton"),
        iterations: int = 12,
        tolerance: float = 5e-5,
        kernels: Literal["auto", "torch", "warp"] = "auto",
    ) -> None:
        super().__init__()
        for stage in stages:
            if stage not in _STAGES:
                names = ", ".join(_STAGES)
                raise InputError(
                    "stages", got=repr(stage), expected=f"among {names}", fix="Correct the name."
                )
        if iterations < 0:
            raise InputError("iterations", got=iterations, expected="at least 0", fix="Pass iterations=12.")
        self.layer, self.stages = layer, tuple(stages)
        self.iterations, self.tolerance = iterations, tolerance
        # Not measured on CUDA, where one thread would hold a whole frame: the dense reference runs there.
        self.warp = warp = kernels == "warp" or (kernels == "auto" and layer.device.type == "cpu")
        structure = moment_structure(layer.mesh, layer.rig)
        kind = {"dtype": layer.dtype, "device": layer.device}
        self.moments = SkinMoments(structure, layer.rig, warp=warp, **kind)
        self.solver = GaussNewton(structure, warp=warp, **kind)
        self.start = ProcrustesStart(structure, **kind)
        fitted = torch.as_tensor(structure.fitted, device=layer.device)
        self.register_buffer("default_weights", fitted.to(layer.dtype), persistent=False)

    def prepare(self, identity: Identity, weights: Tensor | None = None) -> RestMoments:
        """What a fit needs of an identity under vertex weights."""
        weights = check_weights(weights, self.default_weights, identity.batch_size)
        offsets = self.layer.animation.kinematics.local_offsets(identity.bind_world)
        return self.moments.rest(identity, weights, offsets)

    @torch.no_grad()
    def forward(
        self,
        vertices: Tensor,
        identity: Identity,
        *,
        topology: Topology = "canonical",
        weights: Tensor | None = None,
        bone_scale: Tensor | None = None,
    ) -> InversionResult:
        """Fit every frame on its own.

        Args:
            vertices: (F, n, 3); canonical: [m], +Y up, in the order of ``layer.mesh``; native: the
                backend's own vertices, unit and axes.
            identity: batch of 1, shared by all frames, or of F.
            topology: which of the two `vertices` are.
            weights: (v,) or (F, v) weights of canonical vertices; zero leaves a vertex out, NaN or not.
                Default 1, and 0 in the face interior.
            bone_scale: (1 or F, J - 1) known factors of the bone vectors, as in ``SomaLayer.pose``.

        Raises:
            InputError: a wrong shape, a negative weight or bone scale, or vertices in another unit than they
                should be.
        """
        vertices = self._canonical(vertices, topology)
        count = len(vertices)
        if identity.batch_size not in (1, count):
            raise InputError(
                "identity",
                got=f"a batch of {identity.batch_size} for {count} frames",
                expected=f"a batch of 1 or {count}",
                fix="Give one identity for the sequence, or one a frame.",
            )
        weights = check_weights(weights, self.default_weights, count)
        user_joints = self.layer.rig.joint_count - 1
        bone_scale = check_bone_scale(bone_scale, count, user_joints, self.layer.dtype, self.layer.device)
        shared = identity.batch_size == 1 and len(weights) == 1
        rest = self.prepare(identity, weights) if shared else None
        parts, scales = [], []
        for first in range(0, count, _CHUNK) or (0,):
            chunk = slice(first, first + _CHUNK)
            who, weight = part_of(identity, chunk), weights[chunk] if len(weights) > 1 else weights
            bones = bone_scale[chunk] if bone_scale is not None and len(bone_scale) > 1 else bone_scale
            part, scale = self._fit(vertices[chunk], who, weight, rest, bones)
            parts.append(part)
            scales.append(scale)
        if not bool(torch.cat([part.valid for part in parts]).any()):
            refuse_unit_error(torch.cat(scales))
        return _joined(parts)

    def _canonical(self, vertices: Tensor, topology: Topology) -> Tensor:
        layer = self.layer
        if topology == "native":
            vertices = check_vertices(vertices, -1, fix="Pass the backend's own vertices.")
            return self._transfer(vertices.to(layer.device, layer.dtype))
        if topology != "canonical":
            raise InputError(
                "topology", got=repr(topology), expected="'canonical' or 'native'", fix="Correct the name."
            )
        fix = f"Vertices of the backend itself need topology='native'; this layer's LOD is {layer.mesh.lod}."
        vertices = check_vertices(vertices, layer.mesh.vertex_count, fix=fix)
        return vertices.to(layer.device, layer.dtype)

    @functools.cached_property
    def _transfer(self) -> torch.nn.Module:
        """Native vertices to the canonical mesh; made when first asked for."""
        layer, wrap = self.layer, self.layer.spec.wrap
        mid = layer.mesh if layer.mesh.lod == "mid" else load_canonical("mid")[0]
        correspondence = None if wrap is None else load_correspondence(wrap, mid)
        return make_transfer(layer.spec, layer.mesh, correspondence, dtype=layer.dtype, device=layer.device)

    def _fit(
        self,
        vertices: Tensor,
        identity: Identity,
        weights: Tensor,
        rest: RestMoments | None,
        bone_scale: Tensor | None,
    ) -> tuple[InversionResult, Tensor]:
        """Result and scale of a chunk of frames."""
        vertices, finite = _without_gaps(vertices, weights, self.layer)
        offsets = self.layer.animation.bone_vectors(identity, bone_scale)
        if rest is None:
            rest, target, origin = self.moments.each(vertices, identity, weights, offsets)
        else:
            rest = replace(rest, offsets=offsets)
            target, origin = self.moments.target(vertices, rest)
        problem = Problem(
            vertices=vertices, weights=weights, identity=identity, rest=rest, target=target, origin=origin,
            bone_scale=bone_scale,
        )  # fmt: skip
        extent, side = cloud_extent(target, rest)
        scale = extent.median(1).values
        upright = (side * rest.own[..., 3, 3]).sum(1) > 0
        usable = finite & upright & (scale > _SCALES[0]) & (scale < _SCALES[1])
        pose = self._climb(problem)
        eye = torch.eye(3, dtype=vertices.dtype, device=vertices.device)
        relative = torch.where(usable[:, None, None, None], pose.relative, eye)[:, 1:]
        translation = torch.where(usable[:, None], pose.translation + origin, torch.zeros_like(origin))
        error, residual = compare(self.layer.animation, problem, relative, translation, warp=self.warp)
        error.masked_fill_(~usable[:, None], torch.nan)
        return InversionResult(
            rotations=relative,
            translation=translation,
            vertex_error=error,
            valid=usable,
            determined=self._determined(extent > _COLLAPSED) & usable[:, None],
            converged=(pose.last_change < self.tolerance) & usable,
            iterations=pose.accepted,
            residual=residual,
        ), scale

    def _climb(self, problem: Problem) -> Pose:
        """Run the stages, each from the result of the one before."""
        pose = None
        for stage in self.stages:
            pose = getattr(self, f"_{stage}")(problem, pose)
        assert pose is not None
        return pose

    def _procrustes(self, problem: Problem, _pose: Pose | None) -> Pose:
        """Weighted Procrustes of every joint's own points."""
        target, rest = problem.target, problem.rest
        pose = Pose.begin(self.start(target, rest), torch.zeros_like(problem.origin))
        turns, places = self.solver.walk(pose, rest.offsets)
        joints = self.moments.joints
        return replace(pose, translation=best_translation(target, rest, turns[:, joints], places[:, joints]))

    def _gauss_newton(self, problem: Problem, pose: Pose | None) -> Pose:
        """Levenberg-Marquardt on the moments."""
        pose = pose or self._procrustes(problem, None)
        return self.solver(
            problem.target, problem.rest, pose, iterations=self.iterations, tolerance=self.tolerance
        )

    def _determined(self, kept: Tensor) -> Tensor:
        """(F, J - 1) from the weighted joints (F, T): whether the target determines a user joint."""
        all_joints = kept.new_zeros(len(kept), self.layer.rig.joint_count)
        all_joints[:, self.moments.joints] = kept
        return all_joints[:, 1:]


def _without_gaps(vertices: Tensor, weights: Tensor, layer: SomaLayer) -> tuple[Tensor, Tensor]:
    """Vertices with a value everywhere, and (F,) whether all that count had one.

    Vertices of zero weight may be NaN or infinite; a frame with others is filled with the rig's bind shape.
    """
    finite = torch.isfinite(vertices.sum((1, 2)))
    if vertices.device.type == "cpu" and bool(finite.all()):
        return vertices, finite
    known = torch.isfinite(vertices).all(-1)
    whole = (known | (weights == 0)).all(1)
    bind = torch.tensor(layer.rig.bind_shape, dtype=vertices.dtype, device=vertices.device)
    return torch.where((known & whole[:, None])[..., None], vertices, bind), whole


def _joined(parts: Sequence[InversionResult]) -> InversionResult:
    if len(parts) == 1:
        return parts[0]
    names = [one.name for one in fields(InversionResult)]
    return InversionResult(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
