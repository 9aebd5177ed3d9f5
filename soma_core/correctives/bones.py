"""Bone under the skin: a bent limb keeps its shape in front of the joint, and its flesh gives way behind."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.correctives.frames import diffused
from soma_core.correctives.masks import Creases
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.rig.skeleton import Rig

__all__ = ["Bones", "bony_share"]

_FRONT = (("Shin", (0.0, 0.0, 1.0)), ("ForeArm", (0.0, 0.0, -1.0)))
"""Hinges with bone right under the skin (kneecap, condyles, tip of the elbow), and where it lies: in the
T-pose world, +Z forward. A shoulder or a hip has flesh all around."""

_AROUND = (-0.7, -0.1)
"""Cosine of the angle to that direction, about the limb, between which flesh turns into bone."""

_ALONG = (0.4, 1.3)
"""Distance along the limb, in its thicknesses, between which bone turns into flesh."""

_WIDEST, _SMALLEST = 2.0, 1e-4
"""Nothing farther from the limb's axis than so many thicknesses is of the limb; smoothed weights left out."""


class Bones:
    """Skin over bone goes around the joint on an arc and keeps its distance from it.

    With M the transform blended by smoothed weights, c the place of the joint and R the rotation nearest to
    M: ``x = M c + R (u - c)``. Linear blend skinning pulls it in, by half the limb at 150 degrees.

    Args:
        rest: (v, 3) [m].
        weights: (v, T) skin weights.
        bind_world: (J, 4, 4) of the body.
        rig: of the canonical body, which says where bone is.
        creases, laplacian: as the surface's.
        step, rounds: smoothing of the weights.

    Attributes:
        share: (v,) 1 over bone, 0 over flesh.
        ids: (n,) vertices with any share.
    """

    def __init__(
        self,
        rest: np.ndarray,
        weights: scipy.sparse.csr_array,
        bind_world: np.ndarray,
        rig: Rig,
        creases: Creases,
        laplacian: scipy.sparse.csr_array,
        *,
        step: float,
        rounds: int,
    ) -> None:
        shares = bony_share(rig, creases)
        joints = np.array(list(shares), int)
        stacked = np.stack([np.zeros(len(rest)), *shares.values()])
        self.share = stacked.max(0)
        self.ids = np.flatnonzero(self.share)
        owner = joints[stacked[1:, self.ids].argmax(0)] if len(joints) else joints
        smooth = diffused(weights.toarray(), laplacian, step=step, rounds=rounds)[self.ids]
        smooth[smooth < _SMALLEST] = 0
        self._weights = scipy.sparse.csr_array(smooth / smooth.sum(1, keepdims=True))
        self._centre = torch.as_tensor(bind_world[owner, :3, 3])
        self._arm = torch.as_tensor(rest[self.ids]) - self._centre

    def __call__(self, transforms: Tensor) -> np.ndarray:
        """Places (B, n, 3) [m] of the skin over bone under skinning transforms (B, T, 3, 4)."""
        batch, count = transforms.shape[:2]
        columns = transforms.permute(1, 0, 2, 3).reshape(count, -1).numpy()
        blended = torch.as_tensor(self._weights @ columns).view(-1, batch, 3, 4).transpose(0, 1)
        turned = rotation_from_covariance(blended[..., :3].contiguous()) @ self._arm[..., None]
        moved = blended[..., :3] @ self._centre[..., None] + blended[..., 3:] + turned
        places: np.ndarray = moved[..., 0].numpy()
        return places


def bony_share(rig: Rig, creases: Creases) -> dict[int, np.ndarray]:
    """Joint id -> share (v,) of bone under the skin of the bind shape, for the hinges that the rig has."""
    names, world = list(rig.joint_names), rig.bind_world
    found = {}
    for part, front in _FRONT:
        for joint in (names.index(side + part) for side in ("Left", "Right") if side + part in names):
            if joint not in creases.radius:
                continue
            below = [child for child, parent in enumerate(rig.parents) if parent == joint] or [joint]
            axis = world[below[0], :3, 3] - world[rig.parents[joint], :3, 3]
            axis = axis / np.linalg.norm(axis)
            direction = world[joint, :3, :3] @ rig.t_pose_world[joint, :3, :3].T @ np.array(front)
            away = (rig.bind_shape - world[joint, :3, 3]) / creases.radius[joint]
            along = away @ axis
            across = away - along[:, None] * axis
            wide = np.linalg.norm(across, axis=1)
            around = (across @ direction) / np.maximum(wide, 1e-9)
            near = _ramp(-np.abs(along), -_ALONG[1], -_ALONG[0])
            found[joint] = _ramp(around, *_AROUND) * near * (wide < _WIDEST)
    return found


def _ramp(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """From 0 at `low` to 1 at `high`, with no slope at either."""
    share = np.clip((value - low) / (high - low), 0, 1)
    ramped: np.ndarray = share * share * (3 - 2 * share)
    return ramped
