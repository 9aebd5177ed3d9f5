"""Identity parameters of a backend, and joint centres beside them, as one vector for a fit to move in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.geometry.constants import Kind
from soma_core.geometry.laplacian import vertex_areas
from soma_core.layer import SomaLayer
from soma_core.plugin.spec import Parameter
from soma_core.skeleton.identity import Identity

__all__ = ["FreeParameters", "WithJoints", "body_joints"]

_UNITS_OF_RANGE = 6.0
"""A declared range counts as three standard deviations to either side."""

_UNIT = 0.01
"""Joint centres of two models lie about this far apart [m]."""

_LEAST_SHARE = 0.0025
"""A joint takes part when it carries this share of the skin; the fingers, at 0.002 each, do not."""


class FreeParameters:
    """The parameters that a fit may change, about their defaults, in units of a sixth of their range.

    A parameter that is zero by default and ranges as far down as up is a deviation (a coefficient of a
    principal component, say) and has no bounds; any other stays inside its range.

    Args:
        layer: its backend declares the parameters.
        start: where to begin; what is left out has its default.
        names: parameters to move; None for those without a group and of every group that the options of
            the backend enable as a whole.

    Attributes:
        start: (k,) float64.
        lower, upper: (k,) float64 bounds, infinite for deviations.

    Raises:
        InputError: an unknown name, none at all, or a start that is no single identity.
    """

    def __init__(
        self, layer: SomaLayer, start: Mapping[str, Any] | None = None, names: Sequence[str] | None = None
    ) -> None:
        self._layer = layer
        given = layer.identity(start)
        if given.batch_size != 1:
            raise InputError(
                "start", got=f"{given.batch_size} identities", expected="one", fix="Give the first of them."
            )
        self._given = dict(given.params)
        self._free = self._choose(names)
        defaults, units, bounded = [], [], []
        for parameter in self._free:
            size, (low, high) = int(np.prod(parameter.shape)), parameter.range
            defaults.append(np.full(size, parameter.default))
            units.append(np.full(size, (high - low) / _UNITS_OF_RANGE))
            deviation = parameter.default == 0 and low == -high
            low, high = parameter.limits or parameter.range
            bounded.append(np.full((size, 2), (-np.inf, np.inf) if deviation else (low, high)))
        self._default, self._unit = np.concatenate(defaults), np.concatenate(units)
        low, high = np.concatenate(bounded).T
        self.lower = (low - self._default) / self._unit
        self.upper = (high - self._default) / self._unit
        values = [self._value(parameter) for parameter in self._free]
        start_vector = (np.concatenate(values) - self._default) / self._unit
        self.start = np.clip(start_vector, self.lower, self.upper)

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that may change."""
        return tuple(parameter.name for parameter in self._free)

    def _choose(self, names: Sequence[str] | None) -> list[Parameter]:
        declared = {parameter.name: parameter for parameter in self._layer.spec.params}
        for name in names or ():
            if name not in declared:
                raise InputError(
                    "free",
                    got=repr(name),
                    expected=f"parameters of backend {self._layer.backend!r}",
                    fix=f"`soma backends show {self._layer.backend}` lists them.",
                )
        if names is None:
            groups = {parameter.group for parameter in declared.values()}
            enabled = {group for group in groups if not group or self._enabled(group)}
            names = [p.name for p in declared.values() if p.group in enabled or p.name in self._given]
        if not names:
            raise InputError(
                "free",
                got="no parameter",
                expected="at least one that may change",
                fix="Name some in free, or fit without the backend by the method unpose.",
            )
        return [declared[name] for name in dict.fromkeys(names)]

    def _enabled(self, group: str) -> bool:
        """Whether the backend takes every parameter of a group."""
        members = [parameter for parameter in self._layer.spec.params if parameter.group == group]
        try:
            self._layer.identity({p.name: np.full(p.shape, float(p.default)) for p in members})
        except InputError:
            return False
        return True

    def _value(self, parameter: Parameter) -> np.ndarray:
        given = self._given.get(parameter.name)
        if given is None:
            return np.full(int(np.prod(parameter.shape)), parameter.default)
        return given.detach().double().cpu().numpy().ravel()

    def params(self, points: np.ndarray) -> dict[str, Tensor]:
        """Parameters of (m, k) points, each (m, *shape)."""
        values = self._default + self._unit * points
        kind: Kind = {"dtype": self._layer.dtype, "device": self._layer.device}
        result = {name: value.expand(len(points), *value.shape[1:]) for name, value in self._given.items()}
        first = 0
        for parameter in self._free:
            size = int(np.prod(parameter.shape))
            block = values[:, first : first + size].reshape(len(points), *parameter.shape)
            result[parameter.name] = torch.as_tensor(block, **kind)
            first += size
        return result

    def identities(self, points: np.ndarray) -> Identity:
        """Identities of (m, k) points."""
        return self._layer.identity(self.params(points))

    def spread(self, count: int) -> np.ndarray:
        """Points (count, k) that cover the bounded parameters evenly; deviations stay where they start."""
        bounded = np.flatnonzero(np.isfinite(self.upper))
        points = np.tile(self.start, (count if len(bounded) else 0, 1))
        if len(points):
            from scipy.stats import qmc  # takes half a second

            unit = qmc.Halton(len(bounded), scramble=False).random(count + 1)[1:]  # the first is a corner
            span = self.upper[bounded] - self.lower[bounded]
            points[:, bounded] = self.lower[bounded] + unit * span
        return points

    def inward(self, point: np.ndarray, length: float) -> np.ndarray:
        """Steps (k,) of `length` away from the nearer bound."""
        room_above, room_below = self.upper - point, point - self.lower
        return np.where(room_above >= room_below, length, -length)


