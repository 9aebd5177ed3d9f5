"""Upper arms and thighs: where their fit begins, and how their twist is shared with the forearm or shin.

Twist joints carry all skin of an upper arm or a thigh. They undo the twist of the bone itself at its upper
end and take on that of the next bone at its lower end. So a turn of the upper arm about its own axis, undone
at the elbow, leaves a straight arm's skin where it is: only what correctives add tells it, by little and not
by a parabola. The start therefore reads the twist along the bone from the clouds of the helpers, and a search
looks at every share of it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.constants import constant
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_quaternion, skew
from soma_core.inversion.driven import DrivenJoints, half_angle
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.offsets import PoseOffsets
from soma_core.inversion.priors import TwistDoubt
from soma_core.inversion.problem import Pose, Problem, View
from soma_core.rig.skeleton import Rig

if TYPE_CHECKING:
    from soma_core.kernels.pose_solver_wp import PoseSolver
    from soma_core.kernels.twist_share_wp import LimbTables

__all__ = ["Limb", "LimbStart", "TwistShare"]

_INNER = (0.2, 0.8)
"""Helpers whose share of the end's twist lies between these: their skin hardly blends with other bones."""

_MARGIN = 0.05
"""Distance kept from half a turn, where a twist angle jumps [rad]."""

_CLEAR = 0.08
"""Cosine of half a joint's angle that a search keeps: twists jump at zero, and no step leads across."""

_DEAR = 5e-4
"""What it costs a share to come closer, as a root mean square error [m]."""

_SHARES, _SHARES_NEAR = 25, 9
"""Shares looked at, evenly over a whole turn, and of these those about what a search found before."""

_IN_CACHE = 32
"""Frames whose activations at every share stay in a processor's cache."""


