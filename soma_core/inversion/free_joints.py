"""Joint centres as unknowns beside the parameters of a body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from soma_core.geometry.laplacian import vertex_areas
from soma_core.inversion.free_parameters import FreeParameters
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["WithJoints", "body_joints"]

_UNIT = 0.01
"""Joint centres of two models lie about this far apart [m]."""

_LEAST_SHARE = 0.0025
"""A joint takes part when it carries this share of the skin; the fingers, at 0.002 each, do not."""


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
