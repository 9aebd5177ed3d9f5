"""An unknown identity from posed meshes alone: one rest shape for all frames, and their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from soma_core.errors import InputError, check_type
from soma_core.inversion._inputs import check_weights
from soma_core.inversion.fit import PoseInversion, Topology
from soma_core.inversion.free_parameters import FreeParameters
from soma_core.inversion.result import IdentityFit
from soma_core.inversion.shape_search import Rival, Sample, ShapeFound, evenly, search_parameters
from soma_core.inversion.unposing import Unposing
from soma_core.layer import SomaLayer
from soma_core.native.fit import NativeFit
from soma_core.rig import load_canonical
from soma_core.skeleton.identity import Identity

__all__ = ["IdentityMethod", "fit_identity"]

IdentityMethod = Literal["backend", "unpose"]

_RESTING = 0.01
"""Unposing ends before a round that lowers the error by less, relatively."""


@torch.no_grad()
def fit_identity(
    layer: SomaLayer,
    vertices: Tensor,
    *,
    topology: Topology = "canonical",
    method: IdentityMethod = "backend",
    weights: Tensor | None = None,
    start: Mapping[str, Any] | None = None,
    free: Sequence[str] | None = None,
    frames: int = 20,
    iterations: int = 12,
    inversion: PoseInversion | None = None,
) -> IdentityFit:
    """Recover rest shape and poses together, one identity for all frames.

    ``backend`` moves the backend's parameters: Gauss-Newton steps on the error that is left once every frame
    has taken its best pose, from several starts where parameters are bounded. Frames without gaps that the
    backend's own skin explains better, where it tells that, decide the parameters under it. Else joint
    centres may move meanwhile, since another model turns its body about others, and what no body explains
    comes to count less.
    ``unpose`` goes on from there and lets every vertex of the rest shape move, for people that the backend
    cannot describe; it takes the other model's way of bending skin for shape, though.

    Args:
        layer: the backend and the LOD of the fit.
        vertices, topology, weights: as in :class:`PoseInversion`.
        method: ``backend`` or ``unpose``.
        start: parameters to begin from; what is left out has its default.
        free: names of the parameters to fit; default as in :class:`FreeParameters`. With ``unpose`` it may
            be empty: unposing then begins from `start` itself.
        frames: how many frames, spread over the sequence, to estimate the identity from.
        iterations: largest number of steps of a descent, and of rounds of unposing.
        inversion: the pose fit, to share it between calls; None makes one.

    Raises:
        InputError: an unknown method or parameter, a count below one, no usable frame.
    """
    _check(vertices, method, frames, iterations)
    inversion = inversion or PoseInversion(layer)
    canonical = inversion.canonical(vertices.detach(), topology)
    weights = check_weights(weights, inversion.default_weights, len(canonical))
    begin = layer.identity(start)
    chosen = _usable_frames(inversion, canonical, weights, begin, frames)
    weight = weights[chosen] if len(weights) > 1 else weights
    sample = Sample(vertices=canonical[chosen], weights=weight).without_gaps()
    found = ShapeFound(identity=begin, history=(), converged=True)
    if method == "backend" or free is None or free:
        parameters = FreeParameters(layer, start, free)
        search = inversion.skinned("full")  # one model all the way, so that errors compare
        whole = bool((weights == inversion.default_weights).all())
        own = _own_skin(layer, vertices.detach()[chosen], topology, parameters) if whole else None
        found = search_parameters(search, sample, parameters, iterations=iterations, rival=own)
    params = found.identity.params
    if method == "unpose":
        found = _unpose(inversion, sample, found, iterations)
    pose = inversion(canonical, found.identity, weights=weights)
    return IdentityFit(
        identity=found.identity, params=params, pose=pose, frames=chosen, history=found.history,
        converged=found.converged,
    )  # fmt: skip


def _check(vertices: object, method: str, frames: int, iterations: int) -> None:
    check_type("vertices", vertices, Tensor, fix="Wrap it: torch.as_tensor(vertices).")
    if method not in get_args(IdentityMethod):
        among = "'backend' or 'unpose'"
        raise InputError("method", got=repr(method), expected=among, fix="Correct the name.")
    for name, value in (("frames", frames), ("iterations", iterations)):
        if value < 1:
            raise InputError(name, got=value, expected="at least 1", fix=f"Leave {name} out for the default.")


def _usable_frames(
    inversion: PoseInversion, vertices: Tensor, weights: Tensor, identity: Identity, count: int
) -> Tensor:
    """Numbers of up to `count` frames, evenly spread, that a pose can be fitted to."""
    total = len(vertices)
    spread = evenly(total, count).to(vertices.device)
    weight = weights[spread] if len(weights) > 1 else weights
    valid = inversion(vertices[spread], identity, weights=weight).valid
    if not bool(valid.any()):
        raise InputError(
            "vertices",
            got=f"{len(spread)} frames of which none can be used",
            expected="frames of a body, with a value for every vertex of weight above zero",
            fix="Give weight zero to missing vertices, and leave out frames without a body.",
        )
    return spread[valid]


def _own_skin(
    layer: SomaLayer, vertices: Tensor, topology: Topology, parameters: FreeParameters
) -> Rival | None:
    """The search under the backend's own skin; None where it does not tell that, or of another mesh."""
    lod = layer.mesh.lod
    known = lod != "xlo" and layer.mesh.root == load_canonical(lod)[0].root
    if not (layer.tells_skinning and known and bool(vertices.isfinite().all())):
        return None
    fit = NativeFit(
        layer.backend, options=layer.options, lod=lod, device=layer.device, dtype=layer.dtype,
        kernels=layer.kernels, registry=layer.registry,
    )  # fmt: skip

    def search(count: int, begin: np.ndarray, iterations: int) -> tuple[np.ndarray, float]:
        some = vertices[evenly(len(vertices), count)]
        return fit.search(some, parameters, begin, topology=topology, iterations=iterations)

    return search


def _unpose(inversion: PoseInversion, sample: Sample, found: ShapeFound, rounds: int) -> ShapeFound:
    """Let the rest shape follow the frames, and the poses the rest shape, by turns."""
    identity, history = found.identity, list(found.history)
    unposing = Unposing(inversion.layer, identity)
    pose = inversion(sample.vertices, identity, weights=sample.weights)
    history.append(sample.error(pose))
    for _ in range(rounds):
        rest = unposing(sample.vertices, sample.weights, identity, pose)
        trial = inversion.layer.identity_from_rest(rest)
        pose = inversion(sample.vertices, trial, weights=sample.weights)
        error = sample.error(pose)
        if error > (1 - _RESTING) * history[-1]:
            return ShapeFound(identity=identity, history=tuple(history), converged=True)
        identity = trial
        history.append(error)
    return ShapeFound(identity=identity, history=tuple(history), converged=False)
