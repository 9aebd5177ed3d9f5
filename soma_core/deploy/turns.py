"""Rotations and twist in few operators; numbers of a matrix are outermost, bodies innermost."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.twist import Twist
from soma_core.geometry.constants import constant

__all__ = ["AxisAngle", "ShortTwist", "product"]


def product(left: Tensor, right: Tensor, *, transposed: bool = False) -> Tensor:
    """Products of matrices; (a, b, ...) and (b, c, ...) -> (a, c, ...), of (b, a, ...) if `transposed`."""
    if transposed:
        return (left[:, :, None] * right[:, None]).sum(0)
    return (left[:, :, None] * right[None]).sum(1)


def _cross_map() -> np.ndarray:
    """The matrix (9, 3) from a vector to its cross-product matrix."""
    across = np.array([np.cross(np.eye(3), unit) for unit in np.eye(3)])  # j, k, i: e_k x e_j
    return across.transpose(2, 0, 1).reshape(9, 3)


class AxisAngle(torch.nn.Module):
    """``I + a [v]x + b [v]x^2`` of vectors, (3, n) -> (9, n)."""

    def __init__(self, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        eye = np.eye(3).reshape(9, 1)
        keep = functools.partial(constant, dtype=dtype, device=device)
        self.map = keep(np.hstack((_cross_map(), np.eye(9) - eye @ eye.T)))
        self.eye = keep(eye)

    def forward(self, vector: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Matrices (9, n) of vectors (3, n), with a and b (1, n)."""
        outer = (vector[:, None] * vector[None]).flatten(0, 1)
        return self.map @ torch.cat((a * vector, b * outer)) + self.eye

    def exponential(self, vector: Tensor) -> Tensor:
        """What ``axis_angle_to_matrix`` gives; (3, n) -> (9, n)."""
        squared = (vector * vector).sum(0, keepdim=True)
        small = squared < 1e-4
        angle = torch.where(small, 1.0, squared).sqrt()
        half = torch.sin(0.5 * angle) / angle
        a = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
        b = torch.where(small, 0.5 - squared / 24, 2 * half * half)
        return self(vector, a, b)


class ShortTwist(torch.nn.Module):
    """Stands in for a ``Twist`` whose channels are all aligned; equal to rounding."""

    def __init__(self, given: Twist, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        keep = functools.partial(constant, dtype=dtype, device=device)
        self.start, self.joint, self.reference = given.start, given.joint, given.reference
        self.low = given.low
        place, start, low, high = (
            getattr(given, name).cpu().numpy() for name in ("place", "start", "low", "high")
        )
        eye = np.eye(place.shape[1])
        self.helpers, self.mix = len(place), given.mix
        self.places = keep(np.concatenate((place, place - eye[start], eye[high] - eye[low])))
        self.axis = keep(given.axis.double().cpu().numpy().T[None, :, :, None])
        self.source_axis = keep(given.source_axis.double().cpu().numpy().T[None, :, :, None])
        cross = _cross_map()
        sums = np.eye(3).reshape(1, 9)
        numbers = np.zeros((4, 4, 9))  # 4 q q^T, without its constant part
        numbers[0, 0] = sums
        numbers[0, 1:] = numbers[1:, 0] = cross.T
        for i, j in np.ndindex(3, 3):
            numbers[1 + i, 1 + j, 3 * i + j] += 1
            numbers[1 + i, 1 + j, 3 * j + i] += 1
        numbers[np.arange(1, 4), np.arange(1, 4)] -= sums
        self.numbers = keep(numbers.reshape(16, 9))
        self.ones = keep(np.eye(4).reshape(16, 1))
        self.diagonal, self.four = keep(5 * np.arange(4)), keep(np.arange(4)[:, None])
        self.turn = AxisAngle(dtype=dtype, device=device)

    def forward(
        self, bind_world: Tensor, turns: Tensor, positions: Tensor, bone_scale: Tensor | None = None
    ) -> Tensor:
        """Skinning transforms (B, H, 3, 4) [m]; takes what ``Twist`` does, but no scale of bones."""
        assert bone_scale is None
        bind = bind_world[..., :3, :].permute(2, 3, 1, 0)
        moved = self.planes(bind[:, :3], bind[:, 3], turns.permute(2, 3, 1, 0), positions.permute(2, 1, 0))
        return moved.permute(3, 2, 0, 1)

    def planes(self, bind: Tensor, places: Tensor, turns: Tensor, positions: Tensor) -> Tensor:
        """The same, (3, 4, H, B), of rotations (3, 3, J, B) and positions (3, J, B) in either pose."""
        count = self.helpers
        placed = self.places @ places
        home, away, bones = placed[:, :count], placed[:, count : 2 * count], placed[:, 2 * count :]
        angle = self.mix @ self._channels(bones, bind, turns)  # (H, B)
        axis = (bind.index_select(2, self.start) * self.axis).sum(1)
        angle = angle.flatten()[None]
        shape = 3, 3, count, turns.shape[3]
        axis = axis.expand(3, *shape[2:]).flatten(1)
        spin = self.turn(axis, torch.sin(angle), 1 - torch.cos(angle)).view(shape)
        carried = turns.index_select(2, self.start)
        away = away - (spin * home).sum(1)
        shift = (carried * away).sum(1) + positions.index_select(1, self.start)
        return torch.cat((product(carried, spin), shift[:, None]), 1)

    def _channels(self, bones: Tensor, bind: Tensor, turns: Tensor) -> Tensor:
        """Twist angles (K, B) [rad] about segments (3, K, B)."""
        own = (bind.index_select(2, self.low) * self.source_axis).sum(1)
        length = bones.norm(dim=0, keepdim=True)
        axis = torch.where(length > 1e-8, bones / length.clamp_min(1e-8), own)
        axis = torch.where((axis * own).sum(0, keepdim=True) < 0, -axis, axis)
        reference, joint = turns.index_select(2, self.reference), turns.index_select(2, self.joint)
        between = product(reference, joint, transposed=True)
        numbers = self.numbers @ between.flatten(2).flatten(0, 1) + self.ones
        largest = numbers.index_select(0, self.diagonal).argmax(0, keepdim=True)
        chosen = (self.four == largest).to(numbers.dtype)
        quaternion = (numbers.unflatten(0, (4, 4)) * chosen[:, None]).sum(0).unflatten(1, between.shape[2:])
        scalar, along = quaternion[0], (quaternion[1:] * axis).sum(0)
        along = torch.where(scalar < 0, -along, along)
        return 4 * torch.atan(along / (quaternion.norm(dim=0) + scalar.abs()))
