"""One fit of poses to points: the pose under way, the noise that weighs priors, and what came of it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from soma_core.inversion._inputs import refuse_unit_error
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.point_model import PointModel, PointRest
from soma_core.inversion.point_rows import PointRows, rows_of
from soma_core.inversion.point_start import PointStart
from soma_core.inversion.problem import Pose, bridged, part_of
from soma_core.inversion.result import InversionResult, PointResult
from soma_core.kernels._threads import in_parts, shared_out
from soma_core.skeleton.identity import Identity

__all__ = ["FEWEST", "SEVERAL", "PointFit", "determined", "paces", "trusted"]

_CHUNK, SEVERAL = 2048, 256
"""Frames fitted at a time at most, and how many are worth a thread of their own."""

_FIRST_NOISE, _LEAST_NOISE, _MOST_NOISE = 3e-4, 5e-5, 0.2
"""Noise of a coordinate [m]: taken while it is estimated, so that points have their way; its bounds."""

_UNKNOWN_NOISE = 5e-3
"""Taken where nothing is left to tell the noise by [m]."""

_SAMPLED, _COUNTED = 128, 8
"""Frames that tell the noise, and those of them that tell how many degrees of freedom the points take up."""

_LEAST_CLAIM = 5e-4
"""No angle is claimed to be surer than so much noise of a coordinate would let it be [m]."""

_OUTLYING, _ROUNDS, _SETTLED = 6.0, 5, 0.1
"""Points that miss by more than so many times the noise are none of the body: their weight falls with the
fourth power of their distance, in so many rounds, until no weight changes by more."""

_MEDIAN = 0.6745
"""Median of the absolute values of normal noise."""

_STILL = 0.02
"""A frame rests when a step changes the root mean square error by less than this share of the noise."""

_HIPS_PACE = 5.0
"""Usual acceleration of the Hips [m/s^2]."""

_LASTING = 0.1
"""A joint that is off what is expected stays so for a while [s]: frames within it are no more than one."""

_CARRIED, _TELLING, _MOST, _ALIKE = 2, 1.0, 1.2, 2e-3
"""How often the trunk of a motion is asked how it is carried, the least length of such a motion [s], how much
further than expected the trunk rests off the T-pose at most, and a change of its turns that is none [rad]."""

FEWEST = 3
"""A frame with fewer known points is not fitted."""

_CORRECTIONS = 3
"""How often what twist joints and correctives do to points of the skin is looked at."""

_SURE = 0.5
"""A joint is determined where its angle is surer than this share of what is expected of it anyway."""


class _Chunk(NamedTuple):
    """Some frames of a fit."""

    frames: slice
    rest: PointRest
    points: Tensor
    weights: Tensor
    pose: Pose


class PointFit:
    """Poses of the frames of one call.

    Args:
        model, start: of the points.
        points: targets (F, P, 3) [m], finite.
        weights: (1 or F, P), 0 for what is not known.
        identity: batch of 1 or F.
        bone_scale: (1 or F, J - 1); None without.
        noise: of a coordinate [m]; None to estimate it.
        iterations: largest number of steps of each look.
        threads: for parts of the frames.
    """

    def __init__(
        self,
        model: PointModel,
        start: PointStart,
        points: Tensor,
        weights: Tensor,
        identity: Identity,
        bone_scale: Tensor | None,
        *,
        noise: float | None,
        iterations: int,
        threads: int = 1,
    ) -> None:
        self.model, self.start, self.identity, self.bone_scale = model, start, identity, bone_scale
        self.weights, self.rest = weights, model.rest(identity, bone_scale)
        self.given, self.iterations, self.threads = noise, iterations, threads
        self.every = every = weights.expand(len(points), -1)
        self.sure, self.valid = every, (every > 0).sum(1) >= FEWEST
        total = every.sum(1, keepdim=True).clamp_min(1e-12)
        self.origin = (every[..., None] * points).sum(1) / total
        self.points = points - self.origin[:, None]
        if not bool((weights > 0).all()):
            self.points *= (every > 0)[..., None]
        self.noise = _FIRST_NOISE if noise is None else noise
        self.targets: dict[int, Tensor] = {}  # of chunks, by their first frames
        self.mean: Tensor | None = None  # where joints of this motion rest, once it has told
        self.shift, self.bridged = torch.zeros_like(self.points), False
        self.others: Tensor | None = None  # turns of the joints that points say nothing of; None at rest
        still = model.mean.expand(len(points), -1, 3, 3)
        self.pose = Pose.begin(still, torch.zeros_like(self.origin))

    def _chunks(self) -> Iterator[_Chunk]:
        """The frames, some at a time: as many for every thread."""
        for part in shared_out(len(self.points), self.threads * _CHUNK, self.threads):
            pose = Pose(**{name: value[part] for name, value in vars(self.pose).items()})
            weights = self.weights if len(self.weights) == 1 else self.weights[part]
            yield _Chunk(part, self._rest_of(part), self.points[part] - self.shift[part], weights, pose)

    def _each(self, run: Callable[[_Chunk], Any]) -> list[Any]:
        """What comes of every chunk."""
        return in_parts(run, list(self._chunks()), self.threads)

    def _rest_of(self, part: slice | Tensor) -> PointRest:
        rest = self.rest
        return rest if len(rest.local) == 1 else PointRest(local=rest.local[part], offsets=rest.offsets[part])

    def begin(self, initial: InversionResult | None, *, named: str = "points") -> None:
        """Start from the points, or from an earlier result; `named` is what is in another unit, if so."""
        at_rest = self.start.expected(self.rest) if len(self.rest.local) == 1 else None
        scale = self.start.sizes(self.rest, self.points - self.shift, self.weights, at_rest)
        scale = scale[torch.isfinite(scale)]
        if len(scale):
            refuse_unit_error(scale, named)
        if initial is not None:
            self.others = initial.rotations.to(self.points)
            self.pose = self.model.pose(self.others, initial.translation.to(self.points) - self.origin)
            return
        begun = self._each(lambda one: self.start(one.rest, one.points, one.weights, at_rest))
        self.pose = Pose.begin(*(torch.cat(parts) for parts in zip(*begun, strict=True)))

    def run(self) -> None:
        """Fit, look at the noise, and at what twist joints and correctives do, and fit again."""
        if self.given is None and bool(self.valid.any()):
            self.noise = self._sampled()._estimate()
        for _ in range(_CORRECTIONS if self.model.corrected else 0):
            self._solve(max(self.noise, _FIRST_NOISE))
            self._correct()
        if self.model.corrected and self.given is None:
            self.noise = self._estimate()
        for _ in range(_ROUNDS):
            self._solve(max(self.noise, _FIRST_NOISE))
            if not self._trusted():
                break
        if self.noise < _FIRST_NOISE:
            self._solve(_FIRST_NOISE, held=True)

    def smooth(self, fps: float) -> None:
        """Fit all frames together, each joint at its usual pace; frames without points are bridged."""
        pose = self.pose
        if len(pose.translation) < 3:
            return
        targets = self.points - self.shift + self.origin[:, None]
        found = bridged(replace(pose, translation=pose.translation + self.origin), self.valid)
        if self.others is not None:
            others = Pose.begin(self.others, found.translation)
            self.others = bridged(others, self.valid).relative
        for turn in range(_ROUNDS):
            found = self.lowered(targets + self.shift, fps)(found)
            self.pose = replace(found, translation=found.translation - self.origin)
            carried = turn < _CARRIED and len(pose.translation) >= _TELLING * fps and self._carried()
            if not self._trusted() and not carried:
                break
        if self.given is None and not torch.equal(self.every, self.sure):
            self.noise = self._sampled()._estimate()
        self.bridged = self.bridged | bool(self.valid.any())

    def lowered(self, points: Tensor, fps: float | None) -> PointRows:
        """What the fit lowers, of points (F, P, 3) [m] in the world, with the weights that it came to."""
        rows = rows_of(points - self.shift, self.weights, max(self.noise, _FIRST_NOISE))
        if fps is None or len(points) < 3:
            return PointRows(self.model, self.rest, rows, smooth=None)
        return PointRows(
            self.model, self.rest, rows, smooth=paces(self.model, fps), share=_share(fps), mean=self.mean
        )  # fmt: skip

    def _carried(self) -> bool:
        """Let trunk and collar bones rest off the T-pose as the trunk does here; whether that is new."""
        model, rest = self.model, matrix_to_axis_angle(self.model.mean)
        own, seen = rest[model.tells], matrix_to_axis_angle(self.pose.relative[:, model.tells]).mean(0)
        pull = model.pull[model.tells]
        stiff = torch.diag_embed(pull.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True).expand(-1, 3)) - pull
        heavy = (stiff @ own[..., None]).squeeze(-1)
        whole = (own * heavy).sum()
        if not whole > 0:
            return False
        share = ((seen * heavy).sum() / whole).clamp(0, _MOST)
        moved = (model.tells | model.follows)[:, None, None]
        mean = torch.where(moved, axis_angle_to_matrix(share * rest), model.mean)
        if torch.allclose(mean, model.mean if self.mean is None else self.mean, atol=_ALIKE):
            return False
        self.mean = mean
        return True

    def _sampled(self) -> PointFit:
        """A fit of some of the frames, evenly spaced, in which points have their way."""
        some = torch.nonzero(self.valid).flatten()
        some = some[torch.linspace(0, len(some) - 1, min(len(some), _SAMPLED)).round().long()]
        twin = copy.copy(self)
        twin.targets = {}
        for name in ("weights", "every", "sure", "valid", "origin", "points", "shift"):
            value = getattr(self, name)
            setattr(twin, name, value if len(value) == 1 < len(self.valid) else value[some])
        twin.rest, twin.pose = self._rest_of(some), self.pose.part(some)
        for held in (False, True):
            twin._solve(_FIRST_NOISE, held=held)
        return twin

    def _rotations(self, pose: Pose, frames: slice, out: Tensor | None = None) -> Tensor:
        """All rotations (f, J - 1, 3, 3) of some frames."""
        others = self.others
        return self.model.rotations(pose, others if others is None else others[frames], out)

    def _solve(self, noise: float, *, held: bool = False) -> None:
        """Steps of all frames under a noise [m].

        With `held` what the points leave open stays as it is, and nothing pulls at what they tell.
        """
        still, model = _STILL * noise * (0.1 if held else 1.0), self.model
        done = {name: torch.empty_like(value) for name, value in vars(self.pose).items()}
        moments_of = self._moments(noise, held=held)

        def solve(one: _Chunk) -> None:
            moments = moments_of(one)
            target = self.targets.get(one.frames.start)
            if target is None:
                target = model.target(one.rest, one.points, one.weights)
                self.targets[one.frames.start] = target
            if held:
                target = model.held(target, model.walk(one.pose, one.rest)[0], noise**2)
            found = model.solver(target, moments, one.pose, iterations=self.iterations, tolerance=still)
            for name, value in vars(found).items():
                done[name][one.frames] = value

        self._each(solve)
        self.pose = Pose(**done)

    def _moments(self, noise: float, *, held: bool = False) -> Callable[[_Chunk], RestMoments]:
        """Moments of a chunk under a noise [m]; they are the same for all of one body and one weight."""
        if len(self.rest.local) == 1 == len(self.weights):
            same = self.model.moments(self.rest, self.weights, noise**2, held=held)
            return lambda _: same
        return lambda one: self.model.moments(one.rest, one.weights, noise**2, held=held)

    def _trusted(self) -> bool:
        """Let points count less that miss by more than noise does; whether that changed anything."""
        noise, misses = max(self.noise, _FIRST_NOISE), self._distances() * self.sure.sqrt()
        if self.every is self.sure and bool((misses < _OUTLYING * noise).all()):
            return False
        weights = self.sure * trusted(misses, noise)
        same = torch.allclose(weights, self.every, atol=_SETTLED)
        if not same:
            self.weights, self.every, self.targets = weights, weights, {}
            if self.given is None:
                self.noise = min(self.noise, self._typical())
        return not same

    def _typical(self) -> float:
        """Noise of a coordinate [m], by the median of what is left at points of the body."""
        misses = torch.cat(self._each(self._misses)) * self.every.sqrt()[..., None]
        there = (self.every > 0.5 * self.sure) & (self.sure > 0) & self.valid[:, None]
        if not bool(there.any()):
            return self.noise
        some = torch.nonzero(self.valid).flatten()
        some = some[:: max(1, len(some) // _COUNTED)]
        seen = 3.0 * float(there[some].sum(1).float().mean())
        spare = max(seen - float(self._taken(some)), 0.1 * seen)
        return max(float(misses[there].abs().median()) / _MEDIAN * (seen / spare) ** 0.5, _LEAST_NOISE)

    def _misses(self, one: _Chunk) -> Tensor:
        """What points of a chunk miss, (f, P, 3) [m]."""
        return self.model.points(one.rest, *self.model.walk(one.pose, one.rest)) - one.points

    def _distances(self) -> Tensor:
        """What points miss, (F, P) [m]."""
        # torch's norm of three numbers that lie apart takes twenty times as long
        return torch.cat(self._each(lambda one: self._misses(one).square().sum(-1).sqrt()))

    def _estimate(self) -> float:
        """Noise of a coordinate [m], from what is left beside the freedom that the points take up."""
        energy = torch.cat(
            self._each(lambda one: (one.weights[..., None] * self._misses(one).square()).sum((1, 2)))
        )[self.valid]
        if not len(energy):
            return _UNKNOWN_NOISE
        some = torch.nonzero(self.valid).flatten()[:: max(1, len(energy) // _COUNTED)]
        seen = 3 * (self.every > 0)[self.valid].sum(1).to(energy).mean()
        spare = seen - self._taken(some)
        if spare < 1:  # the points just determine the pose: nothing is left to tell the noise by
            return _UNKNOWN_NOISE
        return float((energy.mean() / spare).sqrt().clamp(_LEAST_NOISE, _MOST_NOISE))

    def _taken(self, some: Tensor) -> Tensor:
        """Mean degrees of freedom that the points take up in some frames, while they have their way."""
        rows = rows_of((self.points - self.shift)[some], self.every[some], _FIRST_NOISE)
        fit = PointRows(self.model, self._rest_of(some), rows, smooth=None)
        return fit.taken(self.pose.part(some)).mean()

    def _correct(self) -> None:
        """What twist joints and correctives do to the points, beside plain skinning."""
        layer, places = self.model.layer, self.model.places

        def correct(one: _Chunk) -> None:
            plain = self._misses(one) + one.points
            scale = self.bone_scale
            posed = layer.pose(
                part_of(self.identity, one.frames), self._rotations(one.pose, one.frames),
                one.pose.translation,
                bone_scale=scale if scale is None or len(scale) == 1 else scale[one.frames],
            )  # fmt: skip
            self.shift[one.frames] = places(posed.transforms, posed.vertices[:, places.vertex_ids]) - plain

        self._each(correct)
        self.targets = {}

    def _told(self) -> tuple[Tensor, Tensor, Tensor]:
        """What points miss (F, P) [m]; standard deviations [degrees] and rotations of the rig's joints."""
        model, count = self.model, len(self.points)
        noise = max(self.noise, _LEAST_CLAIM)
        moments_of, error = self._moments(noise), self.points.new_empty(self.points.shape[:2])
        std = model.spread[1:].repeat(count, 1)
        rotations = std.new_empty(count, *model.still.shape)

        def tell(one: _Chunk) -> None:
            error[one.frames] = self._misses(one).square().sum(-1).sqrt()
            variance = model.variances(moments_of(one), one.pose)
            std[one.frames, model.kept[1:] - 1] = (noise * variance.clamp_min(0).sqrt()).rad2deg()
            self._rotations(one.pose, one.frames, rotations[one.frames])

        self._each(tell)
        return error, std, rotations

    def result(self, known: Tensor) -> PointResult:
        """What the pose is worth; `known` (F, P) tells which points are."""
        valid = self.valid
        error, std, rotations = self._told()
        mass = self.every.sum(1).clamp_min(1e-12)
        residual = ((self.every * error.square()).sum(1) / mass).sqrt()
        posed = valid | self.bridged
        rotations[~posed] = torch.eye(3).to(error)
        return PointResult(
            rotations=rotations,
            translation=torch.where(posed[:, None], self.pose.translation + self.origin, 0.0),
            vertex_error=error.masked_fill(~(known & valid[:, None]), torch.nan),
            valid=valid,
            determined=determined(std, self.model) & valid[:, None],
            converged=(self.pose.last_change < 5 * _STILL * max(self.noise, _FIRST_NOISE)) & valid,
            iterations=self.pose.accepted,
            residual=residual.masked_fill(~valid, torch.nan),
            angle_std=std.masked_fill(~valid[:, None], torch.nan),
            noise=self.noise,
            plain=torch.zeros_like(valid),
        )


def paces(model: PointModel, fps: float) -> Tensor:
    """Usual second differences (n + 1,) of the variables' turns [rad] and of the Hips [m]."""
    return torch.cat((model.pace[model.solver.variables], model.pace.new_tensor([_HIPS_PACE]))) / fps**2


def _share(fps: float) -> float:
    """What one frame of a motion adds to what is known of joints, beside a frame of its own."""
    return min(1.0, 1.0 / (_LASTING * fps))


def trusted(misses: Tensor, noise: float) -> Tensor:
    """Shares of the weights of points that miss by so much: one but for those that are none of the body."""
    return (_OUTLYING * noise / misses.clamp_min(1e-12)).clamp_max(1.0) ** 4


def determined(std: Tensor, model: PointModel) -> Tensor:
    """Whether angles (F, J - 1) [degrees] are told by the points, rather than by what is expected."""
    return std < _SURE * model.spread[1:]
