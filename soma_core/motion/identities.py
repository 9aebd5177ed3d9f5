"""Identities that motion files keep, made again; and those of a fit that are found from its frames, once."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from soma_core._derived import kind_of
from soma_core.cache import atomic_write
from soma_core.errors import InputError, check_type
from soma_core.inversion.result import IdentityFit
from soma_core.io.motion import Motion
from soma_core.layer import SomaLayer
from soma_core.motion.models import under
from soma_core.motion.posed_input import PosedInput
from soma_core.native.identity import fit_identity
from soma_core.options import IdentityChoice
from soma_core.rig import load_canonical
from soma_core.skeleton.identity import Identity

__all__ = ["backend_of", "found_identity", "kept_identity", "stored_identity"]

_log = logging.getLogger(__name__)


def backend_of(motion: Motion) -> str:
    """Name of the backend of the identity that a motion was recorded with.

    Raises:
        InputError: the motion keeps none that can be made again.
    """
    stored = motion.identity
    if "params" not in stored and "rest" not in stored:
        raise InputError(
            "identity_from",
            got=f"a motion with {', '.join(stored) or 'nothing'} of its identity",
            expected="a motion file with identity_params or identity_rest",
            fix="Pass backend=NAME and backend.params.KEY=VALUE instead.",
        )
    return str(stored["backend"])


def stored_identity(layer: SomaLayer, stored: Mapping[str, Any]) -> Identity:
    """Make the identity again: from its rest shape where there is one, else from its parameters.

    Args:
        layer: the backend, and the LOD that is wanted; a rest shape of mid serves every LOD,
            one of low also xlo.
        stored: ``params``, or ``rest`` (v, 3) [m] as :meth:`SomaLayer.identity_from_rest` takes it.

    Raises:
        InputError: parameters or a rest shape that the layer does not take.
    """
    kind_of(layer)
    check_type("stored", stored, Mapping, fix="Give what a motion keeps: motion.identity.")
    rest = stored.get("rest")
    if rest is None:
        return layer.identity(stored.get("params"))
    points = np.asarray(rest)
    fitted = load_canonical("low")[0] if layer.mesh.lod == "xlo" else layer.mesh
    if fitted.lod != "mid" and len(points) == load_canonical("mid")[0].vertex_count:
        points = points[fitted.mid_ids]
    return layer.identity_from_rest(torch.as_tensor(points[None]).to(layer.device, layer.dtype))


def kept_identity(layer: SomaLayer, identity: Identity) -> dict[str, Any]:
    """What a motion file keeps of an identity of this layer, for :func:`stored_identity` to make it again.

    Nothing where that cannot be: of a rest shape, a layer of xlo holds less than it was made from.
    """
    named = {"backend": layer.backend, **({"options": dict(layer.options)} if layer.options else {})}
    if identity.params:
        return named | {"params": {name: value[0].tolist() for name, value in identity.params.items()}}
    rest = identity.fitted_rest[0].detach().cpu().numpy()
    return {} if layer.mesh.lod == "xlo" else named | {"params": {}, "rest": rest}


@torch.no_grad()
def found_identity(
    file: Path, layer: SomaLayer, posed: PosedInput, params: Mapping[str, Any], choice: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Find one identity for all frames, or read what an earlier run found.

    Args:
        file: NPZ that keeps what was found.
        layer, posed: the backend and the frames.
        params: where the search begins.
        choice: ``method``, ``free``, ``frames`` and ``iterations`` of :func:`fit_identity`.

    Returns:
        What a motion file keeps of the identity: backend, parameters, and the rest shape (v, 3) [m] of an
        unposed one. And how it was found, for the report.

    Raises:
        InputError: as :func:`fit_identity`.
    """
    if not file.is_file():
        found = _search(layer, posed, params, choice)
        atomic_write(file, lambda path: _write(path, found, choice))
    with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as fields:
        kept = {name: fields[name] for name in fields.files}
    search, values = (json.loads(str(kept.pop(name))) for name in ("search", "params"))
    return {"backend": layer.backend, "params": values, **kept}, search


def _search(
    layer: SomaLayer, posed: PosedInput, params: Mapping[str, Any], choice: Mapping[str, Any]
) -> IdentityFit:
    """Fit to frames spread over the sequence, read one by one; gaps are avoided where there is a choice."""
    numbers, vertices = posed.spread(max(choice["frames"], 1))
    _log.info("finding the identity from %d frames", len(numbers))
    with under(IdentityChoice, "identity"):
        found = fit_identity(
            layer,
            torch.as_tensor(vertices).to(layer.device, layer.dtype),
            topology=posed.topology,
            start=params,
            **choice,
        )
    short = {name: value.item() for name, value in found.params.items() if value.numel() == 1}
    if short:
        _log.info("found %s", ", ".join(f"{name}={value:.3g}" for name, value in short.items()))
    return found


def _write(path: Path, found: IdentityFit, choice: Mapping[str, Any]) -> None:
    params = {name: value[0].double().cpu().tolist() for name, value in found.params.items()}
    search = {
        **choice, "frames": len(found.frames), "steps": len(found.history) - 1, "converged": found.converged
    }  # fmt: skip
    arrays = {"params": np.array(json.dumps(params)), "search": np.array(json.dumps(search))}
    if choice["method"] == "unpose":
        arrays["rest"] = found.identity.fitted_rest[0].cpu().numpy()
    with open(path, "wb") as stream:
        np.savez_compressed(stream, **arrays)
