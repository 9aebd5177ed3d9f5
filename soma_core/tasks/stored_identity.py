"""The identity that a motion file keeps: a backend and its parameters, or a rest shape that none describe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from soma_core.errors import InputError
from soma_core.io.motion import Motion
from soma_core.layer import SomaLayer
from soma_core.rig import load_canonical
from soma_core.skeleton.identity import Identity

__all__ = ["backend_of", "stored_identity"]


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
    rest = stored.get("rest")
    if rest is None:
        return layer.identity(stored.get("params"))
    points = np.asarray(rest)
    fitted = load_canonical("low")[0] if layer.mesh.lod == "xlo" else layer.mesh
    if fitted.lod != "mid" and len(points) == load_canonical("mid")[0].vertex_count:
        points = points[fitted.mid_ids]
    return layer.identity_from_rest(torch.as_tensor(points[None]).to(layer.device, layer.dtype))
