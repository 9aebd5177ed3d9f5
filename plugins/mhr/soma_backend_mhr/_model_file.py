"""Checking and loading a TorchScript file of MHR. Such a file runs code, so its hash comes first."""

from __future__ import annotations

import hashlib
import io
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from soma_backend_mhr._files import EXPRESSIONS, IDENTITY, JOINTS, LOD1, LOD6, PARAMETERS, VERTEX_COUNTS, Lod
from soma_core import AssetError
from soma_core.plugin import refuse_unreadable

__all__ = ["Model", "load_model"]

_log = logging.getLogger(__name__)

_MOST_BYTES = 2**30
_INPUTS = ("identity_coeffs", "model_parameters", "face_expr_coeffs")
_STATURES_CM = (140, 210)
"""Of the neutral body, which is 173 cm tall."""

_FEET, _LEGS = (-1.0, 0.06), (0.1, 0.3)
"""Heights over the ground, in parts of the stature: the feet, and what stands over their heels."""

_PROBES = 2
"""Bodies that are evaluated to check a file: one would not show that it takes a batch."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A loaded file.

    Attributes:
        path: the file.
        faces: (t, 3) int64, counter-clockwise seen from outside.
        evaluate: identity (batch, 45), model parameters (batch, 204) and expression (batch, 72) to vertices
            (batch, v, 3) [cm], +Y up, facing +Z.
    """

    path: Path
    faces: Tensor
    evaluate: Callable[[Tensor, Tensor, Tensor], Tensor]


def load_model(path: Path, lod: Lod, *, device: torch.device, dtype: torch.dtype, trust: bool) -> Model:
    """Load a file whose hash is that of the published one, or any that the user trusts.

    A model that cannot compute in float64 computes in float32; its results are then converted.

    Raises:
        AssetError: missing, not the published file and not trusted, no TorchScript, another model or LOD,
            another unit or other axes.
    """
    refuse_unreadable(path, fix=_where(lod), most_bytes=_MOST_BYTES)
    content = path.read_bytes()  # what is opened is what was hashed, whatever becomes of the file meanwhile
    _check_hash(path, content, lod, trust=trust)
    try:
        model = _loaded(path, content, lod, device, dtype)
    except RuntimeError as error:
        if dtype == torch.float32:
            raise _failed(path, lod, error) from error
        _log.info("%s does not compute in %s (%s); it computes in float32", path.name, dtype, _first(error))
        try:
            model = _loaded(path, content, lod, device, torch.float32)
        except RuntimeError as again:
            raise _failed(path, lod, again) from again
    return model


def _check_hash(path: Path, content: bytes, lod: Lod, *, trust: bool) -> None:
    found = hashlib.sha256(content).hexdigest()
    if found in lod.hashes:
        return
    other = next((each for each in (LOD1, LOD6) if found in each.hashes), None)
    if other is not None:
        cause = f"is the model of LOD {other.number}"
        raise AssetError(path, cause=cause, fix=f"Name it {other.models[0]} and use backend={other.name}.")
    if not trust:
        raise AssetError(
            path,
            cause=f"is not the published file: its SHA-256 is {found}, expected {' or '.join(lod.hashes)}. "
            "TorchScript runs code, so it was not opened",
            fix=f"{_where(lod)} If you know who made this one, pass backend.options.trust=true.",
        )
    _log.warning("%s is not the published file; opened because trust=true was given", path)


def _loaded(path: Path, content: bytes, lod: Lod, device: torch.device, dtype: torch.dtype) -> Model:
    with (
        warnings.catch_warnings()
    ):  # torch from 2.10 on advises another format; this one is what is published
        warnings.filterwarnings("ignore", "`torch.jit.load` is", DeprecationWarning)
        module = torch.jit.load(io.BytesIO(content), map_location=device).eval().to(dtype)
    for parameter in module.parameters():
        parameter.requires_grad_(requires_grad=False)
    _check_signature(path, lod, module)

    def evaluate(identity: Tensor, parameters: Tensor, expression: Tensor) -> Tensor:
        inputs = (each.to(dtype) for each in (identity, parameters, expression))
        # Without it TorchScript compiles anew for every batch size, which takes longer than many bodies.
        with torch.jit.optimized_execution(should_optimize=False):
            return module(*inputs)[0].to(identity.dtype)

    zeros = (
        torch.zeros(_PROBES, width, dtype=dtype, device=device)
        for width in (IDENTITY, PARAMETERS, EXPRESSIONS)
    )
    with torch.no_grad(), torch.jit.optimized_execution(should_optimize=False):
        result = module(*zeros)
    _check_result(path, lod, result)
    faces = _faces(path, lod, module)
    _check_body(path, lod, result[0][0].double().cpu())
    return Model(path=path, faces=faces, evaluate=evaluate)


