"""What the stages of pose inversion share: the problem of a chunk of frames, and a pose under way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.priors import JointTerms, TwistDoubt
from soma_core.skeleton.identity import Identity

__all__ = ["Activity", "Pose", "Problem", "View", "bridged", "part_of"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """A chunk of frames to fit.

    Attributes:
        vertices: targets on the canonical topology, (F, v, 3) [m], finite.
        weights: vertex weights, (1 or F, v).
        identity: batch of 1, shared by all frames, or of F.
        rest: moments of the identity under the weights.
        target: ``R`` (F, T, 3, 4) of the targets, about `origin`.
        origin: (F, 3) [m]; poses under way are relative to it.
        bone_scale: factors (1 or F, J - 1) of the bone vectors, already in ``rest.offsets``; None without.
        terms: soft terms and hinges; None without.
        doubt: of the joints' twists; None without.
    """

    vertices: Tensor
    weights: Tensor
    identity: Identity
    rest: RestMoments
    target: Tensor
    origin: Tensor
    bone_scale: Tensor | None = None
    terms: JointTerms | None = None
    doubt: TwistDoubt | None = None

    def several(self, rows: Tensor) -> Tensor:
        """The rows; a single one twice where frames have bodies of their own: one alone is treated apart."""
        return rows.repeat(2) if len(rows) == 1 and self.rest.batch_size > 1 else rows

    def part(self, rows: Tensor) -> Problem:
        """The problem of some of its frames."""
        count = len(self.vertices)

        def own(value: Any) -> Any:
            return value[rows] if isinstance(value, Tensor) and len(value) == count > 1 else value

        rest, identity, terms = self.rest, part_of(self.identity, rows), self.terms
        if rest.batch_size > 1:
            driven = rest.driven
            if driven is not None:
                driven = replace(driven, **{name: own(value) for name, value in vars(driven).items()})
            parts = {name: own(value) for name, value in vars(rest).items() if name != "driven"}
            rest = replace(rest, **parts, driven=driven)
        elif len(rest.offsets) > 1:
            rest = replace(rest, offsets=own(rest.offsets))
        if terms is not None:
            terms = replace(terms, reference=own(terms.reference))
        return replace(
            self, vertices=self.vertices[rows], weights=own(self.weights), identity=identity, rest=rest,
            target=self.target[rows], origin=self.origin[rows], bone_scale=own(self.bone_scale), terms=terms,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """A pose under way.

    Attributes:
        relative: T-pose-relative rotations, the root's included, (F, J, 3, 3).
        translation: Hips position about the problem's origin, (F, 3) [m].
        accepted: number of steps taken, (F,).
        last_change: how much the last step changed the energy, whether it was taken or not, as a root mean
            square over the vertices' weights, (F,) [m]. Infinite before any step.
    """

    relative: Tensor
    translation: Tensor
    accepted: Tensor
    last_change: Tensor

    def part(self, rows: Tensor) -> Pose:
        """Poses of some frames."""
        return Pose(**{name: value[rows] for name, value in vars(self).items()})

    def put(self, rows: Tensor, part: Pose) -> Pose:
        """These poses with those of some frames replaced."""
        old = vars(self)
        return Pose(**{name: old[name].index_copy(0, rows, value) for name, value in vars(part).items()})

    @classmethod
    def begin(cls, relative: Tensor, translation: Tensor) -> Pose:
        """A pose before any step."""
        count, device = len(relative), relative.device
        return cls(
            relative=relative,
            translation=translation,
            accepted=torch.zeros(count, dtype=torch.int64, device=device),
            last_change=torch.full((count,), torch.inf, dtype=relative.dtype, device=device),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Activity:
    """Activations of poses.

    Attributes:
        value: (F, C).
        before: what goes into each activation, (F, C); None where that is its value.
        slope: derivative (F, C) by it; None likewise.
    """

    value: Tensor
    before: Tensor | None = None
    slope: Tensor | None = None

    @property
    def rising(self) -> Tensor:
        """The slopes, of ones where activations are what goes into them."""
        return torch.ones_like(self.value) if self.slope is None else self.slope


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A pose under the whole model.

    Attributes:
        energy: (F,) [m^2].
        slope: half its derivative (F, n + 1, 3) by turns in world axes, and by the translation.
        residual: ``P`` (F, T, 3, 4), moments of what is left; None where no longer asked for.
        pull: half the derivative (F, C) by the activations; None likewise, and without offsets.
        turns, places: of all joints, (F, J, 3, 3) and (F, J, 3).
        activity: of the offsets; None without.
    """

    energy: Tensor
    slope: Tensor
    residual: Tensor | None
    pull: Tensor | None
    turns: Tensor
    places: Tensor
    activity: Activity | None


def bridged(pose: Pose, known: Tensor) -> Pose:
    """A pose in the world; frames that are not `known` (F,) between those before and after them."""
    good = torch.nonzero(known).flatten()
    if len(good) in (0, len(known)):
        return pose
    at = torch.arange(len(known), device=good.device)
    after = torch.searchsorted(good, at).clamp(max=len(good) - 1)
    first, last = good[(after - (good[after] > at).long()).clamp_min(0)], good[after]
    share = ((at - first) / (last - first).clamp_min(1)).clamp(0, 1).to(pose.translation)
    turn = matrix_to_axis_angle(pose.relative[last] @ pose.relative[first].mT)
    relative = axis_angle_to_matrix(share[:, None, None] * turn) @ pose.relative[first]
    hips = torch.lerp(pose.translation[first], pose.translation[last], share[:, None])
    return replace(pose, relative=relative, translation=hips)


def part_of(identity: Identity, chunk: slice | Tensor) -> Identity:
    """The identities of a chunk of frames; one identity serves every chunk."""
    if identity.batch_size == 1:
        return identity
    return replace(
        identity,
        rest=identity.rest[chunk],
        bind_world=identity.bind_world[chunk],
        fitted_rest=identity.fitted_rest[chunk],
        fitted_world=identity.fitted_world[chunk],
        params={name: value[chunk] for name, value in identity.params.items()},
    )
