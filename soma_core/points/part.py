"""Bodies in part: joints without skin, some of the vertices, named points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor

from soma_core._derived import Derived, own_precision
from soma_core.animation.engine import Animation, Body
from soma_core.animation.fused import FusedPose
from soma_core.animation.kinematics import relative_from_absolute
from soma_core.animation.posed import Posed
from soma_core.animation.skinning import Skinning
from soma_core.backends.parameters import batch_parameters
from soma_core.backends.rest_shape import ComposedRestShape, ExactRestShape
from soma_core.correctives.model import Correctives
from soma_core.errors import InputError, check_type
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.geometry.sparse import SparseRows
from soma_core.plugin.spec import BackendSpec
from soma_core.points.places import PointPlaces
from soma_core.points.point_set import PointSet, load_point_set
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["BodyPart", "PartialBodies", "as_matrices"]


class _Layer(Protocol):
    """What is asked of a ``SomaLayer``, which makes these and so cannot be imported here."""

    device: torch.device
    dtype: torch.dtype
    mesh: CanonicalMesh
    rig: Rig
    spec: BackendSpec
    repose: bool
    animation: Animation
    posing: Animation
    correctives: Correctives | None
    rest_shape: ComposedRestShape | ExactRestShape
    fused: FusedPose | None
    _fusible: Callable[..., bool]
    _body: Callable[..., Body]
    _identity: Callable[..., Identity]


class BodyPart(torch.nn.Module):
    """Some vertices of a layer's bodies, and all joints; made by ``SomaLayer.subset``.

    A layer that is moved or converted afterwards is not followed.

    Args:
        layer: the ``SomaLayer``.
        ids: (u,) vertices of its mesh, in the order that is wanted; none for joints alone.
    """

    def __init__(self, layer: _Layer, ids: np.ndarray) -> None:
        super().__init__()
        self._layer = [layer]  # in a list: a part is no parent of its layer's buffers
        kind: dict[str, Any] = {"dtype": layer.dtype, "device": layer.device}
        self.register_buffer("ids", torch.as_tensor(ids, device=layer.device), persistent=False)
        self.correctives = self.skinning = self.rest_skinning = None
        if not len(ids):
            return
        self.skinning = Skinning(layer.posing.posed_skinning.weights.scipy()[ids], **kind)
        self.rest_skinning = Skinning(layer.animation.skinning.weights.scipy()[ids], **kind)
        if layer.correctives is not None:
            self.correctives = _some_correctives(layer.correctives, ids, **kind)

    @property
    def layer(self) -> _Layer:
        """The layer that this is a part of."""
        return self._layer[0]

    def identity(self, params: Mapping[str, Any] | None = None) -> Identity:
        """The same as ``SomaLayer.identity``, with the vertices of this part alone, (batch, u, 3) [m]."""
        layer = self.layer
        batch = batch_parameters(layer.spec, params, device=layer.device, dtype=layer.dtype)
        points, fitted = _some_rest(layer.rest_shape, batch, self.ids)
        rest, bind = points, fitted
        if layer.repose:
            transforms, bind = layer.animation.to_bind_pose(fitted)
            rest = (
                points if self.rest_skinning is None else self.rest_skinning(points, transforms, rows=False)
            )
        return Identity(
            rest=rest.permute(2, 1, 0), bind_world=bind, fitted_rest=points.permute(2, 1, 0),
            fitted_world=fitted, rig_revision=layer.rig.revision, params=batch,
        )  # fmt: skip

    def pose(
        self,
        identity: Identity,
        rotations: Tensor,
        translation: Tensor | None = None,
        *,
        absolute: bool = False,
        bone_scale: Tensor | None = None,
    ) -> Posed:
        """Pose identities of the layer; takes and raises what ``SomaLayer.pose`` does.

        Returns:
            The vertices of this part, (batch, u, 3), all joints and transforms [m]. Differentiable.
        """
        layer = self.layer
        body = layer._body(identity, rotations, translation, bone_scale)
        return self._posed(
            body._replace(identity=replace(identity, rest=identity.rest[:, self.ids])), absolute
        )

    def forward(
        self,
        params: Mapping[str, Any] | None,
        rotations: Tensor,
        translation: Tensor | None = None,
        *,
        absolute: bool = False,
        bone_scale: Tensor | None = None,
    ) -> Posed:
        """Pose bodies of parameters, as ``SomaLayer.forward`` does, without the rest of their mesh."""
        layer, own = self.layer, self.identity(params)
        whole = replace(
            own, rest=own.rest.new_zeros(1, 1, 3).expand(len(own.rest), layer.mesh.vertex_count, 3)
        )
        body = layer._body(whole, rotations, translation, bone_scale)
        return self._posed(body._replace(identity=own), absolute)

    if TYPE_CHECKING:  # torch says that a module returns anything
        __call__ = forward

    def _posed(self, body: Body, absolute: bool) -> Posed:
        layer, identity = self.layer, body.identity
        if layer._fusible(*body[:4]):
            assert layer.fused is not None
            world, joints, skin, _ = layer.fused._bodies(
                identity.bind_world, *body[1:3], absolute=absolute, bone_scale=body.bone_scale,
                skinned=self.skinning is not None,
            )  # fmt: skip
        else:
            body = body._replace(relative=as_matrices(body.relative))
            world = layer.posing.transforms(body, absolute=absolute)
            joints, skin = world[:, 1:, :3, 3], None
        vertices = world.new_zeros(len(world), 0, 3)
        if self.skinning is not None:
            if skin is None:
                turned = world[..., :3, :3], world[..., :3, 3], body.bone_scale
                skin = layer.posing._skinning_transforms(identity, *turned)
            rest = identity.rest
            if self.correctives is not None:
                rest = rest + self._moves(identity, as_matrices(body.relative), absolute)
            vertices = self.skinning(rest.permute(2, 1, 0), skin, rows=True)
        return Posed(vertices=vertices, joints=joints, transforms=world)

    def _moves(self, identity: Identity, relative: Tensor, absolute: bool) -> Tensor:
        """What correctives add to the vertices of this part, (batch, u, 3) [m]."""
        assert self.correctives is not None
        if absolute:
            kinematics = self.layer.animation.kinematics
            relative = relative_from_absolute(relative, kinematics.orient[1:], kinematics.parent_orient[1:])
        return self.correctives(relative, identity.bind_world)


class PartialBodies(Derived):
    """What a layer gives of bodies without their whole mesh."""

    animation: Animation
    posing: Animation
    correctives: Correctives | None
    mesh: CanonicalMesh
    rig: Rig

    @property
    def plain(self) -> bool:
        """Whether a layer poses by linear blend skinning alone, without twist joints and correctives."""
        return self.posing is self.animation and self.correctives is None

    @own_precision
    def subset(self, ids: Tensor | Sequence[int] | np.ndarray) -> BodyPart:
        """Prepare some vertices of this layer's mesh, so that posing costs as much as they do.

        Args:
            ids: (u,) vertices, in the order that is wanted.

        Raises:
            InputError: an id that the mesh does not have; a mesh that is reduced from another (xlo).
        """
        check_type("vertices", ids, Tensor, list, tuple, range, np.ndarray, fix="Give ids of the mesh.")
        given = torch.as_tensor(ids).reshape(-1)
        count = self.mesh.vertex_count
        if given.is_floating_point() or bool(((given < 0) | (given >= count)).any()):
            wrong = next((value for value in given.tolist() if not 0 <= value < count), given.dtype)
            raise InputError(
                "vertices", got=wrong, expected=f"whole numbers from 0 to {count - 1}",
                fix="Take ids of the layer's own mesh; lod=low has the first 4505 of mid.",
            )  # fmt: skip
        return BodyPart(self, given.cpu().numpy().astype(np.int64))

    @own_precision
    def joints(
        self,
        body: Identity | Mapping[str, Any] | None,
        rotations: Tensor,
        translation: Tensor | None = None,
        *,
        absolute: bool = False,
        bone_scale: Tensor | None = None,
    ) -> Posed:
        """Joints without skin: what :meth:`pose` gives, or with parameters the layer, but for the vertices.

        Args:
            body: an identity, or parameters as :meth:`identity` takes them.
            rotations, translation, absolute, bone_scale: as in :meth:`pose`.

        Returns:
            Positions and transforms of all joints [m]; no vertices, (batch, 0, 3). Differentiable.
        """
        part = BodyPart(self, np.zeros(0, np.int64))
        act = part.pose if isinstance(body, Identity) else part
        return act(body, rotations, translation, absolute=absolute, bone_scale=bone_scale)

    def places(self, points: PointSet | Path | str) -> PointPlaces:
        """Prepare the points of a set on this layer's mesh and rig, for many calls of :meth:`points`.

        Raises:
            InputError: no such set, or a joint or a vertex that this mesh does not have.
        """
        found = load_point_set(points)
        return PointPlaces(found, self.mesh, self.rig, dtype=self.dtype, device=self.device)

    @own_precision
    def points(self, posed: Posed, points: PointPlaces | PointSet | Path | str) -> Tensor:
        """Points (batch, P, 3) [m] of posed bodies, such as keypoints of a detector; differentiable.

        Args:
            posed: of this layer.
            points: a set, its name (``soma points list``) or file, or what :meth:`places` prepared.
        """
        check_type("posed", posed, Posed, fix="Give what layer.pose(...) returns.")
        places = points if isinstance(points, PointPlaces) else self.places(points)
        return places(posed.transforms, posed.vertices[:, places.vertex_ids])


def as_matrices(rotations: Tensor) -> Tensor:
    """Matrices (..., 3, 3) from checked rotations of either form, (B, J - 1, 3) or (B, J - 1, 3, 3)."""
    return axis_angle_to_matrix(rotations) if rotations.ndim == 3 else rotations


def _some_correctives(whole: Correctives, ids: np.ndarray, *, dtype, device) -> Correctives:
    """Correctives of some vertices: activations that move none of them are left out."""
    rows = (3 * ids[:, None] + np.arange(3)).ravel()
    second = whole.second.scipy()[rows].tocsc()
    used = np.flatnonzero(np.diff(second.indptr))
    part = torch.nn.Module.__new__(Correctives)
    part.__dict__.update(whole.__dict__)
    part._modules = dict(whole._modules)
    part.first = SparseRows(whole.first.scipy()[used], dtype=dtype, device=device)
    part.second = SparseRows(second[:, used].tocsr(), dtype=dtype, device=device)
    part.owner = whole.owner[used]
    return part


def _some_rest(
    shape: ComposedRestShape | ExactRestShape, params: Mapping[str, Tensor], ids: Tensor
) -> tuple[Tensor, Tensor]:
    """Planes (3, u, B) of some rest vertices and fitted transforms (B, J, 4, 4) [m]."""
    if isinstance(shape, ExactRestShape):
        points, fitted = shape(params)
        return points[:, ids], fitted
    return shape.some(params, ids)
