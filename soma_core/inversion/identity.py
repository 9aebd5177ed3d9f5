"""An unknown identity from posed meshes alone: one rest shape for all frames, and their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.inversion._inputs import check_weights
from soma_core.inversion.fit import PoseInversion, Topology
from soma_core.inversion.free_parameters import FreeParameters
from soma_core.inversion.result import InversionResult
from soma_core.inversion.shape_search import Sample, ShapeFound, search_parameters
from soma_core.inversion.unposing import Unposing
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["IdentityFit", "IdentityMethod", "fit_identity"]

IdentityMethod = Literal["backend", "unpose"]

_RESTING = 0.01
"""Unposing ends before a round that lowers the error by less, relatively."""


@dataclass(frozen=True, kw_only=True, eq=False)
class IdentityFit:
    """One identity for a sequence, and its poses.

    Attributes:
        identity: the rest shape and its skeleton, batch of 1.
        params: the backend's parameters of that shape; when unposed, of the shape it began from.
        pose: of every frame under the identity.
        frames: (n,) numbers of the frames that the identity was estimated from.
        history: root mean square vertex error [m] over those frames at the start and after each step, while
            joint centres may move. It rises where vertices that are not explained begin to count less.
        converged: whether the last step no longer changed the error noticeably.
    """

    identity: Identity
    params: Mapping[str, Tensor]
    pose: InversionResult
    frames: Tensor
    history: tuple[float, ...]
    converged: bool


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
    has taken its best pose, from several starts where parameters are bounded. Another model turns its body
    about other joints: joint centres may move meanwhile, and what no body explains comes to count less.
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
    _check(method, frames, iterations)
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
        found = search_parameters(search, sample, parameters, iterations=iterations)
    params = found.identity.params
    if method == "unpose":
        found = _unpose(inversion, sample, found, iterations)
    return IdentityFit(
        identity=found.identity,
        params=params,
        pose=inversion(canonical, found.identity, weights=weights),
        frames=chosen,
        history=found.history,
        converged=found.converged,
    )


def _check(method: str, frames: int, iterations: int) -> None:
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
    spread = torch.linspace(0, total - 1, min(count, total), device=vertices.device).round().long()
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
