"""Checks of what pose inversion is given, at the public boundary."""

from __future__ import annotations

import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.geometry.torch_func import transformed
from soma_core.inversion.result import InversionResult
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = [
    "check_count", "check_vertices", "check_weights", "refuse_gradient", "refuse_transforms",
    "refuse_unit_error", "without_gaps",
]  # fmt: skip

_UNIT_FACTORS = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001)


def check_vertices(vertices: object, count: int, *, fix: str) -> Tensor:
    """Return a floating tensor (F, count, 3), or refuse with `fix`."""
    if not isinstance(vertices, Tensor) or not vertices.is_floating_point():
        raise InputError(
            "vertices",
            got=vertices.dtype if isinstance(vertices, Tensor) else type(vertices).__name__,
            expected="a floating torch.Tensor",
            fix="Wrap it: torch.as_tensor(vertices).",
        )
    if vertices.ndim != 3 or vertices.shape[2] != 3 or (count >= 0 and vertices.shape[1] != count):
        wanted = "n" if count < 0 else count
        raise InputError("vertices", got=tuple(vertices.shape), expected=f"(frames, {wanted}, 3)", fix=fix)
    return vertices


def check_count(vertices: Tensor, identity: Identity, initial: InversionResult | None) -> int:
    """Number of frames; refuse identities or an earlier result of other frames."""
    count = len(vertices)
    if identity.batch_size not in (1, count):
        raise InputError(
            "identity",
            got=f"a batch of {identity.batch_size} for {count} frames",
            expected=f"a batch of 1 or {count}",
            fix="Give one identity for the sequence, or one a frame.",
        )
    if initial is not None and len(initial.rotations) != count:
        raise InputError(
            "initial",
            got=f"{len(initial.rotations)} frames",
            expected=f"{count} frames",
            fix="Give the earlier result of the same frames.",
        )
    return count


def check_weights(weights: Tensor | None, default: Tensor, frames: int) -> Tensor:
    """Vertex weights (1 or frames, v), finite, not negative; `default` (v,) where none are given."""
    if weights is None:
        return default[None]
    count = len(default)
    weights = torch.as_tensor(weights, dtype=default.dtype, device=default.device)
    if tuple(weights.shape) not in ((count,), (1, count), (frames, count)):
        raise InputError(
            "weights",
            got=tuple(weights.shape),
            expected=f"({count},) or ({frames}, {count})",
            fix="Give one weight a canonical vertex, for all frames or for each.",
        )
    usable = (weights >= 0) & (weights < torch.inf)
    if not bool(usable.all()):
        raise InputError(
            "weights",
            got=float(weights[~usable][0]),
            expected="finite numbers of at least zero",
            fix="Use 0 for vertices to leave out.",
        )
    return weights if weights.ndim == 2 else weights[None]


def refuse_transforms() -> None:
    """Refuse to fit under ``torch.func`` or forward-mode differentiation."""
    if transformed():
        raise InputError(
            "vertices",
            got="tensors under a transform of torch.func, or of forward-mode differentiation",
            expected="plain tensors: a fit is a loop with a reverse-mode derivative",
            fix="Fit all frames as one batch, and use torch.autograd.grad or backward().",
        )


def refuse_gradient() -> None:
    """Refuse a gradient through a fit that has none."""
    raise InputError(
        "vertices",
        got="a tensor that requires a gradient",
        expected="none with robust or temporal terms, whose fit has no derivative here",
        fix="Pass vertices.detach(), or leave out robust and temporal_strength.",
    )


def refuse_unit_error(scale: Tensor, name: str = "vertices") -> None:
    """Refuse a sequence whose frames are all the same power of ten too large or too small."""
    typical = float(scale.median())
    for factor in _UNIT_FACTORS:
        if 0.5 < typical / factor < 2:
            canonical = name == "vertices"
            raise InputError(
                name,
                got=f"bodies {typical:.4g} times the size of their identity",
                expected="metres on the canonical topology, or the backend's own unit"
                if canonical
                else "metres",
                fix=f"Multiply the {name} by {1 / factor:g}.",
            )


def without_gaps(vertices: Tensor, weights: Tensor, layer: SomaLayer) -> tuple[Tensor, Tensor]:
    """Vertices with a value everywhere, and (F,) whether all that count had one.

    Vertices of zero weight may be NaN or infinite; a frame with others is filled with the rig's bind shape.
    """
    finite = torch.isfinite(vertices.sum((1, 2)))
    if bool(finite.all()):
        return vertices, finite
    known = torch.isfinite(vertices).all(-1)
    whole = (known | (weights == 0)).all(1)
    bind = torch.tensor(layer.rig.bind_shape, dtype=vertices.dtype, device=vertices.device)
    return torch.where((known & whole[:, None])[..., None], vertices, bind), whole
