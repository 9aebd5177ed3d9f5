"""SomaLayer: the whole forward path of the paper (section 3) as one module without hidden state."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast, get_args

import torch
from torch import Tensor

from soma_core._derived import own_precision
from soma_core._inputs import (
    check_bone_scale,
    check_choice,
    check_kind,
    check_rest,
    check_rotations,
    check_translation,
    common_batch,
)
from soma_core.animation.engine import Animation, Body, ProceduralAnimation
from soma_core.animation.fused import FusedPose
from soma_core.animation.kinematics import relative_from_absolute
from soma_core.animation.posed import Posed
from soma_core.backends.parameters import batch_parameters
from soma_core.backends.rest_shape import make_rest_shape
from soma_core.compiled import CompiledLayer
from soma_core.correctives.model import find_correctives, load_correctives
from soma_core.errors import check_type
from soma_core.geometry.torch_func import untracked
from soma_core.kernels.ahead import kernels_ahead
from soma_core.paths import expanded
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import HasSkinning
from soma_core.points.part import PartialBodies, as_matrices
from soma_core.rig import load_canonical
from soma_core.rig.manifest import NEUTRAL_NAME
from soma_core.rig.mesh import CanonicalMesh, Lod
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity
from soma_core.topology.lod_transfer import LodTransfer

__all__ = ["Kernels", "SomaLayer"]

Kernels = Literal["auto", "torch", "warp"]

_CHUNK = 32
"""Bodies evaluated at a time where nothing is kept for a gradient."""


class SomaLayer(PartialBodies):
    """Any identity backend, animated on the canonical rig.

    ``identity`` and ``pose`` are functions of their arguments: the layer keeps no identity and no cache,
    so threads, batches and ``torch.compile`` cannot trip over each other.

    Args:
        backend: name of an installed backend; ``soma backends`` lists them.
        options: the backend's own options.
        lod: level of detail of every mesh that comes out; the skeleton of ``xlo`` is fitted on ``low``.
        device, dtype: of all constants and results; float32 or float64.
        kernels: ``torch`` (the reference), ``warp`` or ``auto``, whichever the benchmark found faster.
        exact: evaluate the generator and the transfer vertex by vertex even where the backend is linear
            and could be composed; slower, the reference for tests.
        repose: bring every identity to the rig's bind pose (correctives and twist vanish there).
        procedural: skin with the rig's twist joints where it has any; without, on the 78 public joints alone.
        correctives: checkpoint of pose correctives, None for none, or ``auto``: that of the shipped rig where
            its twist joints are in use and bodies are reposed. ``correctives_file`` says what was found.
        validate: check that matrices are rotations; finiteness on CPU only, where nothing waits for it.
        canonical: another mesh and rig than the shipped ones.
        assets: folder of SOMA's assets with all that belongs to them; default: that of ``soma assets show``.
        registry: where backends are looked up.

    Raises:
        InputError, BackendError: an unknown choice; the backend is not installed or does not build.
        AssetError: a checkpoint is missing, damaged or made for another rig.
    """

    takes: ClassVar = {
        "options": ((Mapping, type(None)), "Give each by its name: {'NAME': value}."),
        **dict.fromkeys(("correctives", "assets"), ((str, os.PathLike, type(None)), "Name it, or None.")),
        **dict.fromkeys(("exact", "repose", "procedural", "validate"), ((bool,), "Pass True or False.")),
    }

    def __init__(
        self,
        backend: str = "soma",
        *,
        options: Mapping[str, Any] | None = None,
        lod: Lod = "mid",
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        kernels: Kernels = "auto",
        exact: bool = False,
        repose: bool = True,
        procedural: bool = True,
        correctives: Path | str | None = "auto",
        validate: bool = True,
        canonical: tuple[CanonicalMesh, Rig] | None = None,
        assets: Path | str | None = None,
        registry: Registry | None = None,
    ) -> None:
        super().__init__(locals(), device, dtype)
        check_choice("lod", lod, get_args(Lod))
        check_choice("kernels", kernels, get_args(Kernels))
        self.backend, self.kernels = backend, kernels
        self.options = dict(options or {})
        self.exact, self.repose, self.validate = exact, repose, validate
        self.mesh, self.rig = canonical or load_canonical(lod, expanded(assets) if assets else None)
        if self.mesh.root is not None and backend == "soma":
            self.options.setdefault("shape_space", str(self.mesh.root / NEUTRAL_NAME))
        self.procedural = procedural and self.rig.procedural is not None
        shipped = self.procedural and repose and canonical is None
        self.correctives_file = find_correctives(correctives, shipped=shipped, root=self.mesh.root)
        self.registry = registry or default_registry()
        self.spec = self.registry.spec(backend)
        self._build(self.device, dtype)

    def _build(self, device: torch.device, dtype: torch.dtype) -> None:
        self.device, self.dtype = device, dtype
        with kernels_ahead(self.kernels, device, dtype, wrap=self.spec.wrap is not None):
            self._build_rest_shape(device, dtype)
        self.animation = Animation(self.rig, device=device, dtype=dtype, kernels=self.kernels)
        self.posing = self.animation
        if self.procedural:
            self.posing = ProceduralAnimation(self.rig, device=device, dtype=dtype, kernels=self.kernels)
        self.correctives = load_correctives(
            self.correctives_file, self.mesh, self.rig, dtype=dtype, device=device
        )
        self.fused: FusedPose | None = None
        if self.kernels != "torch":
            self.fuse(by_patches=device.type == "cuda")

    def _build_rest_shape(self, device: torch.device, dtype: torch.dtype) -> None:
        generator = self.registry.generator(self.backend, device=device, dtype=dtype, options=self.options)
        self.tells_skinning = isinstance(generator, HasSkinning)
        wrap_mesh = self.mesh if self.mesh.lod == "mid" else load_canonical("mid", self.mesh.root)[0]
        mesh, rig, reduction = self.mesh, self.rig, None
        if self.mesh.lod == "xlo":
            mesh, rig = load_canonical("low", self.mesh.root)
            reduction = LodTransfer(mesh, self.mesh, device=device, dtype=dtype)
        self.rest_shape = make_rest_shape(
            self.spec, generator, mesh, rig, device=device, dtype=dtype, exact=self.exact,
            warp=self.kernels != "torch", wrap_mesh=wrap_mesh, reduction=reduction,
            isolated=functools.partial(self.registry.isolated, self.backend),
        )  # fmt: skip

    def fuse(self, *, by_patches: bool = True) -> None:
        """Let few kernels do what no gradient is asked of; no derivative is lost.

        `by_patches` is how a GPU does it. On a CPU, where that serves tests, it runs on one core.
        """
        fused = FusedPose(
            self.posing, self.correctives, dtype=self.dtype, device=self.device, by_patches=by_patches
        )
        self.animation.fuse(by_patches=by_patches)
        self.animation.skinning.blend = self.animation.blend
        self.posing.posed_skinning.blend = fused.skin
        fits = fused.fits and (self.animation.patches is not None or not by_patches)
        self.fused = fused if fits else None
        self.rest_shape.fit.rotations.fused = True

    def extra_repr(self) -> str:
        """What was chosen, for ``repr``."""
        made = f"backend={self.backend!r}, lod={self.mesh.lod!r}, procedural={self.procedural}"
        return f"{made}, correctives={str(self.correctives_file) if self.correctives_file else None!r}"

    @property
    def faces(self) -> Any:
        """Triangles of the posed vertices, a numpy array (t, 3) int32."""
        return self.mesh.triangles

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the user joints, in the order of `rotations`."""
        return self.rig.user_joint_names

    @own_precision
    def identity(self, params: Mapping[str, Any] | None = None) -> Identity:
        """Prepare identities: rest shape on the canonical mesh and the skeleton fitted to it.

        Args:
            params: name -> number, list, array or tensor of shape ``(batch, *shape)`` or one sample; what is
                left out takes its default. ``soma backends show`` lists names and ranges.

        Returns:
            An immutable identity [m]; paper, sections 3.2 to 3.4. Differentiable in every parameter.
        """
        batch = batch_parameters(self.spec, params, device=self.device, dtype=self.dtype)
        return self._identity(batch, *self.rest_shape(batch))

    @own_precision
    def identity_from_rest(self, rest: Tensor) -> Identity:
        """Prepare identities of bodies that no parameters describe, such as scans on the canonical mesh.

        Args:
            rest: (batch, v, 3) [m], +Y up, near the bind pose; the skeleton is fitted to it, so that a layer
                of lod ``xlo`` takes the low mesh.

        Raises:
            InputError: a wrong shape, dtype or device, or a NaN.
        """
        reduction = self.rest_shape.reduction
        count = self.mesh.vertex_count if reduction is None else reduction.source_count
        rest = check_rest(rest, count, self.dtype, self.device)
        points = rest if reduction is None else reduction(rest)
        return self._identity({}, points.permute(2, 1, 0).contiguous(), self.rest_shape.fit(rest))

    def _identity(self, params: Mapping[str, Tensor], points: Tensor, fitted: Tensor) -> Identity:
        rest, bind = self.animation.repose(points, fitted) if self.repose else (points, fitted)
        return Identity(
            rest=rest.permute(2, 1, 0), bind_world=bind, fitted_rest=points.permute(2, 1, 0),
            fitted_world=fitted, backend=self.backend, rig_revision=self.rig.revision, params=params,
        )  # fmt: skip

    @own_precision
    def pose(
        self,
        identity: Identity,
        rotations: Tensor,
        translation: Tensor | None = None,
        *,
        absolute: bool = False,
        bone_scale: Tensor | None = None,
        vertices: Tensor | None = None,
    ) -> Posed:
        """Pose identities (paper, section 3.5.1).

        Args:
            identity: batch of 1, shared by all poses, or of the same size as `rotations`.
            rotations: axis-angle [rad] (batch, J - 1, 3) or matrices (batch, J - 1, 3, 3). Zero is the
                T-pose: rotations are relative to it, in world-aligned axes. A batch of 1 is shared by all
                identities.
            translation: world position of the Hips [m], (batch, 3) or (3,); default the origin.
            absolute: `rotations` are local rotations of the rig's own axes instead.
            bone_scale: (batch, J - 1) or (1, J - 1) factors of the bone that leads to each joint, applied
                when posing; the skin is not refitted. That of the Hips has no effect.
            vertices: (u,) ids of those that are wanted; :meth:`subset` prepares them for many calls.

        Raises:
            InputError: a wrong shape, dtype or device, a NaN, a matrix that is no rotation, a bone scale
                that is not positive.
        """
        given = identity, rotations, translation
        if vertices is not None:
            return self.subset(vertices).pose(*given, absolute=absolute, bone_scale=bone_scale)
        return self.pose_checked(self._body(*given, bone_scale), absolute=absolute)

    @own_precision
    def pose_checked(self, body: Body, *, absolute: bool = False) -> Posed:
        """:meth:`pose` without its checks, of rotation matrices: for loops that check once."""
        if self._fusible(*body[:4]):
            assert self.fused is not None
            return self.fused(*body[:3], absolute=absolute, bone_scale=body.bone_scale)
        body = body._replace(relative=as_matrices(body.relative))
        moves = self._offsets(body.identity, body.relative, absolute=absolute)
        return self.posing.pose(*body[:3], absolute=absolute, bone_scale=body.bone_scale, offsets=moves)

    def compiled(
        self,
        *,
        batch: int,
        identities: int = 1,
        params: bool = False,
        absolute: bool = False,
        matrices: bool = False,
    ) -> CompiledLayer:
        """:meth:`pose` of `batch` bodies, or with `params` the layer, as one CUDA graph; see its class."""
        return CompiledLayer(
            self, batch=batch, identities=identities, params=params, absolute=absolute, matrices=matrices
        )

    @own_precision
    def pose_plain(
        self,
        identity: Identity,
        rotations: Tensor,
        translation: Tensor | None = None,
        *,
        absolute: bool = False,
        bone_scale: Tensor | None = None,
    ) -> Posed:
        """Pose by linear blend skinning on the public joints alone, without twist joints or correctives.

        Takes and raises what :meth:`pose` does. Joints are the same; the difference is that of the vertices.
        """
        body = self._body(identity, rotations, translation, bone_scale)
        plain, scale = self.animation, body.bone_scale
        if self._fusible(*body[:4]):
            assert self.fused is not None
            return cast(Posed, self.fused(*body[:3], absolute=absolute, bone_scale=scale, plain=plain))
        turns = as_matrices(body.relative)
        return plain.pose(identity, turns, body.translation, absolute=absolute, bone_scale=scale)

    def _fusible(
        self, identity: Identity, relative: Tensor, translation: Tensor, bone_scale: Tensor | None
    ) -> bool:
        """Whether the kernels without a derivative may pose these bodies."""
        given = identity.rest, identity.bind_world, relative, translation, bone_scale
        return self.fused is not None and untracked(*given)

    @own_precision
    def helper_transforms(
        self, identity: Identity, transforms: Tensor, bone_scale: Tensor | None = None
    ) -> Tensor:
        """World transforms of the twist joints of posed bodies, (batch, H, 4, 4) [m]; H = 0 without them.

        Args:
            identity: what was posed.
            transforms: ``Posed.transforms``.
            bone_scale: as given to :meth:`pose`.
        """
        if not isinstance(self.posing, ProceduralAnimation):
            return transforms[:, :0]
        return self.posing.helper_transforms(identity, transforms, bone_scale)

    def _offsets(self, identity: Identity, relative: Tensor, *, absolute: bool) -> Tensor | None:
        """What the correctives add to the rest shape, (batch, v, 3) [m]; None without them."""
        if self.correctives is None:
            return None
        if absolute:
            kinematics = self.animation.kinematics
            relative = relative_from_absolute(relative, kinematics.orient[1:], kinematics.parent_orient[1:])
        return self.correctives(relative, identity.bind_world)

    def _body(
        self, identity: Identity, rotations: Tensor, translation: Tensor | None, bone_scale: Tensor | None
    ) -> Body:
        """The arguments of `pose`, checked, of one batch size; as matrices if not :meth:`_fusible`."""
        relative = check_rotations(
            rotations, len(self.joint_names), self.dtype, self.device, validate=self.validate, convert=False
        )
        self.check_identity(identity)
        batch = common_batch(identity.batch_size, len(relative))
        shift = check_translation(translation, batch, self.dtype, self.device)
        bone_scale = check_bone_scale(bone_scale, batch, len(self.joint_names), self.dtype, self.device)
        if not self._fusible(identity, relative, shift, bone_scale):
            relative = as_matrices(relative)
        return Body(identity, relative.expand(batch, *relative.shape[1:]), shift, bone_scale)

    def check_identity(self, identity: Identity) -> None:
        """Refuse (InputError) one that another kind of layer made: other rig, LOD, dtype or device."""
        check_type("identity", identity, Identity, fix="Make one: layer.identity(params).")
        identity.check(self.mesh.vertex_count, self.rig.revision)
        check_kind("identity", identity.rest, self.dtype, self.device)

    @own_precision
    def forward(
        self,
        params: Mapping[str, Any] | None,
        rotations: Tensor,
        translation: Tensor | None = None,
        *,
        absolute: bool = False,
        bone_scale: Tensor | None = None,
    ) -> Posed:
        """``pose(identity(params), rotations, translation)``; identities are not kept.

        Without gradients a large batch runs through in chunks that stay in cache.
        """
        batch = batch_parameters(self.spec, params, device=self.device, dtype=self.dtype)
        relative = check_rotations(
            rotations, len(self.joint_names), self.dtype, self.device, validate=self.validate, convert=False
        )
        if self.fused is None:
            relative = as_matrices(relative)
        identities = len(next(iter(batch.values()), relative))
        size = common_batch(identities, len(relative))
        shift = check_translation(translation, size, self.dtype, self.device)
        bone_scale = check_bone_scale(bone_scale, size, len(self.joint_names), self.dtype, self.device)
        relative = relative.expand(size, *relative.shape[1:])
        given = (*batch.values(), relative, shift, *([] if bone_scale is None else [bone_scale]))
        small = size <= _CHUNK or self.animation.warp_skinning
        at_once = self.fused.patches is not None if self.fused is not None else small
        # a compiler plans its own memory
        if not untracked(*given) or identities < size or at_once or not size:
            identity = self._identity(batch, *self.rest_shape(batch))
            return self.pose_checked(Body(identity, relative, shift, bone_scale), absolute=absolute)

        def part_of(chunk: slice) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor | None]:
            part = {name: value[chunk] for name, value in batch.items()}
            scale = None if bone_scale is None else bone_scale.expand(size, -1)[chunk]
            return part, relative[chunk], shift[chunk], scale

        def body(part: dict[str, Tensor], turns: Tensor, place: Tensor, scale: Tensor | None) -> Body:
            identity = self._identity(part, *self.rest_shape(part))
            return Body(identity, turns, place, scale, self._offsets(identity, turns, absolute=absolute))

        parts = (part_of(slice(start, start + _CHUNK)) for start in range(0, size, _CHUNK))
        if self.fused is None:
            return self.posing.pose_all((body(*part) for part in parts), size, absolute=absolute)
        rested = ((*self.rest_shape(part), *rest) for part, *rest in parts)
        return self.fused.whole(rested, size, self.animation if self.repose else None, absolute=absolute)

    if TYPE_CHECKING:  # torch says that a module returns anything
        __call__ = forward
