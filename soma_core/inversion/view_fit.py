"""One fit of poses to what cameras see: a start for one view or several, then rows of pixels."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion.point_fit import (
    FEWEST,
    PointFit,
    determined,
    paces,
    trusted,
)
from soma_core.inversion.point_model import PointModel, PointRest
from soma_core.inversion.point_rows import PointRows
from soma_core.inversion.point_start import PointStart
from soma_core.inversion.point_views import Views
from soma_core.inversion.problem import Pose, bridged, part_of
from soma_core.inversion.result import InversionResult, PointResult
from soma_core.skeleton.identity import Identity

__all__ = ["ViewFit"]

_HEADINGS, _LOOKED = 8, 48
"""Directions that a person may face at first, and frames of a motion that are begun from all of them."""

_CLOSEST = 0.5
"""Of the Hips to the camera at first [m], beside what of the body lies nearer."""

_SPEED, _WAVER, _LEAP = 3.0, 0.2, 4.0
"""Between frames a joint turns about so fast [rad/s] and so far [rad]; more costs no more than this."""

_CORRECTIONS, _ROUNDS, _SETTLED = 2, 6, 0.1
"""How often a motion is fitted until the weights of points that are none of the body change by no more; how
often what twist joints and correctives do to points of the skin is looked at."""

_TOLD = 0.25
"""Share of the numbers that a pose must leave over, so that what it misses tells their noise."""


class ViewFit:
    """Poses of the frames of one call, from the pictures of cameras.

    Args:
        model, start: of the points.
        views: what is seen.
        identity: batch of 1 or F.
        bone_scale: (1 or F, J - 1); None without.
        noise: of a coordinate [px]; None to estimate it.
        fps: of one motion; None for frames that are apart.
    """

    def __init__(
        self,
        model: PointModel,
        start: PointStart,
        views: Views,
        identity: Identity,
        bone_scale: Tensor | None,
        *,
        noise: float | None,
        fps: float | None,
    ) -> None:
        self.model, self.start, self.views, self.fps = model, start, views, fps
        self.identity, self.bone_scale = identity, bone_scale
        self.rest = model.rest(identity, bone_scale)
        self.valid = ((views.weights > 0).sum(2) >= FEWEST).any(0)
        self.given, self.sure = noise, views.weights
        self.noise = noise or views.noise(motion=fps is not None)
        self.shift = views.rays.new_zeros(*views.rays.shape[1:3], 3)
        self.others: Tensor | None = None  # turns of the joints that points say nothing of; None at rest
        self.pose = Pose.begin(model.mean.expand(len(self.shift), -1, 3, 3), self.shift[:, 0])

    def __call__(self, initial: InversionResult | None) -> PointResult:
        """Fit, from an earlier result or from what is seen."""
        self.begin(initial)
        self.run()
        return self.result()

    def begin(self, initial: InversionResult | None) -> None:
        """Start from an earlier result, from where rays meet, or from one view."""
        if not bool(self.valid.any()):
            return
        if initial is not None:
            self.others = initial.rotations.detach()
            self.pose = self.model.pose(self.others, initial.translation.detach())
            return
        points, weights = self.views.triangulated()
        if bool(((weights > 0).sum(1) >= 2 * FEWEST).any()):
            self.pose = self._met(points, weights)
        else:
            self.pose = self._lifted()

    def run(self) -> None:
        """Fit all frames, and look at the noise and at what twist joints and correctives do."""
        if not bool(self.valid.any()):
            return
        for number in range(_ROUNDS):
            self._solve()
            if self.given is None:
                self.noise = self._estimate()
            if number < _CORRECTIONS and self.model.corrected:
                self._correct()
            elif not self._trusted() and number:
                break

    def _trusted(self) -> bool:
        """Let points count less that miss by more than noise does; whether that changed anything."""
        misses = self.views.seen(self._points())[0].norm(dim=-1)
        weights = self.sure * trusted(misses * self.sure.sqrt(), self.noise)
        same = torch.allclose(weights, self.views.weights, atol=_SETTLED)
        self.views = replace(self.views, weights=weights)
        return not same

    def _rest_of(self, some: Tensor) -> PointRest:
        rest = self.rest
        return rest if len(rest.local) == 1 else PointRest(local=rest.local[some], offsets=rest.offsets[some])

    def _met(self, points: Tensor, weights: Tensor) -> Pose:
        """The poses of points where rays meet; frames with too few between the others."""
        fit = PointFit(
            self.model, self.start, points, weights, self.identity, self.bone_scale, noise=None, iterations=20
        )
        fit.begin(None, named="translations of the cameras")
        fit.run()
        return bridged(replace(fit.pose, translation=fit.pose.translation + fit.origin), fit.valid)

    def _lifted(self) -> Pose:
        """Poses by one view: the best of several directions that a person may face."""
        some = torch.nonzero(self.valid).flatten()
        if self.fps is not None and len(some) > _LOOKED:
            some = some[torch.linspace(0, len(some) - 1, _LOOKED).round().long()]
        rest, views = self._rest_of(some), self.views.some(some)
        solve = PointRows(self.model, rest, views.rows(self.noise, self.shift[some]), smooth=None)
        tried = [solve(pose) for pose in self._facing(rest, views)]
        energy = torch.stack([solve.energy(pose) for pose in tried])
        turns = torch.stack([pose.relative for pose in tried])
        chosen, each = self._path(energy, turns, some), torch.arange(len(some), device=some.device)
        hips = torch.stack([pose.translation for pose in tried])[chosen, each]
        whole = Pose.begin(
            self.model.mean.expand(len(self.valid), -1, 3, 3), hips.new_zeros(len(self.valid), 3)
        )
        whole = whole.put(some, Pose.begin(turns[chosen, each], hips))
        known = torch.zeros_like(self.valid)
        known[some] = True
        return bridged(whole, known)

    def _facing(self, rest: PointRest, views: Views) -> list[Pose]:
        """Where a person would stand who faces either way, in the view with most points."""
        model = self.model
        best = int((views.weights > 0).sum((1, 2)).argmax())
        view = views.some(slice(None), slice(best, best + 1))
        to, shift, rays, weights = view.turns[0], view.shifts[0], view.rays[0], view.weights[0]
        still = Pose.begin(model.mean.expand(len(to), -1, 3, 3), shift.new_zeros(len(to), 3))
        points = model.points(rest, *model.walk(still, rest))
        total = weights.sum(1)[:, None, None].clamp_min(1e-12)

        def middle(values: Tensor) -> Tensor:
            return (weights[..., None] * values).sum(1, keepdim=True) / total

        found = []
        for place in range(_HEADINGS):
            heading = axis_angle_to_matrix(points.new_tensor([0, 2 * torch.pi * place / _HEADINGS, 0]))
            own = points @ (to @ heading).mT
            aims, arms = rays - middle(rays), own[..., :2] - middle(own[..., :2])
            turn = torch.zeros_like(to[:, 0])
            turn[:, 2] = torch.atan2(
                (weights * (arms[..., 0] * aims[..., 1] - arms[..., 1] * aims[..., 0])).sum(1),
                (weights * (arms * aims).sum(-1)).sum(1),
            )
            roll = axis_angle_to_matrix(turn)
            hips = (to.mT @ (_distance(own @ roll.mT, rays, weights) - shift)[..., None]).squeeze(-1)
            relative = still.relative.clone()
            relative[:, 1] = to.mT @ roll @ to @ heading @ still.relative[:, 1]
            found.append(Pose.begin(relative, hips))
        return found

    def _path(self, energy: Tensor, turns: Tensor, frames: Tensor) -> Tensor:
        """Which of the starts each frame (f,) goes on with: (K, f) energies, and little turning between."""
        if self.fps is None:
            return energy.argmin(0)
        own = turns[:, :, self.model.solver.variables]
        best, back = energy[:, 0], []
        for frame in range(1, energy.shape[1]):
            cosine = torch.einsum("knab,lnab->kln", own[:, frame - 1], own[:, frame])
            angle = torch.acos(((cosine - 1) / 2).clamp(-1, 1))
            usual = _WAVER + _SPEED * float(frames[frame] - frames[frame - 1]) / self.fps
            cost = best[:, None] + (angle / usual).square().clamp_max(_LEAP).sum(-1)
            least, before = cost.min(0)
            best = least + energy[:, frame]
            back.append(before)
        way = [best.argmin()]
        for before in reversed(back):
            way.append(before[way[-1]])
        return torch.stack(way[::-1])

    def _solve(self) -> None:
        self.pose = self._rows(self._paces())(self.pose)

    def _paces(self) -> Tensor | None:
        """Usual second differences of one motion; None for frames that are apart."""
        if self.fps is None or len(self.valid) < 3:
            return None
        return paces(self.model, self.fps)

    def lowered(self, views: Views) -> PointRows:
        """What the fit lowers, of what is seen, with the weights that it came to."""
        rows = replace(views, weights=self.views.weights).rows(self.noise, self.shift)
        return PointRows(self.model, self.rest, rows, smooth=self._paces())

    def _rows(self, smooth: Tensor | None) -> PointRows:
        return PointRows(self.model, self.rest, self.views.rows(self.noise, self.shift), smooth=smooth)

    def _points(self) -> Tensor:
        """The points (F, P, 3) [m] of the pose."""
        return self.model.points(self.rest, *self.model.walk(self.pose, self.rest)) + self.shift

    def _estimate(self) -> float:
        """Noise [px] from what is left, where the points leave enough over."""
        views, solve = self.views, self._rows(None)
        count = 2.0 * (views.weights > 0).sum((0, 2))[self.valid].float().mean()
        spare = count - float(solve.taken(self.pose)[self.valid].mean())
        if spare < _TOLD * count:
            return self.noise
        misses = views.weights * views.seen(self._points())[0].square().sum(-1)
        energy = float(misses.sum((0, 2))[self.valid].median())
        usual = (1 - 2 / (9 * spare)) ** 3  # the median of chi squared beside its mean
        return max(math.sqrt(energy / (usual * spare)), views.least_noise)

    def _correct(self) -> None:
        """What twist joints and correctives do to the points, beside plain skinning."""
        layer, places, pose, scale = self.model.layer, self.model.places, self.pose, self.bone_scale
        rotations = self.model.rotations(pose, self.others)
        plain = self._points() - self.shift
        for first in range(0, len(self.valid), 256):
            part = slice(first, first + 256)
            posed = layer.pose(
                part_of(self.identity, part), rotations[part], pose.translation[part],
                bone_scale=scale if scale is None or len(scale) == 1 else scale[part],
            )  # fmt: skip
            points = places(posed.transforms, posed.vertices[:, places.vertex_ids])
            self.shift[part] = points - plain[part]

    def result(self) -> PointResult:
        """What the poses are worth."""
        valid, views, pose = self.valid, self.views, self.pose
        misses = views.seen(self._points())[0].norm(dim=-1)
        mass = views.weights.sum((0, 2)).clamp_min(1e-12)
        residual = ((views.weights * misses.square()).sum((0, 2)) / mass).sqrt()
        std = self.model.spread.repeat(len(valid), 1)
        std[:, self.model.kept[1:]] = self._rows(None).angle_std(pose).to(std)
        posed = valid | (self.fps is not None and bool(valid.any()))
        eye = torch.eye(3).to(misses)
        return PointResult(
            rotations=torch.where(posed[:, None, None, None], self.model.rotations(pose, self.others), eye),
            translation=torch.where(posed[:, None], pose.translation, 0.0),
            vertex_error=misses.masked_fill(~((views.weights > 0) & valid[:, None]), torch.nan).nanmean(0),
            valid=valid,
            determined=determined(std[:, 1:], self.model) & valid[:, None],
            converged=valid & torch.isfinite(residual),
            iterations=pose.accepted,
            residual=residual.masked_fill(~valid, torch.nan),
            angle_std=std[:, 1:].masked_fill(~valid[:, None], torch.nan),
            noise=self.noise,
            plain=torch.zeros_like(valid),
        )


def _distance(points: Tensor, rays: Tensor, weights: Tensor) -> Tensor:
    """Shifts (f, 3) [m] that bring points (f, P, 3) in the camera's axes nearest to their rays (f, P, 2)."""
    depth = points[..., 2:]
    goal = (rays * depth - points[..., :2]).flatten(1)
    rows = rays.new_zeros(*rays.shape, 3)
    rows[..., 0, 0] = rows[..., 1, 1] = 1
    rows[..., 2] = -rays
    weigh = weights[..., None, None] * rows
    matrix = (weigh.flatten(1, 2).mT @ rows.flatten(1, 2)).double()
    matrix = matrix + 1e-9 * torch.eye(3).to(matrix)
    slope = (weigh.flatten(1, 2).mT @ goal[..., None]).double()
    shift = torch.linalg.solve(matrix, slope).squeeze(-1).to(rays)
    near = _CLOSEST - depth.amin((1, 2))
    return torch.cat((shift[:, :2], torch.maximum(shift[:, 2], near)[:, None]), 1)
