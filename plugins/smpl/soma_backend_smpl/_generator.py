"""The model: parameters in, rest mesh out; and posed, with its own pose blend shapes and skeleton."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from soma_backend_smpl._model_file import ModelFile
from soma_core import InputError
from soma_core.plugin import LinearBasis, SkinnedModel, axis_angle_to_matrix

__all__ = ["SmplGenerator"]


class SmplGenerator:
    """SMPL, SMPL-H or SMPL-X of one gender; metres, +Y up, facing +Z.

    Args:
        model: the file.
        device, dtype: of all constants and results.
        parameter_count: number of betas that are declared; a file with fewer directions takes only zeros
            for the others.
        components: leading shape directions that are kept, others count as zero; None keeps all.
    """

    def __init__(
        self,
        model: ModelFile,
        device: torch.device,
        dtype: torch.dtype,
        *,
        parameter_count: int,
        components: int | None = None,
    ) -> None:
        self.family = model.family
        self._model = model
        self._tensor = functools.partial(torch.as_tensor, dtype=dtype, device=device)
        kept = min(parameter_count, model.shapes.shape[2], components or parameter_count)
        self._template = self._tensor(model.template)
        self._basis = self._tensor(np.ascontiguousarray(np.moveaxis(model.shapes[:, :, :kept], 2, 0)))

    def rest(self, params: Mapping[str, Tensor]) -> Tensor:
        """Vertices (batch, v, 3) [m] in the model's T-pose: template plus shape directions."""
        return self._template + torch.einsum("bk,kvc->bvc", self._coefficients(params), self._basis)

    def linear_basis(self) -> LinearBasis:
        """The template and the shape directions."""
        return LinearBasis(template=self._template, basis=self._basis, coefficients=self._coefficients)

    def _coefficients(self, params: Mapping[str, Tensor]) -> Tensor:
        betas, width = params["betas"], self._model.shapes.shape[2]
        looks = betas.device.type == "cpu" and not torch.compiler.is_compiling()
        if looks and bool((betas.detach()[:, width:] != 0).any()):
            raise InputError(
                "params['betas']",
                got=f"values beyond the first {width}",
                expected=f"at most {width}, as {self._model.path.name} has",
                fix="Shorten betas, or use a file with more shape directions.",
            )
        return betas[:, : len(self._basis)]

    @property
    def mean_hands(self) -> np.ndarray | None:
        """Axis-angle vectors (30, 3) [rad] of the fingers' mean pose, where the model's file has it."""
        return None if self._model.mean_hands is None else self._model.mean_hands.reshape(30, 3)

    @property
    def hand_components(self) -> np.ndarray | None:
        """Directions (2, n, 45) [rad] of the fingers of both hands, where the model's file has them."""
        return self._model.hand_components

    def rest_joints(self, params: Mapping[str, Tensor]) -> Tensor:
        """Joints (batch, J, 3) [m] of the rest mesh, in the order of ``family.joint_names``."""
        return self._regressor @ self.rest(params)

    def posed(self, params: Mapping[str, Tensor], pose: Mapping[str, Tensor]) -> Tensor:
        """Posed vertices (batch, v, 3) [m] by the model's own pose blend shapes and skinning.

        Args:
            params: as for :meth:`rest`; a batch of 1 is shared by all poses.
            pose: ``rotations``, local and relative to the T-pose, axis-angle [rad] (batch, J, 3), the
                pelvis first, as in the full ``poses`` of AMASS files; ``translation`` (batch, 3) [m],
                added to all vertices, default zero; ``expression`` (batch, e), SMPL-X only, default zero.

        Source: Loper et al., SMPL: A Skinned Multi-Person Linear Model, 2015, equations 2 to 9.
        """
        rotations = self._rotations(pose)
        rest = self.rest(params)
        if "expression" in pose:
            rest = rest + self._expression(pose["expression"])
        rotations, rest = _one_batch(rotations, rest)
        joints = self._regressor @ rest
        shaped = rest + self._pose_offsets(rotations)
        world = self._world(rotations, joints)
        skin = torch.einsum("vj,bjrc->bvrc", self._weights, world)
        posed = torch.einsum("bvrc,bvc->bvr", skin[..., :3], shaped) + skin[..., 3]
        return posed + pose["translation"][:, None] if "translation" in pose else posed

    def skinning(self, params: Mapping[str, Tensor]) -> SkinnedModel:
        """What :meth:`posed` skins, without expression."""
        rest = self.rest(params)
        return SkinnedModel(
            joint_names=self.family.joint_names,
            parents=self.family.parents,
            rest=rest,
            joints=self._regressor @ rest,
            weights=self._weights,
            pose_offsets=self._pose_offsets,
        )

    def triangles(self) -> Tensor:
        """Native vertex ids (t, 3)."""
        return torch.as_tensor(self._model.faces.astype(np.int64), device=self._template.device)

    def _pose_offsets(self, rotations: Tensor) -> Tensor:
        """Pose blend shapes (batch, v, 3) [m] of local rotations (batch, J, 3, 3)."""
        change = rotations[:, 1:] - torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        return (change.flatten(1) @ self._pose_directions).unflatten(1, (-1, 3))

    def _rotations(self, pose: Mapping[str, Tensor]) -> Tensor:
        known = ("rotations", "translation", "expression")
        strange = [name for name in pose if name not in known]
        got = pose["rotations"].shape if "rotations" in pose else "none"
        if strange or got == "none" or tuple(got)[1:] != (self.family.joint_count, 3):
            raise InputError(
                "pose",
                got=f"the key {strange[0]}" if strange else f"rotations of shape {got}",
                expected=f"rotations (batch, {self.family.joint_count}, 3), of the keys {', '.join(known)}",
                fix=f"Give one axis-angle vector a joint of {self.family.title}.",
            )
        return axis_angle_to_matrix(pose["rotations"])

    def _expression(self, values: Tensor) -> Tensor:
        count = self._model.expressions.shape[2]
        if values.shape[-1] > count:
            raise InputError(
                "pose['expression']",
                got=f"{values.shape[-1]} values",
                expected=f"at most {count}, as {self._model.path.name} has",
                fix="Leave the others out.",
            )
        return torch.einsum("bk,vck->bvc", values, self._expressions[:, :, : values.shape[-1]])

    def _world(self, rotations: Tensor, joints: Tensor) -> Tensor:
        """Transforms (batch, J, 3, 4) from the rest pose to the posed one."""
        turns: list[Tensor] = []
        places: list[Tensor] = []
        for joint, parent in enumerate(self.family.parents):
            if parent < 0:
                turns.append(rotations[:, joint])
                places.append(joints[:, joint])
                continue
            turns.append(turns[parent] @ rotations[:, joint])
            offset = joints[:, joint] - joints[:, parent]
            places.append(places[parent] + torch.einsum("brc,bc->br", turns[parent], offset))
        turn, place = torch.stack(turns, 1), torch.stack(places, 1)
        shift = place - torch.einsum("bjrc,bjc->bjr", turn, joints)
        return torch.cat((turn, shift[..., None]), -1)

    @functools.cached_property
    def _regressor(self) -> Tensor:
        return self._tensor(self._model.regressor)

    @functools.cached_property
    def _weights(self) -> Tensor:
        return self._tensor(self._model.weights)

    @functools.cached_property
    def _expressions(self) -> Tensor:
        return self._tensor(self._model.expressions)

    @functools.cached_property
    def _pose_directions(self) -> Tensor:
        directions = self._model.pose_directions
        return self._tensor(np.ascontiguousarray(directions.reshape(-1, directions.shape[2]).T))


def _one_batch(rotations: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    sizes = {len(rotations), len(rest)} - {1}
    if len(sizes) > 1:
        raise InputError(
            "pose",
            got=f"{len(rotations)} poses for {len(rest)} bodies",
            expected="as many of both, or one of either",
            fix="Give one pose a body, one pose for all, or one body for all.",
        )
    count = max(sizes, default=1)
    return rotations.expand(count, -1, -1, -1), rest.expand(count, -1, -1)
