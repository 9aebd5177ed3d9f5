"""The generator: the user's file, given identity, scales and bone lengths; and posed by its own rig."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from soma_backend_mhr._files import EXPRESSIONS
from soma_backend_mhr._model_file import Model
from soma_core import InputError

__all__ = ["BONE_LENGTHS", "POSE", "SCALES", "MhrGenerator"]

POSE, BONE_LENGTHS, SCALES = 130, 6, 68
"""The 204 model parameters in their order: pose, bone lengths, scales."""

_ROOT, _SPREAD, _LARGEST = 6, 0.6, 1.6
"""Parameters of the root; standard deviation and largest value of an angle [rad]."""


class MhrGenerator:
    """MHR; centimetres, +Y up, facing +Z, in the A-pose that its zero is.

    Args:
        model: the loaded file.
        device: where it was loaded to.
    """

    pose_size, root_size, heading = POSE, 6, 4

    def __init__(self, model: Model, device: torch.device) -> None:
        self._model, self._device = model, device

    def rest(self, params: Mapping[str, Tensor]) -> Tensor:
        """Vertices (batch, v, 3) [cm] at pose zero, without expression."""
        still = params["identity"].new_zeros(len(params["identity"]), POSE)
        return self._evaluate(params, still, still.new_zeros(len(still), EXPRESSIONS))

    def posed(self, params: Mapping[str, Tensor], pose: Mapping[str, Tensor]) -> Tensor:
        """Vertices (batch, v, 3) [cm] posed by the model's own skeleton, skinning and pose correctives.

        Args:
            params: as for :meth:`rest`; a batch of 1 is shared by all poses.
            pose: ``parameters`` (batch, 130), the first of the model parameters: root translation in units
                of 10 cm, root Euler angles xyz and joint angles [rad]; ``expression`` (batch, 72), default
                zero. The model parameters of SAM 3D Body are these, then ``bone_lengths`` (6) and
                ``scales`` (68) of `params`.

        Raises:
            InputError: another key or shape, or batches that do not agree.
        """
        _check_pose(pose)
        parameters = pose["parameters"]
        expression = pose.get("expression", parameters.new_zeros(1, EXPRESSIONS))
        sizes = {len(params["identity"]), len(parameters), len(expression)} - {1}
        if len(sizes) > 1:
            raise InputError(
                "pose",
                got=f"{len(parameters)} poses and {len(expression)} expressions for "
                f"{len(params['identity'])} bodies",
                expected="as many of each, or one",
                fix="Give one pose a body, one pose for all, or one body for all.",
            )
        count = max(sizes, default=1)
        shared = {name: value.expand(count, -1) for name, value in params.items()}
        return self._evaluate(shared, parameters.expand(count, -1), expression.expand(count, -1))

    def own_arrays(self, params: Mapping[str, Tensor], parameters: Tensor) -> dict[str, Tensor]:
        """Poses (frames, 130) of one body as SAM 3D Body names them: 204 parameters, shape, expression."""
        count = len(parameters)
        shared = {name: value.expand(count, -1) for name, value in params.items()}
        return {
            "mhr_model_params": torch.cat((parameters, shared["bone_lengths"], shared["scales"]), 1),
            "shape_params": shared["identity"],
            "expr_params": parameters.new_zeros(count, EXPRESSIONS),
        }

    def random_poses(self, count: int, seed: int) -> dict[str, Tensor]:
        """Poses for :meth:`posed`: joint angles about zero, the root at rest.

        Every pose is active to a degree of its own, so that mild and extreme ones are both met.
        """
        random = torch.Generator().manual_seed(seed)
        angles = torch.randn(count, POSE, generator=random) * torch.rand(count, 1, generator=random)
        angles[:, :_ROOT] = 0
        return {"parameters": (_SPREAD * angles).clamp(-_LARGEST, _LARGEST).to(self._device)}

    def triangles(self) -> Tensor:
        """Native vertex ids (t, 3)."""
        return self._model.faces.to(self._device)

    def _evaluate(self, params: Mapping[str, Tensor], pose: Tensor, expression: Tensor) -> Tensor:
        parameters = torch.cat((pose, params["bone_lengths"], params["scales"]), dim=1)
        return self._model.evaluate(params["identity"], parameters, expression)


def _check_pose(pose: Mapping[str, Tensor]) -> None:
    widths = {"parameters": POSE, "expression": EXPRESSIONS}
    strange = [name for name in pose if name not in widths]
    shapes = {name: tuple(value.shape) for name, value in pose.items()}
    fits = all(len(shape) == 2 and shape[1] == widths.get(name) for name, shape in shapes.items())
    if strange or "parameters" not in pose or not fits:
        raise InputError(
            "pose",
            got=", ".join(f"{name} {shape}" for name, shape in shapes.items()) or "nothing",
            expected=f"parameters (batch, {POSE}), and expression (batch, {EXPRESSIONS}) or none",
            fix="Of the 204 model parameters give the first 130; the others are bone_lengths and scales.",
        )
