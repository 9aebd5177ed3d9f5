"""SOMA bodies to the pose parameters of a native model, at the least-squares optimum of its own mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from soma_core.animation.engine import Animation
from soma_core.backends.parameters import batch_parameters
from soma_core.errors import InputError
from soma_core.geometry.rotations import matrix_to_axis_angle
from soma_core.inversion._inputs import check_weights
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import RestMoments, SkinMoments
from soma_core.inversion.problem import Pose
from soma_core.inversion.start import ProcrustesStart, best_translation
from soma_core.inversion.structure import skin_structure
from soma_core.layer import Kernels
from soma_core.native.model import NativeBody, native_rig
from soma_core.native.motion import NativeMotion
from soma_core.native.refine import Refinement
from soma_core.native.transfer import NativeTransfer
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import HasSkinning
from soma_core.rig.mesh import Lod
from soma_core.topology.frames import METRES

__all__ = ["NativeFit"]

_CHUNK = 64
"""Frames fitted at a time: their posed meshes and the derivatives of those stay near the cache."""

_SKIN_ITERATIONS = 40
"""Largest number of steps before blend shapes come in; they cost next to nothing."""


_PER_FRAME = (
    "rotations", "translation", "vertices", "vertex_error", "valid", "converged", "iterations", "residual",
)  # fmt: skip


class NativeFit(torch.nn.Module):
    """Recovers the pose parameters of a native model from posed SOMA bodies; keeps no state between calls.

    Canonical vertices go to the native topology, and the model's own pose is fitted to them: aligned
    joint by joint, then by Levenberg-Marquardt on the moments of its skinning, then under the whole model
    with its pose blend shapes. Frames are fitted in batches, every joint of the model at once, hands
    included.

    Args:
        backend: name of an installed backend whose generator tells its skinning (the SMPL family).
        options: the backend's own options, such as a gender.
        lod: of the canonical vertices that come in.
        iterations: largest number of steps under the whole model.
        tolerance: a frame has converged when a step changes its root mean square error, squared, by less
            than this, squared [m].
        device, dtype: of all constants and results.
        kernels: ``torch`` (the reference), ``warp`` or ``auto``.
        registry: where backends are looked up.

    Attributes:
        transfer: canonical vertices to the native topology.

    Raises:
        InputError: the backend does not tell its skinning, or an option is out of range.
        BackendError: the backend is not usable.
    """

    def __init__(
        self,
        backend: str,
        *,
        options: Mapping[str, Any] | None = None,
        lod: Lod = "mid",
        iterations: int = 20,
        tolerance: float = 2e-5,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        kernels: Kernels = "auto",
        registry: Registry | None = None,
    ) -> None:
        super().__init__()
        device, registry = torch.device(device), registry or default_registry()
        self.iterations, self.tolerance = iterations, tolerance
        self.transfer = NativeTransfer(backend, lod=lod, device=device, dtype=dtype, registry=registry)
        self.spec, self.scale = self.transfer.spec, METRES[self.transfer.spec.unit]
        generator = registry.generator(backend, device=device, dtype=dtype, options=options)
        if not isinstance(generator, HasSkinning):
            raise InputError(
                "backend",
                got=f"{backend}, whose generator has no skinning()",
                expected="a backend that tells its skinning, such as smpl, smplh or smplx",
                fix="NativeTransfer gives its vertices.",
            )
        self._generator, self._isolated = generator, lambda: registry.isolated(backend, "rest")
        self.dtype, self.device = dtype, device
        warp = kernels == "warp" or (kernels == "auto" and device.type == "cpu")
        with self._isolated():
            neutral = generator.skinning(self._one_body({}))
        rig = native_rig(neutral, self.scale)
        self.joint_names = rig.user_joint_names
        structure = skin_structure(rig, self.transfer.covered.cpu().numpy())
        self.moments = SkinMoments(structure, rig, dtype=dtype, device=device, warp=warp)
        self.solver = GaussNewton(structure, dtype=dtype, device=device, warp=warp)
        self.start = ProcrustesStart(structure, dtype=dtype, device=device)
        self.animation = Animation(rig, dtype=dtype, device=device, kernels=kernels)

    @torch.no_grad()
    def forward(
        self,
        vertices: Tensor,
        *,
        params: Mapping[str, Any] | None = None,
        weights: Tensor | None = None,
    ) -> NativeMotion:
        """Fit every frame on its own, one body for all.

        Args:
            vertices: canonical vertices (F, v, 3) [m], +Y up, such as ``layer.pose(...).vertices``.
            params: the body's parameters, one sample; what is left out has its default.
            weights: (n,) of native vertices, default 1; those without a counterpart never count.

        Raises:
            InputError: a wrong shape, or parameters of several bodies.
        """
        target = self.scale * self.transfer(vertices.to(self.device, self.dtype))
        counted = self._weights(weights)
        body = self._body(params)
        rest = self._moments(body, counted)
        parts = [self._fit(body, rest, part, counted) for part in target.split(_CHUNK)]
        return _joined(parts)

    def _one_body(self, params: Mapping[str, Any] | None) -> dict[str, Tensor]:
        batch = batch_parameters(self.spec, params, device=self.device, dtype=self.dtype)
        sizes = {len(value) for value in batch.values()} - {1}
        if sizes:
            raise InputError(
                "params",
                got=f"{max(sizes)} bodies",
                expected="one body for all frames",
                fix="Fit the frames of each body by themselves.",
            )
        return batch

    def _body(self, params: Mapping[str, Any] | None) -> NativeBody:
        batch = self._one_body(params)
        with self._isolated():
            model = self._generator.skinning(batch)
        return NativeBody(model, batch, self.animation, self.scale)

    def _moments(self, body: NativeBody, weights: Tensor) -> RestMoments:
        offsets = self.animation.bone_vectors(body.identity)
        return self.moments.rest(body.identity, weights[None], offsets)

    def _weights(self, weights: Tensor | None) -> Tensor:
        """(n,) weights of native vertices; zero where there is no counterpart."""
        counted = self.transfer.covered.to(self.dtype)
        return counted if weights is None else counted * check_weights(weights, counted, 0)[0]

    def _fit(self, body: NativeBody, rest: RestMoments, target: Tensor, weights: Tensor) -> NativeMotion:
        """Fit a chunk of frames (F, n, 3) [m]."""
        used = weights > 0
        valid = torch.isfinite(target[:, used]).flatten(1).all(1)
        finite = torch.where((valid[:, None] & used)[..., None], target, body.identity.rest)
        origin = finite[:, used][:, :1]
        near = finite - origin
        pose = self._skinned(rest, near)
        if body.offsets is not None and self.iterations:
            whole = Refinement(body=body, solver=self.solver, rest=rest, target=near, weights=weights)
            pose = whole(pose, iterations=self.iterations, tolerance=self.tolerance)
        rotations, pelvis = pose.relative[:, 1:], pose.translation
        posed = body.posed(rotations, pelvis)
        error = torch.linalg.vector_norm(posed - near, dim=-1)
        residual = ((error.square() * weights).sum(1) / weights.sum()).sqrt()
        unknown = ~(valid[:, None] & used)
        determined = torch.zeros(len(self.joint_names), dtype=torch.bool, device=self.device)
        determined[self.solver.variables - 1] = True
        translation = pelvis + origin[:, 0] - body.pelvis
        return NativeMotion(
            joint_names=self.joint_names,
            rotations=matrix_to_axis_angle(rotations).masked_fill(~valid[:, None, None], 0),
            translation=(translation / self.scale).masked_fill(~valid[:, None], 0),
            params=body.params,
            vertices=(posed + origin) / self.scale,
            vertex_error=error.masked_fill(unknown, torch.nan),
            determined=determined,
            valid=valid,
            converged=(pose.last_change < self.tolerance) & valid,
            iterations=pose.accepted,
            residual=residual.masked_fill(~valid, torch.nan),
        )

    def _skinned(self, rest: RestMoments, target: Tensor) -> Pose:
        """Poses of the skinning alone; translations in the frame of `target`."""
        moments, origin = self.moments.target(target, rest)
        relative = self.start(moments, rest)
        pose = Pose.begin(relative, torch.zeros_like(origin))
        joints = self.moments.joints
        turns, places = self.solver.walk(pose, rest.offsets)
        shift = best_translation(moments, rest, turns[:, joints], places[:, joints])
        pose = self.solver(
            moments, rest, replace(pose, translation=shift), iterations=_SKIN_ITERATIONS,
            tolerance=self.tolerance,
        )  # fmt: skip
        return replace(pose, translation=pose.translation + origin)


def _joined(parts: Sequence[NativeMotion]) -> NativeMotion:
    """One motion of consecutive chunks of frames."""
    names = [name for name, value in vars(parts[0]).items() if name in _PER_FRAME]
    return replace(parts[0], **{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