def body_joints(layer: SomaLayer) -> np.ndarray:
    """Joints whose centre shows in how the body moves, the Hips left out: they may be anywhere."""
    areas = vertex_areas(np.asarray(layer.rig.bind_shape, np.float64), layer.mesh.triangles)
    areas[layer.mesh.face_interior] = 0
    share = layer.rig.weights.T @ areas / areas.sum()
    share[:2] = 0  # the virtual Root and the Hips
    return np.flatnonzero(share > _LEAST_SHARE)


class WithJoints:
    """Free parameters, and shifts of the joint centres inside a body whose skin stays as it is.

    A mesh that another model moved turns about that model's joints. Without their shifts as unknowns the
    rest shape would have to make up for the difference.

    Args:
        parameters: of the rest shape.
        layer: whose joints they are.

    Attributes:
        parameters: as given; they come first in every point.
        start, lower, upper: (k,) float64, as in :class:`FreeParameters`.
    """

    def __init__(self, parameters: FreeParameters, layer: SomaLayer) -> None:
        self.parameters, self._joints = parameters, body_joints(layer)
        count = 3 * len(self._joints)
        self.start = np.concatenate((parameters.start, np.zeros(count)))
        self.lower = np.concatenate((parameters.lower, np.full(count, -np.inf)))
        self.upper = np.concatenate((parameters.upper, np.full(count, np.inf)))

    def identities(self, points: np.ndarray) -> Identity:
        """Identities of (m, k) points."""
        count = len(self.parameters.start)
        identity = self.parameters.identities(points[:, :count])
        bind = identity.bind_world.clone()
        shift = _UNIT * points[:, count:].reshape(len(points), -1, 3)
        bind[:, self._joints, :3, 3] += torch.as_tensor(shift).to(bind)
        return replace(identity, bind_world=bind)

    def inward(self, point: np.ndarray, length: float) -> np.ndarray:
        """Steps (k,) of `length` away from the nearer bound."""
        count = len(self.parameters.start)
        own = self.parameters.inward(point[:count], length)
        return np.concatenate((own, np.full(len(point) - count, length)))
