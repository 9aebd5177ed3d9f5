"""SOMA bodies to the pose parameters of a native model, at the least-squares optimum of its own mesh."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import torch
from torch import Tensor

from soma_core._derived import Derived, own_precision
from soma_core.backends.parameters import batch_parameters
from soma_core.errors import InputError
from soma_core.geometry.rotations import matrix_to_axis_angle
from soma_core.inversion._inputs import check_weights, refuse_transforms
from soma_core.inversion.fit import Topology
from soma_core.inversion.implicit import attach_gradient
from soma_core.inversion.priors import JointTerms, part_of_terms, with_references
from soma_core.layer import Kernels
from soma_core.native.model import NativeBody, NativeRig
from soma_core.native.motion import NativeMotion
from soma_core.native.poses import PoseFit
from soma_core.native.shape import Unknowns, fit_shape
from soma_core.native.transfer import NativeTransfer
from soma_core.plugin.declaration import skinned_problem
from soma_core.plugin.errors import PluginError
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import HasSkinning, SkinnedModel
from soma_core.rig.mesh import Lod
from soma_core.skeleton.identity import Identity
from soma_core.topology.frames import METRES

__all__ = ["NativeFit"]

_STEPS = (0.1, -0.3, 0.3, 0.1)
"""Steps that derivatives by parameters are taken over, in their units, one search after the other: inward, or
outward. Phenotypes have kinks, at which one side does not see what the other does."""

_CHUNK = 64
"""Frames fitted at a time: their posed meshes and the derivatives of those stay near the cache."""

_PER_FRAME = (
    "rotations", "translation", "vertices", "vertex_error", "valid", "converged", "iterations", "residual",
)  # fmt: skip


class NativeFit(Derived):
    """Recovers the pose parameters of a native model from posed SOMA bodies; keeps no state between calls.

    Canonical vertices go to the native topology, and the model's own pose is fitted to them: aligned
    joint by joint, then by Levenberg-Marquardt on the moments of its skinning, then by descent on the error
    of the whole model with its pose blend shapes. Frames are fitted in batches, every joint of the model at
    once, hands included.

    Args:
        backend: name of an installed backend whose generator tells its skinning (Anny, the SMPL family).
        options: the backend's own options, such as a gender.
        lod: of the canonical vertices that come in.
        iterations: largest number of steps under the whole model.
        tolerance: a frame has converged when a step would change its vertices by less, as a root mean square
            [m].
        device, dtype: of all constants and results.
        kernels: ``torch`` (the reference), ``warp`` or ``auto``.
        registry: where backends are looked up.

    Attributes:
        transfer: canonical vertices to the native topology.
        joint_names: of the model.

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
        super().__init__(locals(), device, dtype)
        if kernels not in get_args(Kernels):
            raise InputError(
                "kernels", got=repr(kernels), expected="'auto', 'torch' or 'warp'", fix="Pass kernels='auto'."
            )
        if iterations < 0:
            raise InputError("iterations", got=iterations, expected="at least 0", fix="Leave iterations out.")
        self.backend, self.lod, self.kernels = backend, lod, kernels
        self.options, self._registry = dict(options or {}), registry or default_registry()
        self.iterations, self.tolerance = iterations, tolerance
        self._build(self.device, dtype)

    def _build(self, device: torch.device, dtype: torch.dtype) -> None:
        self.device, self.dtype = device, dtype
        registry, backend = self._registry, self.backend
        generator = registry.generator(backend, options=self.options, device=device, dtype=dtype)
        if not isinstance(generator, HasSkinning):
            raise InputError(
                "backend",
                got=f"{backend}, whose generator has no skinning()",
                expected="a backend that tells its skinning, such as anny, smpl or smplx",
                fix="NativeTransfer gives its vertices.",
            )
        self._generator, self._isolated = generator, lambda: registry.isolated(backend, "rest")
        self.transfer = NativeTransfer(backend, lod=self.lod, registry=registry, device=device, dtype=dtype)
        self.spec, self.scale = self.transfer.spec, METRES[self.transfer.spec.unit]
        covered = self.transfer.covered.cpu().numpy()
        model = self._model(self._one_body({}))
        with self._isolated():
            problem = skinned_problem(model, 1, self.transfer.count)
            if problem is not None:
                raise PluginError(problem, fix=f"Run: soma backends check {backend} -k skinning")
        self.rig = NativeRig(model, self.scale, covered, kernels=self.kernels, device=device, dtype=dtype)
        self.joint_names = self.rig.joint_names

    @own_precision
    def forward(
        self,
        vertices: Tensor,
        *,
        params: Mapping[str, Any] | None = None,
        weights: Tensor | None = None,
        expected: Tensor | None = None,
        firmness: Tensor | None = None,
    ) -> NativeMotion:
        """Fit every frame on its own, one body for all.

        Args:
            vertices: canonical vertices (F, v, 3) [m], +Y up, such as ``layer.pose(...).vertices``, of any
                backend.
            params: the body's parameters, one sample; what is left out has its default. See
                :meth:`fit_params` for those of an unknown body.
            weights: (n,) of native vertices, default 1; those without a counterpart never count.
            expected: (F, J, 3, 3) local rotations that joints are held near, as another rig turned them: skin
                does not tell all of them.
            firmness: (J,) how firmly [m/rad]; a joint that is off by an angle a costs as much as a root mean
                square vertex error of ``firmness a``.

        Returns:
            Rotations, translation and vertices carry gradients by `vertices` (the implicit derivative of the
            minimum, with the model's exact curvature); the report does not.

        Raises:
            InputError: a wrong shape, a negative weight, parameters of several bodies, or a transform of
                ``torch.func``.
        """
        refuse_transforms()
        target = self._native(vertices)
        with torch.no_grad():
            fit = self._prepared(self._one_body(params), self._weights(weights))
            terms = self._terms(expected, firmness, len(target))
        chunks = [slice(start, start + _CHUNK) for start in range(0, len(target), _CHUNK) or (0,)]
        return _joined([self._fit(fit, target[chunk], part_of_terms(terms, chunk)) for chunk in chunks])

    if TYPE_CHECKING:  # torch says that a module returns anything
        __call__ = forward

    @own_precision
    @torch.no_grad()
    def fit_params(
        self,
        vertices: Tensor,
        *,
        start: Mapping[str, Any] | None = None,
        weights: Tensor | None = None,
        frames: int = 20,
        iterations: int = 10,
    ) -> dict[str, Tensor]:
        """Parameters of the one body whose best poses come nearest to the frames, batch of 1.

        Gauss-Newton steps on the error that is left once every frame has taken its best pose under the
        whole model. What the frames leave open stays at `start`.

        Args:
            vertices, weights: as for :meth:`forward`.
            start: parameters to begin from; what is left out has its default.
            frames: how many frames, spread over the motion, to look at.
            iterations: largest number of steps.

        Raises:
            InputError: a wrong shape, a negative weight, parameters of several bodies, a count below one,
                or no usable frame.
        """
        for name, value in (("frames", frames), ("iterations", iterations)):
            if value < 1:
                raise InputError(name, got=value, expected="at least 1", fix=f"Leave {name} out.")
        spread = torch.linspace(0, len(vertices) - 1, min(frames, len(vertices))).round().long()
        unknowns = _Every(self._one_body(start))
        found, _ = self.search(
            vertices[spread], unknowns, unknowns.start, weights=weights, iterations=iterations
        )
        return unknowns.params(found[None])

    @own_precision
    @torch.no_grad()
    def search(
        self,
        vertices: Tensor,
        unknowns: Unknowns,
        begin: np.ndarray,
        *,
        topology: Topology = "canonical",
        weights: Tensor | None = None,
        iterations: int = 10,
    ) -> tuple[np.ndarray, float]:
        """Values (k,) of the unknowns whose best poses come nearest to all frames, and the error left [m].

        Args:
            vertices: (F, v, 3) [m] on the canonical mesh, or (F, n, 3) in the native unit and axes.
            unknowns: what may change, such as :class:`FreeParameters`.
            begin: where to begin, (k,).
            topology: of the vertices.
            weights, iterations: as for :meth:`fit_params`.

        Raises:
            InputError: a wrong shape, a negative weight, or no usable frame.
        """
        counted = self._weights(weights)

        def prepare(point: np.ndarray) -> PoseFit:
            return self._prepared(unknowns.params(point[None]), counted)

        def directions(point: np.ndarray, step: float) -> Identity:
            steps = unknowns.inward(point, step)
            outside = (point + steps < unknowns.lower) | (point + steps > unknowns.upper)
            steps = np.where(outside, -steps, steps)
            some = unknowns.params(point + np.concatenate((np.zeros((1, len(steps))), np.diag(steps))))
            model = self._model(some)
            length = torch.as_tensor(steps).to(model.rest)[:, None, None]
            rest, joints = ((one[1:] - one[:1]) / length for one in (model.rest, model.joints))
            return self.rig.bodies(rest, joints)

        target = (
            self._native(vertices)
            if topology == "canonical"
            else self.scale * vertices.to(self.device, self.dtype)
        )
        target, _, known = _finite(prepare(begin).body, target, counted)
        if not bool(known.any()):
            raise InputError(
                "vertices",
                got=f"{len(vertices)} frames of which none is finite",
                expected="frames of a body",
                fix="Leave out frames without a body.",
            )
        target = target[known.any(1)]
        point, error = begin, np.inf
        for step in _STEPS if np.isfinite(unknowns.upper).any() else _STEPS[:1]:
            point, error = fit_shape(
                prepare, functools.partial(directions, step=step), unknowns, target, start=point,
                iterations=iterations,
            )  # fmt: skip
        return point, error

    def _native(self, vertices: Tensor) -> Tensor:
        """Native vertices (F, n, 3) in metres."""
        return self.scale * self.transfer(vertices.to(self.device, self.dtype))

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

    def _weights(self, weights: Tensor | None) -> Tensor:
        """(n,) weights of native vertices; zero where there is no counterpart."""
        counted = self.transfer.covered.to(self.dtype)
        return counted if weights is None else counted * check_weights(weights, counted, 0)[0]

    def _terms(self, expected: Tensor | None, firmness: Tensor | None, frames: int) -> JointTerms | None:
        """The pull of joints to expected rotations."""
        if expected is None:
            return None
        joints = len(self.joint_names)
        if tuple(expected.shape) != (frames, joints, 3, 3) or firmness is None or len(firmness) != joints:
            told = "no firmness" if firmness is None else f"firmness {tuple(firmness.shape)}"
            raise InputError(
                "expected", got=f"{tuple(expected.shape)} and {told}",
                expected=f"({frames}, {joints}, 3, 3) and firmness ({joints},)",
                fix="Pass both, of all joints.",
            )  # fmt: skip
        variables = self.rig.solver.variables - 1
        reference = expected.to(self.device, self.dtype)[:, variables]
        return with_references(None, reference, firmness.to(self.device)[variables].tolist())

    def _model(self, params: Mapping[str, Tensor]) -> SkinnedModel:
        with self._isolated():
            return self._generator.skinning(params)

    def _body(self, params: Mapping[str, Tensor]) -> NativeBody:
        model = self._model(params)
        identity = self.rig.bodies(model.rest, model.joints)
        return NativeBody(params=params, identity=identity, pelvis=identity.bind_world[0, 1, :3, 3])

    def _prepared(self, params: Mapping[str, Tensor], weights: Tensor) -> PoseFit:
        return PoseFit(
            self.rig, self._body(params), weights, iterations=self.iterations, tolerance=self.tolerance
        )

    def _fit(self, fit: PoseFit, target: Tensor, terms: JointTerms | None) -> NativeMotion:
        """Fit a chunk of frames (F, n, 3) [m]."""
        near, origin, known = _finite(fit.body, target, fit.weights)
        valid = known.any(1)
        with torch.no_grad():
            pose = fit(near.detach(), terms)
        rotations, pelvis = pose.relative[:, 1:], pose.translation
        if torch.is_grad_enabled() and near.requires_grad:
            target = near.detach()
            rotations, pelvis = attach_gradient(
                near, rotations, pelvis, model=self.rig, valid=valid,
                problem=lambda rows: fit.problem(target[rows], part_of_terms(terms, rows)),
            )  # fmt: skip
        posed = self.rig.posed(fit.body.identity, rotations, pelvis)
        error = torch.linalg.vector_norm(posed.detach() - near.detach(), dim=-1)
        residual = (error.square() @ fit.weights / fit.weights.sum()).sqrt()
        determined = torch.zeros(len(self.joint_names), dtype=torch.bool, device=self.device)
        determined[self.rig.solver.variables - 1] = True
        translation = (pelvis + origin - fit.body.pelvis) / self.scale
        return NativeMotion(
            joint_names=self.joint_names,
            rotations=matrix_to_axis_angle(rotations).masked_fill(~valid[:, None, None], 0),
            translation=translation.masked_fill(~valid[:, None], 0),
            params=fit.body.params,
            vertices=(posed + origin[:, None]) / self.scale,
            vertex_error=error.masked_fill(~known, torch.nan),
            determined=determined,
            valid=valid,
            converged=(pose.last_change < self.tolerance) & valid,
            iterations=pose.accepted,
            residual=residual.masked_fill(~valid, torch.nan),
        )


