"""Points in pictures of calibrated cameras: rows of the solver, where rays meet, and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from soma_core.inversion.point_rows import Rows
from soma_core.io.camera import Camera

__all__ = ["Views"]

_NEAREST = 0.05
"""Depth [m] that points in front of a camera have at least, while a fit is under way."""

_LEAST_NOISE, _USUAL_NOISE = 5e-4, 5e-3
"""Noise of a coordinate beside the extent of a person in a picture: its least, and where nothing tells it."""

_PARALLEL = 1e-3
"""Sine of half the angle of two rays that meet nowhere in particular."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """Points of some frames in the pictures of calibrated cameras.

    Attributes:
        rays: (V, F, P, 2) directions x / z and y / z in the cameras' axes, finite.
        weights: (V, F, P), 0 for what is not known.
        turns, shifts: world to camera, (V, F, 3, 3) and (V, F, 3) [m].
        lens: (V, 2, 2) pixels of a direction.
    """

    rays: Tensor
    weights: Tensor
    turns: Tensor
    shifts: Tensor
    lens: Tensor

    @classmethod
    def of(cls, cameras: Sequence[Camera], pixels: Tensor, weights: Tensor) -> Views:
        """Views from pixels (V, F, P, 2), finite, and weights (V, F, P)."""
        frames = pixels.shape[1]
        extrinsics = np.stack([
            np.broadcast_to(camera.extrinsics, (frames, *camera.extrinsics.shape[1:])) for camera in cameras
        ])  # fmt: skip
        moves = torch.as_tensor(extrinsics).to(pixels)
        inner = torch.as_tensor(np.stack([camera.intrinsics for camera in cameras])).to(pixels)
        away = pixels - inner[:, None, None, :2, 2]
        rays = away @ torch.linalg.inv(inner[:, :2, :2]).mT[:, None]
        return cls(
            rays=rays, weights=weights, turns=moves[..., :3, :3], shifts=moves[..., :3, 3],
            lens=inner[:, :2, :2],
        )  # fmt: skip

    def some(self, frames: Tensor | slice, views: slice = slice(None)) -> Views:
        """The same of some frames, or views."""
        own = {name: getattr(self, name)[views, frames] for name in ("rays", "weights", "turns", "shifts")}
        return replace(self, **own, lens=self.lens[views])

    def seen(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Misses (V, F, P, 2) [px], their derivatives (V, F, P, 2, 3) by points (F, P, 3) [m], and depths."""
        turns = self.turns[:, :, None]
        there = (turns @ points[..., None]).squeeze(-1) + self.shifts[:, :, None]
        depth = there[..., 2:].clamp_min(_NEAREST)
        flat = there[..., :2] / depth
        lens = self.lens[:, None, None]
        misses = (lens @ (flat - self.rays)[..., None]).squeeze(-1)
        slopes = lens @ (turns[..., :2, :] - flat[..., None] * turns[..., 2:, :]) / depth[..., None]
        return misses, slopes, there[..., 2]

    def rows(self, noise: float, shift: Tensor) -> Rows:
        """Rows of reprojection errors under a noise [px], of points that lie off by `shift` (F, P, 3) [m]."""

        def rows(found: Tensor, part: slice) -> tuple[Tensor, Tensor]:
            own = self.some(part)
            misses, slopes, _ = own.seen(found + shift[part])
            scale = own.weights.sqrt()[..., None] / noise
            return (
                (scale * misses).permute(1, 2, 0, 3).flatten(2),
                (scale[..., None] * slopes).permute(1, 2, 0, 3, 4).flatten(2, 3),
            )

        return rows

    def triangulated(self) -> tuple[Tensor, Tensor]:
        """Places (F, P, 3) [m] nearest to the rays of each point, and weights; 0 where less than two meet."""
        aims = torch.nn.functional.pad(self.rays, (0, 1), value=1.0)
        aims = torch.nn.functional.normalize(aims, dim=-1) @ self.turns  # in the world
        eyes = -(self.turns.mT @ self.shifts[..., None]).squeeze(-1)[:, :, None]  # (V, F, 1, 3)
        across = torch.eye(3).to(aims) - aims[..., :, None] * aims[..., None, :]
        weighed = self.weights[..., None, None] * across
        matrix = weighed.sum(0).double()
        goal = (weighed @ eyes[..., None]).sum(0).double()
        total = self.weights.sum(0)
        least = torch.linalg.eigvalsh(matrix)[..., 0]
        good = ((self.weights > 0).sum(0) > 1) & (least > _PARALLEL**2 * total)
        safe = torch.where(good[..., None, None], matrix, torch.eye(3).to(matrix))
        places = torch.linalg.solve(safe, goal).squeeze(-1).to(aims)
        return torch.where(good[..., None], places, 0.0), torch.where(good, total, 0.0)

    def extent(self) -> float:
        """Diagonal [px] of a person in the pictures: the median."""
        known = self.weights[..., None] > 0
        pixels = self.rays @ self.lens[:, None].mT
        high = torch.where(known, pixels, -torch.inf).amax(2)
        low = torch.where(known, pixels, torch.inf).amin(2)
        sizes = (high - low).norm(dim=-1)
        return float(sizes[(self.weights > 0).sum(2) > 2].nanmedian().nan_to_num(1.0))

    def noise(self, *, motion: bool) -> float:
        """Noise of a coordinate [px]: by the third differences of a motion, or what is usual."""
        extent = self.extent()
        if not motion or self.rays.shape[1] < 8:
            return _USUAL_NOISE * extent
        known = self.weights > 0
        pixels = (self.rays @ self.lens[:, None].mT) * self.weights.sqrt()[..., None]
        third = pixels[:, 3:] - 3 * pixels[:, 2:-1] + 3 * pixels[:, 1:-2] - pixels[:, :-3]
        there = known[:, 3:] & known[:, 2:-1] & known[:, 1:-2] & known[:, :-3]
        if not bool(there.any()):
            return _USUAL_NOISE * extent
        spread = float(third[there].abs().median()) / 0.6745 / 20**0.5  # of normal noise
        return max(spread, self.least_noise)

    @property
    def least_noise(self) -> float:
        """What a coordinate is off by at least [px]."""
        return _LEAST_NOISE * self.extent()
