"""Random identities: parameters drawn from a backend's declaration, and the rest shapes they give."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Protocol

import numpy as np

from soma_core.errors import InputError
from soma_core.plugin.spec import BackendSpec, Parameter

__all__ = [
    "HELD_OUT", "TRAINING", "IdentityLayer", "IdentityStream", "ShapeStream", "sample_parameters", "standing",
]  # fmt: skip

TRAINING, HELD_OUT = 0, 1
"""Streams of identities that never share a random number."""

_CHUNK = 64
_CM_PER_M = 100.0


class IdentityLayer(Protocol):
    """The part of ``SomaLayer`` that sampling needs."""

    spec: BackendSpec

    def identity(self, params: Mapping[str, Any] | None = None) -> Any:
        """Prepare identities; ``.rest`` holds their vertices [m], (batch, v, 3)."""
        ...


def sample_parameters(
    spec: BackendSpec,
    count: int,
    random: np.random.Generator,
    *,
    spread: float = 0.15,
    skip_groups: Collection[str] = (),
) -> dict[str, np.ndarray]:
    """Draw parameters (count, *shape) for a backend from what it declares.

    A parameter that is zero by default is a deviation: it is normally distributed about zero, its
    standard deviation being `spread` times half its range, and clipped to the range. Any other
    parameter is uniform over its range.
    """

    def draw(parameter: Parameter) -> np.ndarray:
        low, high = parameter.range
        size = (count, *parameter.shape)
        if parameter.default != 0:
            return random.uniform(low, high, size)
        deviation = spread * (high - low) / 2
        return np.clip(random.normal(0.0, deviation, size), low, high)

    return {item.name: draw(item) for item in spec.params if item.group not in skip_groups}


class ShapeStream(Protocol):
    """Where shapes come from: batch `b` does not depend on which were asked for before."""

    def shapes(self, stream: int, batch: int, count: int) -> np.ndarray:
        """Rest shapes [cm], (count, v, 3) float64: bind pose, lowest vertex at height zero."""
        ...


class IdentityStream:
    """An endless, reproducible supply of rest shapes from a mixture of backends.

    Batch `b` depends on the seed and on `b` alone, so that training can stop and go on anywhere.

    Args:
        layers: one for each backend, all on the same canonical mesh.
        mix: share of each backend; the shares are divided by their sum.
        seed: of all random numbers.
        spread, skip_groups: see :func:`sample_parameters`.

    Raises:
        InputError: no backends, shares that are not positive, or layers that do not match the shares.
    """

    def __init__(
        self,
        layers: Mapping[str, IdentityLayer],
        mix: Mapping[str, float],
        *,
        seed: int,
        spread: float = 0.15,
        skip_groups: Collection[str] = (),
    ) -> None:
        if not mix or not all(np.isfinite(share) and share > 0 for share in mix.values()):
            raise InputError(
                "mix",
                got=dict(mix),
                expected="at least one backend, each with a share above 0",
                fix="For example mix.anny=1.0; drop a backend with ~mix.NAME.",
            )
        if set(layers) != set(mix):
            raise InputError("layers", got=sorted(layers), expected=sorted(mix), fix="Build one a backend.")
        self._layers = dict(layers)
        self._shares = np.array([mix[name] for name in layers]) / sum(mix.values())
        self._seed, self._spread, self._skip_groups = seed, spread, tuple(skip_groups)

    def shapes(self, stream: int, batch: int, count: int) -> np.ndarray:
        """Rest shapes [cm], (count, v, 3) float64: bind pose, lowest vertex at height zero.

        Args:
            stream: `TRAINING` or `HELD_OUT`.
            batch: number of the batch in its stream.
            count: identities; each comes from one backend, chosen by the shares.

        Raises:
            InputError: a parameter is drawn that the options of its backend leave out.
        """
        random = np.random.default_rng([self._seed, stream, batch])
        counts = random.multinomial(count, self._shares)
        parts = [
            self._one_backend(name, number, random)
            for name, number in zip(self._layers, counts, strict=True)
            if number
        ]
        return standing(np.concatenate(parts))

    def _one_backend(self, name: str, count: int, random: np.random.Generator) -> np.ndarray:
        layer = self._layers[name]
        params = sample_parameters(
            layer.spec, count, random, spread=self._spread, skip_groups=self._skip_groups
        )
        parts = []
        for start in range(0, count, _CHUNK):
            chunk = {key: value[start : start + _CHUNK] for key, value in params.items()}
            try:
                rest = layer.identity(chunk).rest.detach().cpu().numpy()
            except InputError as error:
                raise _refused(error, name, layer.spec) from error
            parts.append(rest)
        return np.concatenate(parts)


def standing(rest: np.ndarray) -> np.ndarray:
    """Rest shapes (count, v, 3) [m] in centimetres and float64, their lowest vertex at height zero.

    Where a model has its origin says nothing about shape.
    """
    shapes = _CM_PER_M * rest.astype(np.float64)
    shapes[..., 1] -= shapes[..., 1].min(axis=1, keepdims=True)
    return shapes


def _refused(error: InputError, backend: str, spec: BackendSpec) -> InputError:
    """Say how to mend a parameter that was drawn but that the backend's options leave out."""
    group = next((item.group for item in spec.params if error.argument == f"params[{item.name!r}]"), "")
    fix = f"Enable it in options.{backend}"
    if group:
        fix += f", or leave its group at the defaults with 'skip_groups=[{group}]'"
    return InputError(error.argument, got=error.got, expected=error.expected, fix=f"{fix}.")