def _finite(body: NativeBody, target: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Targets about an origin of their own (F, n, 3) [m], the origin (F, 3), and which are known (F, n).

    Vertices without weight take the place of the rest mesh, and so does a whole frame that has a gap.
    """
    used = weights > 0
    whole = torch.isfinite(target[:, used]).flatten(1).all(1)
    known = whole[:, None] & used
    filled = torch.where(known[..., None], target, body.identity.rest)
    origin = filled[:, used][:, 0]
    return filled - origin[:, None], origin, known


class _Every:
    """All parameters of one body, without bounds."""

    def __init__(self, begin: Mapping[str, Tensor]) -> None:
        self._begin = begin
        self.start = torch.cat([value.flatten() for value in begin.values()]).double().cpu().numpy()
        self.lower, self.upper = (np.full(len(self.start), bound) for bound in (-np.inf, np.inf))

    def params(self, points: np.ndarray) -> dict[str, Tensor]:
        """Parameters of (m, k) points, each (m, *shape)."""
        first = next(iter(self._begin.values()))
        parts = torch.as_tensor(points).to(first).split([value.numel() for value in self._begin.values()], 1)
        given = zip(self._begin.items(), parts, strict=True)
        return {name: part.reshape(-1, *value.shape[1:]) for (name, value), part in given}

    def inward(self, point: np.ndarray, length: float) -> np.ndarray:
        """Steps (k,) of `length`."""
        return np.full(len(point), length)


def _joined(parts: Sequence[NativeMotion]) -> NativeMotion:
    """One motion of consecutive chunks of frames."""
    joined: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in _PER_FRAME}
    return replace(parts[0], **joined)
