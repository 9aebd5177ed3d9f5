"""Write ``SOMA_neutral.npz``; round a shape space so that it deflates well, and say what that costs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.cache import atomic_arrays
from soma_core.errors import InputError
from soma_core.rig.neutral import TOPOLOGY_KEYS, ShapeSpace

__all__ = ["compress_shape_space", "write_neutral"]


def compress_shape_space(space: ShapeSpace, *, rms_error: float = 0.002) -> ShapeSpace:
    """Round each direction to a step, so that its low mantissa bits are zero and deflate drops them.

    At coefficients of one standard deviation, rounding component k to steps s_k moves a vertex by
    ``sqrt(3 eigenvalue_k / 12) s_k`` (root mean square). The budget is shared equally by the
    components; steps are powers of two, so rounded values are exact in float32.

    Args:
        space: the trained space [cm].
        rms_error: wanted root mean square vertex displacement over all components [cm].

    Returns:
        The rounded space; ``metadata["rounding"]`` holds the measured errors [mm]. A space whose
        metadata says that it was rounded before comes back as it is: the errors would add up unseen.
    """
    if not space.component_count or any(key.startswith("rounding") for key in space.metadata):
        return space
    share = rms_error / math.sqrt(space.component_count)
    sigma = np.sqrt(np.maximum(space.eigenvalues.astype(np.float64), np.finfo(np.float32).tiny))
    # A component too weak to matter keeps a step below its largest entry.
    largest = np.abs(space.shapedirs).max(axis=1, initial=np.finfo(np.float32).tiny)
    step = np.exp2(np.floor(np.log2(np.minimum(2 * share / sigma, largest))))[:, None]
    rounded = (np.round(space.shapedirs / step) * step).astype(np.float32)
    rounded += np.float32(0)  # -0.0 and 0.0 would be two symbols
    moved = (sigma[:, None] * (rounded.astype(np.float64) - space.shapedirs)).reshape(len(sigma), -1, 3)
    squared = np.square(moved).sum(axis=(0, 2))
    rounding = {
        "rule": "directions rounded to a power-of-two step each; values exact in float32",
        "rms_vertex_error_mm": round(10 * math.sqrt(squared.mean()), 5),
        "worst_vertex_rms_error_mm": round(10 * math.sqrt(squared.max()), 5),
        "at": "coefficients drawn from a standard normal, all components",
    }
    return ShapeSpace(
        mean=space.mean,
        shapedirs=rounded,
        eigenvalues=space.eigenvalues,
        metadata={**space.metadata, "rounding": rounding},
    )


def write_neutral(
    path: Path, topology: Mapping[str, np.ndarray], shape_space: ShapeSpace, metadata: Mapping[str, Any]
) -> None:
    """Write ``SOMA_neutral.npz``: deflated, no timestamps, keys sorted, atomic.

    Args:
        path: the file.
        topology: the arrays of `TOPOLOGY_KEYS`.
        shape_space: mean, directions and eigenvalues [cm].
        metadata: stored as JSON; the shape space's own goes under ``provenance.shape_space``.

    Raises:
        InputError: `topology` lacks a key.
    """
    missing = [name for name in TOPOLOGY_KEYS if name not in topology]
    if missing:
        raise InputError(
            "topology", got=f"no {missing}", expected="every key of TOPOLOGY_KEYS", fix="Add the arrays."
        )
    provenance = {**metadata.get("provenance", {}), "shape_space": dict(shape_space.metadata)}
    text = json.dumps({**metadata, "provenance": provenance}, sort_keys=True)
    arrays = {name: np.asarray(topology[name]) for name in TOPOLOGY_KEYS}
    arrays |= {
        key: np.asarray(getattr(shape_space, key), np.float32) for key in ("mean", "shapedirs", "eigenvalues")
    }
    arrays["metadata"] = np.array(text)
    ordered = {name: arrays[name] for name in sorted(arrays)}
    atomic_arrays(path, ordered)
