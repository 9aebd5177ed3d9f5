"""The skeleton's rotations in few operators: an engine spends more on starting one than on its numbers."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.constants import constant
from soma_core.geometry.kabsch import PRIOR_STRENGTH
from soma_core.skeleton.rotations import RotationFit

__all__ = ["NearestRotation", "ShortRotationFit"]

_SMALL = 1e-12
"""Squares of numbers near one, below which they are rounding of float32."""

_LEAST = 1e-30
"""What is added to, or put in the place of, a divisor that may be zero."""


class NearestRotation(torch.nn.Module):
    """``rotation_from_covariance`` of n matrices as rows of numbers, (9, n) -> (9, n), to rounding.

    With singular values s1 >= s2 >= s3 and sign s of a covariance H, ``X = H + cof(H) / s1`` has (p, q, q),
    so that ``(X + cof(X) / q) / (p + q)`` is its polar factor. One step of Newton's takes off rounding.
    """

    def __init__(self, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        keep = functools.partial(constant, dtype=dtype, device=device)
        row, column = np.divmod(np.arange(9), 3)

        def entry(down: int, right: int) -> np.ndarray:
            return (row + down) % 3 * 3 + (column + right) % 3

        self.left = keep(np.concatenate((entry(1, 1), entry(1, 2))))
        self.right = keep(np.concatenate((entry(2, 2), entry(2, 1))))
        self.difference = keep(np.hstack((np.eye(9), -np.eye(9))))
        self.eye = keep(np.eye(3).reshape(9, 1))
        self.pull = keep(PRIOR_STRENGTH * np.eye(3).reshape(9, 1))

    def cofactor(self, rows: Tensor) -> Tensor:
        """Cofactor matrices; (9, n) -> (9, n)."""
        return self.difference @ (rows.index_select(0, self.left) * rows.index_select(0, self.right))

    def forward(self, covariance: Tensor) -> Tensor:
        """Rotations nearest to covariances; takes and returns (9, n)."""
        unit = covariance / covariance.norm(dim=0, keepdim=True).clamp_min(_SMALL) + self.pull
        adjugate = self.cofactor(unit)
        three_det = (unit * adjugate).sum(0, keepdim=True)
        # the largest eigenvalue of H^T H, whose trace is 1, from the sum of its minors and its determinant
        squared = (1 - 3 * (adjugate * adjugate).sum(0, keepdim=True)).clamp_min(_SMALL)
        spread = squared.sqrt()
        cosine = (1.5 * (squared + three_det * three_det) - 0.5) / (squared * spread)
        eigenvalue = 2 / 3 * spread * torch.cos(torch.acos(cosine.clamp(-1, 1)) / 3) + 1 / 3
        largest = eigenvalue.sqrt()
        x = unit + adjugate / largest
        p = largest + three_det / (3 * eigenvalue)
        adjugate = self.cofactor(x)
        q = ((x * adjugate).sum(0, keepdim=True) / (3 * p)).clamp_min(_LEAST).sqrt()
        x = (x + adjugate / q) / (p + q)
        adjugate = self.cofactor(x)
        three_det = (x * adjugate).sum(0, keepdim=True)
        arrived = (x - adjugate).abs().amax(0, keepdim=True) < 3e-3 * three_det.clamp_max(3)
        x = 0.5 * x + adjugate * (1.5 / three_det)
        return torch.where(arrived, x, self.eye)


class ShortRotationFit(torch.nn.Module):
    """Stands in for ``RotationFit``; equal to rounding. Bodies are innermost, numbers of a matrix outermost.

    A bone that is turned by half a turn beyond its cloud turns about another axis; no body's does.
    """

    def __init__(self, given: RotationFit, *, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        keep = functools.partial(constant, dtype=dtype, device=device)
        table = {
            name: getattr(given, name).cpu().numpy()
            for name in ("pivots", "single", "single_child", "several", "fan_slot", "fan_child", "pair",
                         "source", "order", "bones", "bind_rotation")
        }  # fmt: skip
        single, several, slot = table["single"], table["several"], table["fan_slot"]
        self.singles, self.fans = len(single), len(several)
        self.nearest = NearestRotation(dtype=dtype, device=device)
        pivots = table["pivots"][np.concatenate((single, several))]
        self.pivots = keep(pivots)  # those of one child first
        self.rank = keep(np.concatenate((np.arange(len(single)), len(single) + slot)))
        child = np.concatenate((table["single_child"], table["fan_child"]))
        self.bones = keep(table["bones"][child].T[None, :, :, None])
        ends = np.zeros((len(child), len(table["source"])))
        ends[np.arange(len(child)), child] = 1
        ends[
            np.arange(len(child)), np.concatenate((pivots[: len(single)], table["pivots"][several[slot]]))
        ] -= 1
        self.ends = keep(ends)
        self.aside = keep(np.cross(np.eye(3), [0.48, 0.6, 0.64]).T)  # a matrix whose product is across
        owner, *pair = table["pair"]
        self.first, self.second = (keep(each) for each in pair)
        self.gathered = keep(1.0 * (np.arange(len(several))[:, None] == np.concatenate((slot, owner))))
        self.ahead, self.behind = keep(np.array([1, 2, 0, 2, 0, 1])), keep(np.array([2, 0, 1, 1, 2, 0]))
        turned = table["source"] > 0
        self.source = keep(np.where(turned, table["order"][table["source"] - 1], 0))
        bind = table["bind_rotation"]
        self.bind = keep((bind * turned[:, None, None]).transpose(1, 2, 0)[None, ..., None])
        self.kept = keep((bind * ~turned[:, None, None]).transpose(1, 2, 0)[..., None])
        self.tiny = torch.finfo(dtype).tiny ** 0.5
        self.fused = False

    def forward(self, joints: Tensor, covariances: Tensor) -> Tensor:
        """World rotations (B, J, 3, 3); takes what ``RotationFit`` does."""
        single = self.singles
        clouds = covariances.index_select(1, self.pivots).flatten(2).permute(2, 1, 0)
        initial = self._nearest(clouds)
        turned = (initial.index_select(2, self.rank) * self.bones).sum(1)
        target = (self.ends @ joints).permute(2, 1, 0)
        bones = torch.stack((turned, target), 1)  # (3, 2, e, B)
        parts = []
        if single:
            parts.append(self._aligned(bones[:, :, :single], initial[:, :, :single]))
        if self.fans:
            spread = self._spread(bones[:, :, single:])
            parts.append((spread[:, :, None] * initial[None, :, :, single:]).sum(1))
        turns = torch.cat(parts, 2).index_select(2, self.source)
        world = (turns[:, :, None] * self.bind).sum(1) + self.kept
        return world.permute(3, 2, 0, 1)

    def _nearest(self, clouds: Tensor) -> Tensor:
        """Rotations (3, 3, n, B) of covariances (9, n, B)."""
        return self.nearest(clouds.flatten(1)).view(3, 3, *clouds.shape[1:])

    def _aligned(self, bones: Tensor, turns: Tensor) -> Tensor:
        """Turns after the shortest arcs between two bones each, (3, 2, e, B), as two half turns."""
        unit = bones / bones.norm(dim=0, keepdim=True).clamp_min(_SMALL)
        source, total = unit[:, 0], unit.sum(1)
        across = (self.aside @ source.flatten(1)).view(total.shape)
        opposite = (total * total).sum(0, keepdim=True) < 1e-7
        middle = torch.where(opposite, across, total)
        middle = middle / middle.norm(dim=0, keepdim=True)
        for axis in (source, middle):
            turns = 2 * axis[:, None] * (axis[:, None] * turns).sum(0, keepdim=True) - turns
        return turns

    def _spread(self, bones: Tensor) -> Tensor:
        """Turns (3, 3, s, B) of fans of bones (3, 2, f, B), by the bones and the normals of their pairs."""
        ahead = bones.index_select(0, self.ahead).index_select(2, self.first)
        behind = bones.index_select(0, self.behind).index_select(2, self.second)
        products = ahead * behind
        normal = products[:3] - products[3:]
        normal = normal * ((normal * normal).sum(0, keepdim=True) + self.tiny) ** -0.25
        arrows = torch.cat((bones, normal), 2)
        outer = arrows[:, None, 1] * arrows[None, :, 0]
        return self._nearest((self.gathered @ outer).flatten(0, 1))
