"""Checks of pose inputs at the public boundary."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.geometry.torch_func import transformed

__all__ = [
    "check_bone_scale",
    "check_choice",
    "check_kind",
    "check_rest",
    "check_rotations",
    "check_translation",
    "common_batch",
    "may_look",
    "usable_device",
    "widened",
]

_ROTATION_TOLERANCE = 1e-2
"""Largest accepted entry of |R^T R - I|: above it a matrix is a mistake, not rounding."""


def check_choice(argument: str, value: object, choices: tuple[object, ...]) -> None:
    """Refuse what is none of `choices`."""
    if value not in choices:
        raise InputError(
            argument,
            got=repr(value),
            expected="one of " + ", ".join(map(repr, choices)),
            fix=f"Pass {argument}={choices[0]!r}.",
        )


def usable_device(device: torch.device | str) -> torch.device:
    """The device by its name, if tensors can be made there; otherwise a refusal that says why not."""
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # torch raises all three
        unknown = "Expected one of" in str(error)
        why = "no name of a device" if unknown else str(error).splitlines()[0].rstrip(".")
        if str(device).startswith("cuda") and torch.version.cuda is None:
            why = "this PyTorch was built without CUDA"
        count = torch.cuda.device_count()
        known = ", ".join(["cpu", *(f"cuda:{index}" for index in range(count))])
        raise InputError(
            "device", got=f"{str(device)!r} ({why})", expected=f"a device of this machine: {known}",
            fix="Pass device=cpu.",
        ) from error  # fmt: skip
    return found


def widened(value: Tensor, dtype: torch.dtype) -> Tensor:
    """A tensor of half precision, which a network around may compute in, as `dtype`; the rest as it is."""
    half = isinstance(value, Tensor) and value.dtype in (torch.float16, torch.bfloat16)
    return value.to(dtype) if half else value


def check_kind(name: str, value: object, dtype: torch.dtype, device: torch.device) -> None:
    """Refuse what is no tensor, or a tensor of another dtype or device."""
    if not isinstance(value, Tensor):
        raise InputError(
            name,
            got=type(value).__name__,
            expected="a torch.Tensor",
            fix=f"Wrap it: torch.as_tensor({name}).",
        )
    if value.dtype != dtype:
        raise InputError(
            name,
            got=value.dtype,
            expected=dtype,
            fix=f"Call {name}.to({dtype}) or build the layer with its dtype.",
        )
    if value.device.type != device.type or (device.index is not None and value.device != device):
        raise InputError(name, got=value.device, expected=device, fix=f"Call {name}.to({str(device)!r}).")


def may_look(value: Tensor) -> bool:
    """Whether values can be read without waiting for a device or breaking a graph or a transform."""
    return not torch.compiler.is_compiling() and value.device.type == "cpu" and not transformed()


def _check_finite(name: str, value: Tensor) -> None:
    if not may_look(value) or torch.isfinite(value.detach().sum()):
        return
    finite = torch.isfinite(value.detach())
    if finite.all():  # the sum overflowed, the entries are fine
        return
    where = tuple(int(i) for i in torch.nonzero(~finite)[0])
    raise InputError(
        name,
        got=f"{float(value.detach()[where])} at index {where}",
        expected="finite numbers",
        fix="Look at where this array was computed.",
    )


def check_rotations(
    rotations: Tensor,
    joint_count: int,
    dtype: torch.dtype,
    device: torch.device,
    *,
    validate: bool,
    convert: bool = True,
) -> Tensor:
    """Matrices (batch, joints, 3, 3) from axis-angle or matrices, or a clear refusal.

    Without `convert`, axis-angle comes out as it is: (batch, joints, 3).
    """
    rotations = widened(rotations, dtype)
    check_kind("rotations", rotations, dtype, device)
    shape = tuple(rotations.shape)
    axis_angle = rotations.ndim == 3 and shape[1:] == (joint_count, 3)
    if not axis_angle and not (rotations.ndim == 4 and shape[1:] == (joint_count, 3, 3)):
        raise InputError(
            "rotations",
            got=shape,
            expected=f"(batch, {joint_count}, 3) axis-angle or (batch, {joint_count}, 3, 3) matrices",
            fix=_shape_hint(shape, joint_count),
        )
    look = validate and not axis_angle and may_look(rotations)
    if look and _surely_rotations(rotations.detach().numpy()):
        return rotations
    _check_finite("rotations", rotations)
    if axis_angle:
        return axis_angle_to_matrix(rotations) if convert else rotations
    if look:
        _check_orthonormal(rotations.detach())
    return rotations


def _shape_hint(shape: tuple[int, ...], joint_count: int) -> str:
    if shape in ((joint_count, 3), (joint_count, 3, 3)):
        return "Add the batch axis: rotations[None]."
    if len(shape) > 1 and shape[1] == joint_count + 1:
        return "Leave out the virtual Root: rotations[:, 1:]."
    return "Order the joints as in layer.joint_names."


def _surely_rotations(matrices: np.ndarray) -> bool:
    """Whether all are finite and rotations well within the tolerance; a close look takes five times as long.

    The first two rows are unit vectors at right angles, and the third is their cross product.
    """
    rows = np.ascontiguousarray(matrices.reshape(-1, 9).T).reshape(3, 3, -1)
    x, y, z = rows
    part, other = np.empty_like(x[0]), np.empty_like(x[0])
    least = 0.1 * _ROTATION_TOLERANCE

    def near(value: float) -> bool:
        ends = part.min(initial=value), part.max(initial=value)
        return bool(value - least < ends[0] and ends[1] < value + least)

    with np.errstate(all="ignore"):
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            np.multiply(x[i], y[j], out=part)
            part -= np.multiply(x[j], y[i], out=other)
            part -= z[k]
            if not near(0.0):
                return False
        for first, second, value in ((x, x, 1.0), (y, y, 1.0), (x, y, 0.0)):
            np.multiply(first[0], second[0], out=part)
            part += np.multiply(first[1], second[1], out=other)
            part += np.multiply(first[2], second[2], out=other)
            if not near(value):
                return False
    return True


def _check_orthonormal(rotations: Tensor) -> None:
    if not rotations.numel():
        return
    error = orthonormality_error(rotations)
    worst = int(error.argmax())
    if float(error.flatten()[worst]) > _ROTATION_TOLERANCE:
        frame, joint = divmod(worst, rotations.shape[1])
        raise InputError(
            f"rotations[{frame}, {joint}]",
            got=f"a matrix {float(error.flatten()[worst]):.3g} away from a rotation",
            expected=f"R^T R = I and det R = 1 within {_ROTATION_TOLERANCE:g}",
            fix="Orthonormalise it, drop the scale, or pass axis-angle.",
        )


def check_translation(
    translation: Tensor | None, batch: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Hips positions (batch, 3) [m]; zeros when None."""
    if translation is None:
        return torch.zeros(batch, 3, dtype=dtype, device=device)
    translation = widened(translation, dtype)
    check_kind("translation", translation, dtype, device)
    if tuple(translation.shape) not in ((3,), (1, 3), (batch, 3)):
        raise InputError(
            "translation",
            got=tuple(translation.shape),
            expected=f"({batch}, 3), (1, 3) or (3,)",
            fix="Give one Hips position [m] a pose.",
        )
    _check_finite("translation", translation)
    return translation.expand(batch, 3)