def _check_signature(path: Path, lod: Lod, module: Any) -> None:
    arguments = module.forward.schema.arguments[1:]
    names = tuple(argument.name for argument in arguments[: len(_INPUTS)])
    more = [argument.name for argument in arguments[len(_INPUTS) :] if not argument.has_default_value()]
    if names != _INPUTS or more:
        found = ", ".join(argument.name for argument in arguments) or "nothing"
        raise _refused(path, lod, f"forward takes {found}, expected {', '.join(_INPUTS)}")


def _check_result(path: Path, lod: Lod, result: object) -> None:
    found = result if isinstance(result, tuple) else (result,)
    shapes = [tuple(each.shape) if isinstance(each, Tensor) else type(each).__name__ for each in found]
    expected = [(_PROBES, lod.vertex_count, 3), (_PROBES, JOINTS, 8)]
    if shapes != expected:
        count = shapes[0][1] if isinstance(shapes[0], tuple) and len(shapes[0]) == 3 else None
        told = f"; it is LOD {VERTEX_COUNTS.index(count)}" if count in VERTEX_COUNTS else ""
        shown = ", ".join(map(str, shapes))
        raise _refused(path, lod, f"returns {shown} for a batch of {_PROBES}, expected {expected}{told}")
    for name, values in zip(("vertices", "skeleton states"), found, strict=True):
        if not values.is_floating_point() or not bool(torch.isfinite(values).all()):
            raise _refused(path, lod, f"returns {name} of {values.dtype} that are not finite numbers")


def _faces(path: Path, lod: Lod, module: Any) -> Tensor:
    try:
        faces = module.character_torch.mesh.faces
    except AttributeError as error:
        raise _refused(path, lod, "has no character_torch.mesh.faces") from error
    whole = not (faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool)
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or not whole:
        raise _refused(path, lod, f"its faces have the shape {tuple(faces.shape)} of {faces.dtype}")
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= lod.vertex_count:
        raise _refused(
            path, lod, f"its faces refer to vertex {low if low < 0 else high} of {lod.vertex_count}"
        )
    return faces.long()


def _check_body(path: Path, lod: Lod, body: Tensor) -> None:
    """Refuse another unit and other axes of the neutral body (v, 3)."""
    size = body.amax(0) - body.amin(0)
    low, high = _STATURES_CM
    if not low <= float(size[1]) <= high or float(size[2]) > float(size[1]) / 2:
        extents = " by ".join(f"{value:.4g}" for value in size.tolist())
        cause = f"its neutral body measures {extents}, expected {low} to {high} cm along y and less along z"
        raise _refused(path, lod, cause)
    height = (body[:, 1] - body[:, 1].min()) / size[1]
    feet, legs = (body[(height > low) & (height < high), 2] for low, high in (_FEET, _LEGS))
    if not float(feet.min() + feet.max()) > float(legs.min() + legs.max()):
        raise _refused(path, lod, "its neutral body does not face +z")


def _refused(path: Path, lod: Lod, cause: str) -> AssetError:
    return AssetError(path, cause=f"{cause}; it is no MHR model of LOD {lod.number}", fix=_where(lod))


def _failed(path: Path, lod: Lod, error: RuntimeError) -> AssetError:
    return AssetError(path, cause=f"cannot be loaded and evaluated ({_first(error)})", fix=_where(lod))


def _first(error: RuntimeError) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__


def _where(lod: Lod) -> str:
    return f"Get {lod.models[0]} ({lod.size}) of the SOMA or the MHR release."