class LimbStart(torch.nn.Module):
    """Turns of the joints that helpers hang on, from the clouds of the helpers.

    Args:
        rig: the public joints, with `procedural`.
        driven: its helpers.
        joints: (T,) weighted joints, helpers among them.
    """

    def __init__(self, rig: Rig, driven: DrivenJoints, joints: np.ndarray) -> None:
        super().__init__()
        assert rig.procedural is not None
        names = (*rig.joint_names, *rig.procedural.joint_names)
        row = {int(joint): index for index, joint in enumerate(joints)}
        mix = driven.mix.double().cpu().numpy()
        channel = driven.joint.tolist()
        starts, halves, clouds, shares, axes = [], [], [], [], []
        for segment in rig.procedural.definition.segments:
            own, end = names.index(segment.start), names.index(segment.end)
            helpers = [names.index(name) for name in segment.helpers]
            if len(helpers) < 2 or end not in channel or not all(helper in row for helper in helpers):
                continue
            share = mix[[helper - rig.joint_count for helper in helpers], channel.index(end)]
            if np.ptp(share) < 0.1:
                continue
            starts.append(own)
            halves.append(0.5 if segment.reverse else 0.0)
            clouds.append([row[helper] for helper in helpers])
            shares.append(share.tolist())
            axes.append(driven.spin_axis[helpers[0] - rig.joint_count].double().cpu().numpy())
        width = max(map(len, clouds), default=0)
        padded = [one + [one[-1]] * (width - len(one)) for one in clouds]
        counted = np.array([[k < len(one) for k in range(width)] for one in clouds])
        share = np.array([one + [one[-1]] * (width - len(one)) for one in shares])
        inner = counted & (share > _INNER[0]) & (share < _INNER[1])
        inner = np.where(inner.any(1, keepdims=True), inner, counted)
        centred = np.where(
            counted, share - (share * counted).sum(1, keepdims=True) / counted.sum(1, keepdims=True), 0
        )
        kind = driven.mix

        keep = functools.partial(constant, device=kind.device, dtype=kind.dtype)
        self.starts = keep(np.array(starts, np.int64))
        self.clouds = keep(np.array(padded, np.int64).reshape(len(starts), width))
        self.inner = keep(inner.astype(np.float64).reshape(len(starts), width))
        self.centre = keep(np.array(halves, np.float64))
        self.share = keep(share.reshape(len(starts), width))
        slope = centred / (centred**2).sum(1, keepdims=True).clip(1e-12) if len(starts) else centred
        self.regress = keep(slope)
        self.axis = keep(np.array(axes).reshape(-1, 3))

    def forward(self, turns: Tensor, mass: Tensor) -> Tensor:
        """World turns (F, L, 3, 3) of the joints `starts`.

        Args:
            turns: of each weighted joint's own cloud, (F, T, 3, 3).
            mass: of the clouds, (1 or F, T).
        """
        own = turns[:, self.clouds]
        steps = half_angle(own[:, :, :-1].mT @ own[:, :, 1:], self.axis[:, None])[0].cumsum(-1)
        along = torch.nn.functional.pad(steps, (1, 0))
        most = math.pi * (1 + 2 * self.centre) - _MARGIN
        total = (along * self.regress).sum(-1)
        total = torch.maximum(torch.minimum(total, most), -most)
        spin = (self.share - self.centre[:, None]) * total[..., None]
        back = axis_angle_to_matrix(-spin[..., None] * self.axis[:, None])
        weight = self.inner * mass[:, self.clouds]
        return rotation_from_covariance((weight[..., None, None] * (own @ back)).sum(2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Limb:
    """One limb whose twist can be shared in many ways.

    Attributes:
        own, end: the joint that helpers undo, and the next.
        channels: of the two.
        helpers: (h,) positions among the helpers.
        clouds: (h,) positions of the helpers among the weighted joints.
        pairs: (q,) pairs of these that share vertices, and `first`, `second` (q,) positions in `clouds`.
        axis: (3,) of the bone.
        ids: (c,) activations that see either joint; `by_own`, `by_end` (c, S) how; `shapes` (c, r) such that
            products of their shapes are those of its rows.
    """

    own: int
    end: int
    channels: tuple[int, int]
    helpers: Tensor
    clouds: Tensor
    pairs: Tensor
    first: Tensor
    second: Tensor
    axis: Tensor
    ids: Tensor
    by_own: Tensor
    by_end: Tensor
    shapes: Tensor


class TwistShare:
    """Searches how the twist of a limb is shared between the bone that helpers undo and the next one.

    Args:
        rig: the public joints, with `procedural`.
        driven: its helpers.
        offsets: what tells the share.
        joints: (T,) weighted joints, helpers among them.
        pairs: (p, 2) of them that share vertices.
    """

    def __init__(
        self,
        rig: Rig,
        driven: DrivenJoints,
        offsets: PoseOffsets,
        joints: np.ndarray,
        pairs: np.ndarray,
    ) -> None:
        assert rig.procedural is not None
        self.driven, self.offsets = driven, offsets
        self._tables: LimbTables | None = None  # made when first asked for
        names = (*rig.joint_names, *rig.procedural.joint_names)
        channel, row = driven.joint.tolist(), {int(joint): index for index, joint in enumerate(joints)}
        device = driven.mix.device
        self.limbs: list[Limb] = []
        for segment in rig.procedural.definition.segments:
            own, end = names.index(segment.start), names.index(segment.end)
            helpers = np.array([names.index(name) for name in segment.helpers])
            known = own in channel and end in channel and all(int(helper) in row for helper in helpers)
            if not (segment.reverse and known and rig.parents[end] == own and driven.turning):
                continue
            clouds = np.array([row[int(helper)] for helper in helpers])
            both = np.flatnonzero(np.isin(pairs, clouds).all(1))
            first, second = (np.searchsorted(clouds, pairs[both, side]) for side in (0, 1))
            index = {"helpers": helpers - rig.joint_count, "clouds": clouds, "pairs": both, "first": first,
                     "second": second}  # fmt: skip
            self.limbs.append(
                Limb(
                    own=own, end=end, channels=(channel.index(own), channel.index(end)),
                    axis=driven.spin_axis[int(helpers[0]) - rig.joint_count],
                    **{name: torch.as_tensor(array, device=device) for name, array in index.items()},
                    **offsets.seen_by(own, end),
                )
            )  # fmt: skip

    def __call__(
        self,
        pose: Pose,
        view: View,
        problem: Problem,
        scale: Tensor,
        variables: Tensor,
        held: Collection[int] = (),
        *,
        near: bool = False,
        steps: PoseSolver | None = None,
        constants: tuple[Tensor, bool] | None = None,
    ) -> Pose:
        """The pose with the best share of every limb, as far as moments tell.

        Args:
            pose, view: where to look from.
            problem: whose moments and doubt of twists count.
            scale: (F,) size of the bodies.
            variables: (n,) joints that may turn.
            held: joints that cannot turn so; limbs with such stay as they are.
            near: look only about what the pose has.
            steps, constants: kernels of the model, and what they take of the identities; None without.
        """
        rest, doubt = problem.rest, problem.doubt
        angle = torch.linspace(-math.pi, math.pi, _SHARES).to(pose.relative)
        if near:
            angle = angle[(_SHARES - _SHARES_NEAR) // 2 :][:_SHARES_NEAR]
        terms, ends = problem.terms, {limb.end for limb in self.limbs}
        pulled = ends.intersection(() if terms is None else terms.pulled(variables))
        if steps is not None and constants is not None and view.activity is not None and not pulled:
            doubts = self._limb_doubts(doubt, variables)
            return self._by_warp(pose, view, rest, scale, angle, doubts, held, steps, constants)
        relative = pose.relative.clone()
        for limb in self.free(held):
            energy = self._skin(limb, angle, view, rest) + self._moves(
                limb, angle, pose.relative, view, scale
            )
            turned = axis_angle_to_matrix(-angle[:, None] * limb.axis) @ pose.relative[:, limb.end, None]
            if doubt is not None:
                change = self._doubts(limb, turned, pose.relative, doubt, variables)
                energy = energy + view.energy[:, None] * change
            if terms is not None and limb.end in pulled:
                mass = rest.own[..., 3, 3].sum(1)[:, None]
                energy = energy + mass * terms.single(variables == limb.end, turned)
            self.turn(relative, limb, _lowest(angle, energy))
        return replace(pose, relative=relative)

    def _by_warp(
        self, pose: Pose, view: View, rest: RestMoments, scale: Tensor, angle: Tensor, doubts: Tensor,
        held: Collection[int], steps: PoseSolver, constants: tuple[Tensor, bool],
    ) -> Pose:  # fmt: skip
        from soma_core.kernels.twist_share_wp import limb_tables, shared_twists

        offsets, driven, activity = self.offsets, self.driven, view.activity
        assert activity is not None
        assert activity.before is not None
        assert view.pull is not None
        assert view.residual is not None
        if self._tables is None:
            features = offsets.left, offsets.right[..., : offsets.columns]
            room = steps.counts["response_size"]
            self._tables = limb_tables(self.limbs, driven.mix, driven.public_count, features, room, _SHARES)
        free = self.free(held)
        mass = rest.own[..., 3, 3].sum(1).expand(len(scale))
        frames = (pose.relative, pose.translation, view.residual, activity.before, view.pull, view.energy,
                  scale, mass)  # fmt: skip
        relative = shared_twists(
            steps, constants, self._tables, angle, doubts,
            sum(1 << place for place, limb in enumerate(self.limbs) if limb not in free), frames,
            dear=_DEAR, least=_CLEAR,
        )  # fmt: skip
        return replace(pose, relative=relative)

    def _limb_doubts(self, doubt: TwistDoubt | None, variables: Tensor) -> Tensor:
        """Axis and square (L, 4) of the doubt of each limb's next joint."""
        doubts = variables.new_zeros(len(self.limbs), 4, dtype=self.driven.mix.dtype)
        if doubt is not None:
            ends = variables.new_tensor([limb.end for limb in self.limbs])
            limb, which = torch.nonzero(variables[doubt.variable] == ends[:, None], as_tuple=True)
            doubts[limb] = torch.cat((doubt.axis, doubt.square[:, None]), 1)[which]
        return doubts

    def free(self, held: Collection[int]) -> list[Limb]:
        """Limbs neither of whose joints is held."""
        return [limb for limb in self.limbs if limb.own not in held and limb.end not in held]

    def turn(self, relative: Tensor, limb: Limb, angle: Tensor) -> None:
        """Turn a limb's bone about its axis by `angle` (F,), in place; the next joint's world turn stays."""
        turn = axis_angle_to_matrix(angle[:, None] * limb.axis)
        relative[:, limb.own] = relative[:, limb.own] @ turn
        relative[:, limb.end] = turn.mT @ relative[:, limb.end]

    def _skin(self, limb: Limb, angle: Tensor, view: View, rest: RestMoments) -> Tensor:
        """Change (F, a) of the error by what the helpers do when the bone turns by each `angle` (a,).

        Helpers lie on the bone, so that each turns in place by one angle, and the error is a polynomial in
        its sine and cosine.
        """
        assert view.residual is not None
        mix = self.driven.mix[limb.helpers][:, list(limb.channels)].T
        twists, clear = self._twists(limb, torch.cat((angle, angle[:1] * 0)), view, rest)  # (F, a + 1, 2)
        spin = (twists[:, :-1] - twists[:, -1:]) @ mix + angle[:, None]  # (F, a, h)
        across = skew(limb.axis)
        turns = view.turns[:, self.driven.public_count + limb.helpers]
        basis = torch.stack((turns @ across, turns @ (across @ across)), 2)  # (F, h, 2, 3, 3)
        part = torch.stack((torch.sin(spin), 1 - torch.cos(spin)), -1)  # (F, a, h, 2)
        pulled = (basis * view.residual[:, limb.clouds, None, :, :3]).sum((-2, -1))  # (F, h, 2)
        first, second = basis[:, limb.first], basis[:, limb.second]
        moved = first @ rest.second[:, limb.pairs, None, :3, :3]
        product = torch.einsum("fqxab,fqyab->fqxy", moved, second)
        product = product * torch.where(limb.first == limb.second, 1.0, 2.0).to(product)[:, None, None]
        square = product.new_zeros(len(product), *(2 * [len(limb.helpers)]), 2, 2)
        square[:, limb.first, limb.second] = product
        square, part = square.transpose(2, 3).flatten(3, 4).flatten(1, 2), part.flatten(2)
        energy = (part * (part @ square + 2 * pulled.flatten(1)[:, None])).sum(-1)
        jumping = (clear[:, :-1] < _CLEAR).any(-1)
        return energy + jumping * (_DEAR**2 * rest.own[..., 3, 3].sum(1))[:, None]

    def _doubts(
        self, limb: Limb, turned: Tensor, relative: Tensor, doubt: TwistDoubt, variables: Tensor
    ) -> Tensor:
        """Change (F, a) of the doubt of the next joint's twist at its rotations (F, a, 3, 3)."""
        which = torch.nonzero(variables[doubt.variable] == limb.end).flatten()[:1]
        if not len(which):
            return relative.new_zeros(turned.shape[:2])
        one = replace(doubt, variable=which * 0, axis=doubt.axis[which], square=doubt.square[which])
        still = one.share(relative[:, limb.end, None])
        return one.share(turned.flatten(0, 1)[:, None]).view(turned.shape[:2]) - still[:, None]

    def _twists(self, limb: Limb, angle: Tensor, view: View, rest: RestMoments) -> tuple[Tensor, Tensor]:
        """Twists (F, a, 2) of the bone and of the next one when the bone turns by each `angle` (a,).

        Beside them, how far each joint is from half a turn, as the cosine of half its angle.
        """
        driven, given = self.driven, rest.driven
        assert given is not None
        own, end = limb.channels
        turn = view.turns[:, limb.own]
        half = 0.5 * angle[:, None]
        about = torch.cat((torch.cos(half), torch.sin(half) * limb.axis), -1)  # (a, 4)
        before = given.left[:, own].mT @ view.turns[:, driven.reference[own]].mT @ turn
        after = turn.mT @ view.turns[:, limb.end] @ given.right[:, end]
        conjugate = about * about.new_tensor([1.0, -1.0, -1.0, -1.0])
        read = (
            (matrix_to_quaternion(before), about, matrix_to_quaternion(given.right[:, own]), own),
            (matrix_to_quaternion(given.left[:, end].mT), conjugate, matrix_to_quaternion(after), end),
        )
        twists, cosines = [], []
        for left, between, right, channel in read:
            seen = _product(_product(left[:, None], between), right[:, None])
            seen = torch.where(seen[..., :1] < 0, -seen, seen)
            along = (seen[..., 1:] * given.axis[:, None, channel]).sum(-1)
            twists.append(4 * torch.atan(along / (1 + seen[..., 0])))
            cosines.append(seen[..., 0])
        return torch.stack(twists, -1), torch.stack(cosines, -1)

    def _moves(self, limb: Limb, angle: Tensor, relative: Tensor, view: View, scale: Tensor) -> Tensor:
        """Change (F, a) of the error by what the offsets do."""
        assert view.activity is not None
        assert view.activity.before is not None
        assert view.pull is not None
        turn = axis_angle_to_matrix(angle[:, None] * limb.axis)
        own = self.offsets.features(relative[:, limb.own, None] @ turn, limb.own)
        end = self.offsets.features(turn.mT @ relative[:, limb.end, None], limb.end)
        still = [self.offsets.features(relative[:, joint, None], joint) for joint in (limb.own, limb.end)]
        change = torch.cat((own - still[0], end - still[1]), -1)
        reads, squashed = torch.cat((limb.by_own, limb.by_end), 1).T, self.offsets.squashed
        given = change, view.activity.before[:, None, limb.ids], view.pull[:, None, limb.ids]
        squares, pulls = [], []
        size = len(change) if change.is_cuda else _IN_CACHE
        for seen, before, pull in zip(*(one.split(size) for one in given), strict=True):
            moved = squashed((seen @ reads).add_(before)).sub_(squashed(before))
            squares.append((moved @ limb.shapes).square().sum(-1))
            pulls.append((moved * pull).sum(-1))
        return 2 * torch.cat(pulls) + scale[:, None].square() * torch.cat(squares)


def _lowest(angle: Tensor, energy: Tensor) -> Tensor:
    """Angle (F,) of the least energy (F, a), between the evenly spaced `angle` (a,) by a parabola."""
    best = energy.argmin(1, keepdim=True)
    middle = best.clamp(1, len(angle) - 2)
    low, here, high = (energy.gather(1, middle + step).squeeze(1) for step in (-1, 0, 1))
    bend = low - 2 * here + high
    shift = torch.where(bend > 0, 0.5 * (low - high) / bend.where(bend > 0, torch.ones_like(bend)), 0.0)
    inside = torch.isfinite(shift) & (best == middle).squeeze(1)
    return angle[best.squeeze(1)] + torch.where(inside, shift.clamp(-0.5, 0.5), 0.0) * (angle[1] - angle[0])


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Products of quaternions (..., 4) in the order w, x, y, z."""
    a, u = first[..., :1], first[..., 1:]
    b, v = second[..., :1], second[..., 1:]
    u, v = torch.broadcast_tensors(u, v)
    real = a * b - (u * v).sum(-1, keepdim=True)
    return torch.cat((real, a * v + b * u + torch.linalg.cross(u, v, dim=-1)), -1)