def check_bone_scale(
    bone_scale: Tensor | None, batch: int, joint_count: int, dtype: torch.dtype, device: torch.device
) -> Tensor | None:
    """Factors (1 or batch, joints) of the bone vectors, positive; None where none are given."""
    if bone_scale is None:
        return None
    bone_scale = widened(bone_scale, dtype)
    check_kind("bone_scale", bone_scale, dtype, device)
    if tuple(bone_scale.shape) not in ((1, joint_count), (batch, joint_count)):
        raise InputError(
            "bone_scale",
            got=tuple(bone_scale.shape),
            expected=f"({batch}, {joint_count}) or (1, {joint_count})",
            fix="Give one factor a user joint, for all poses or for each; 1 leaves a bone as it is.",
        )
    _check_finite("bone_scale", bone_scale)
    if may_look(bone_scale) and not bool((bone_scale.detach() > 0).all()):
        where = tuple(int(i) for i in torch.nonzero(bone_scale.detach() <= 0)[0])
        raise InputError(
            f"bone_scale[{where[0]}, {where[1]}]",
            got=float(bone_scale.detach()[where]),
            expected="a number above zero",
            fix="Use 1 for a bone that keeps its length.",
        )
    return bone_scale


def check_rest(rest: Tensor, vertex_count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Vertices (batch, v, 3) of the canonical mesh, or a clear refusal."""
    rest = widened(rest, dtype)
    check_kind("rest", rest, dtype, device)
    if rest.ndim != 3 or tuple(rest.shape[1:]) != (vertex_count, 3):
        raise InputError(
            "rest",
            got=tuple(rest.shape),
            expected=f"(batch, {vertex_count}, 3), the canonical mesh at the layer's LOD",
            fix="Bring other topologies to it first: transfer or register them.",
        )
    _check_finite("rest", rest)
    return rest


def common_batch(identities: int, poses: int) -> int:
    """Bodies that come out of so many identities and poses, or a clear refusal."""
    if identities == poses or poses == 1:
        return identities
    if identities == 1:
        return poses
    raise InputError(
        "rotations",
        got=f"a batch of {poses} for {identities} identities",
        expected=f"a batch of {identities} or 1",
        fix="Give one pose an identity, one pose for all, or one identity for all poses.",
    )
