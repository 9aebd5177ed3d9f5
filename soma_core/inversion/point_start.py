"""Where a fit to points begins: bone after bone from the root, each turned to the points nearest below it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.inversion.point_model import PointModel, PointRest
from soma_core.inversion.problem import Pose

__all__ = ["PointStart"]

_FARTHER = 1e-3
"""What points behind a further joint that is itself seen count in the turn of a bone, beside the nearest."""

_EXPECTED = 0.02
"""Weight of the expected turn beside the points: decides the twist of a bone, and hardly its direction."""

_BEND = 0.5
"""Weight of the axis that a hinge bends about, beside the bone that leads to it."""

_MEASURED = 128
"""Frames whose size is told."""

_SLIGHT = 0.4
"""Sine of a bend that may be noise."""


class PointStart(torch.nn.Module):
    """Turns every joint by the points below it, from the root to the leaves.

    Args:
        model: the points on the rig.
        hinges: joint -> axis about which it bends the limb, in the axes of the world at T-pose.
        warp: nearest rotations by the Warp twin.
    """

    def __init__(self, model: PointModel, hinges: dict[int, np.ndarray], *, warp: bool) -> None:
        super().__init__()
        self.model, self.warp = model, warp
        self.centres = _centres(model)
        kept, parents = model.kept.tolist(), model.structure.parents
        self.centre = centre = self.centres[kept]
        axes = {place: hinges[joint] for place, joint in enumerate(kept) if joint in hinges}
        self.owner = owner = _owner(model)
        above = model.structure.ancestors
        self.steps: list[tuple[int, int, np.ndarray, tuple[int, np.ndarray] | None]] = []
        for joint in model.variables:
            below = np.flatnonzero(above[joint, owner])
            weight = np.zeros(len(owner))
            for point in below:
                step, seen = int(owner[point]), 0
                while step != joint:
                    seen += centre[step] >= 0
                    step = int(parents[step])
                weight[point] = _FARTHER**seen
            if joint > 1 and centre[joint] >= 0:
                weight[centre[joint]] = 0
            hinge = next(((j, axes[j]) for j in axes if parents[j] == joint and centre[j] >= 0), None)
            self.steps.append((int(joint), int(parents[joint]), weight, hinge))
        axes = np.array([np.zeros(3) if hinge is None else hinge[1] for *_, hinge in self.steps])
        keep = {"plan": self._planned(len(owner)), "axes": torch.tensor(axes).to(model.mean)}
        keep["at"] = torch.tensor([entry[:2] for entry in self.entries])
        keep["share"] = torch.tensor([entry[2] for entry in self.entries]).to(model.mean)
        for name, value in keep.items():
            self.register_buffer(name, value.to(model.mean.device), persistent=False)

    def _planned(self, count: int) -> Tensor:
        """Lists of the kernel, int32, as ``kernels.point_start_wp`` reads them."""
        slot = {joint: place + 1 for place, (joint, *_) in enumerate(self.steps)}
        own = {joint: weight for joint, _, weight, _ in self.steps}
        steps, entries = [], []
        for joint, above, weight, hinge in self.steps:
            near, bent = np.flatnonzero(weight >= _FARTHER), hinge is not None and joint > 1
            end = np.flatnonzero(own.get(hinge[0], np.zeros(0))) if bent else near[:0]
            middle = self.centre[hinge[0]] if len(end) else -1
            first, stop = len(entries), len(entries) + len(near)
            steps.append(
                [slot.get(above, 0), first, stop, self.centre[joint], middle, stop, stop + len(end), joint]
            )
            entries += [(joint, point, weight[point]) for point in near]
            entries += [(joint, point, own[hinge[0]][point]) for point in end]
        self.entries = entries
        plan = [count, len(steps), *np.ravel(steps), *(point for _, point, _ in entries)]
        return torch.tensor(np.array(plan, np.int32))

    def _by_warp(
        self, rest: PointRest, points: Tensor, weights: Tensor, at_rest: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Rotations (F, K, 3, 3) and Hips positions (F, 3) of one identity."""
        from soma_core.kernels.point_start_wp import begun

        model, joints = self.model, self.model.solver.variables
        at = self.at
        own = torch.cat((model.mean[joints].flatten(1), rest.offsets[0, joints], self.axes), 1)
        arms = torch.cat((self.share[:, None], at_rest[0, at[:, 0], at[:, 1]]), 1)
        numbers = torch.cat(
            (points.new_tensor([_EXPECTED, _BEND, _SLIGHT, 0.0]), own.flatten(), arms.flatten())
        )
        relative = model.mean.repeat(len(points), 1, 1, 1)
        return relative, begun(self.plan, numbers, points, weights, relative)

    def forward(
        self, rest: PointRest, points: Tensor, weights: Tensor, at_rest: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Rotations (F, K, 3, 3) and Hips positions (F, 3) [m] of some frames.

        Args:
            rest: of one identity, or of one a frame.
            points: targets (F, P, 3) [m], finite.
            weights: (1 or F, P), 0 for points that are not known.
            at_rest: of :meth:`expected`, where it is known.
        """
        at_rest = self.expected(rest) if at_rest is None else at_rest
        few = self.warp and len(rest.local) == 1 == len(rest.offsets)
        turned = self._by_warp if few else self._by_torch
        return turned(rest, points, weights.expand(len(points), -1), at_rest)

    def sizes(
        self, rest: PointRest, points: Tensor, weights: Tensor, at_rest: Tensor | None = None
    ) -> Tensor:
        """Sizes (f,) beside the bodies, of some of the frames; arguments are those of :meth:`forward`."""
        some = slice(None, None, max(1, len(points) // _MEASURED))
        if len(rest.local) > 1:
            rest = PointRest(local=rest.local[some], offsets=rest.offsets[some])
        at_rest = self.expected(rest) if at_rest is None else at_rest
        return self._scale(points[some], weights.expand(len(points), -1)[some], at_rest)

    def _by_torch(
        self, rest: PointRest, points: Tensor, weights: Tensor, at_rest: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Rotations (F, K, 3, 3) and Hips positions (F, 3)."""
        model, count = self.model, len(points)
        mean = model.mean
        turns = torch.eye(3, dtype=points.dtype, device=points.device).repeat(
            count, model.solver.joint_count, 1, 1
        )
        places = points.new_zeros(count, model.solver.joint_count, 3)
        hips = points.new_zeros(count, 3)
        for joint, above, own, hinge in self.steps:
            expected = turns[:, above] @ mean[joint]
            near = np.flatnonzero(own >= _FARTHER)  # what lies behind two joints that are seen tells nothing
            weight, seen_points = weights[:, near] * points.new_tensor(own[near]), points[:, near]
            arms = at_rest[:, joint, near]  # (i, p, 3) in the joint's axes
            if joint == 1:
                total = weight.sum(1, keepdim=True).clamp_min(1e-12)
                middle = (weight[..., None] * seen_points).sum(1) / total
                inner = (weight[..., None] * arms).sum(1) / total
                aims = seen_points - middle[:, None]
                turns[:, 1] = self._turn(weight, aims, arms - inner[:, None], expected, None)
                hips = middle - (turns[:, 1] @ inner[..., None]).squeeze(-1)
                places[:, 1] = hips
                continue
            place = places[:, above] + (turns[:, above] @ rest.offsets[:, joint, :, None]).squeeze(-1)
            if self.centre[joint] >= 0:
                seen = weights[:, self.centre[joint], None] > 0
                place = torch.where(seen, points[:, self.centre[joint]], place)
            places[:, joint] = place
            aims = seen_points - place[:, None]
            turns[:, joint] = turn = self._turn(weight, aims, arms, expected, None)
            if hinge is not None:
                bend = self._bend(hinge, points, weights, place, turn)
                turns[:, joint] = self._turn(weight, aims, arms, expected, bend)
        variables = model.solver.variables
        relative = mean.repeat(count, 1, 1, 1)
        relative[:, variables] = turns[:, model.parents[variables]].mT @ turns[:, variables]
        return relative, hips

    def _scale(self, points: Tensor, weights: Tensor, at_rest: Tensor) -> Tensor:
        """Median (f,) over the bones of how far points lie from their joint, beside how far they should.

        Bones between a joint that is seen and the nearest points below it; the whole cloud without such.
        """
        known = np.flatnonzero([self.centre[joint] >= 0 for joint, *_ in self.steps])
        if not len(known):
            return points.new_ones(len(points))
        joints, near = zip(
            *((joint, own == 1) for joint, _, own, _ in (self.steps[k] for k in known)), strict=True
        )
        centre = self.centre[list(joints)]
        weight = weights[:, None] * points.new_tensor(np.stack(near)) * (weights[:, centre, None] > 0)
        away = (points[:, None] - points[:, centre, None]).square().sum(-1).sqrt()  # (f, joints, P)
        total = (weight * at_rest[:, list(joints)].norm(dim=-1)).sum(2)
        ratio = (weight * away).sum(2) / total
        return torch.where(total > 0, ratio, torch.nan).nanmedian(1).values

    def _turn(self, weight: Tensor, aims: Tensor, arms: Tensor, expected: Tensor, bend) -> Tensor:
        """Turn (F, 3, 3) of arms (i, P, 3) towards aims (F, P, 3)."""
        covariance = (weight[..., None] * aims).mT @ arms
        size = (weight * aims.norm(dim=-1) * arms.norm(dim=-1)).sum(1)
        if bend is not None:
            normal, axis = bend
            share = _BEND * size[:, None, None]
            covariance = covariance + share * normal[..., :, None] * axis
        covariance = covariance + (_EXPECTED * size + 1e-12)[:, None, None] * expected
        return self._nearest(covariance)

    def _bend(
        self, hinge: tuple[int, np.ndarray], points: Tensor, weights: Tensor, place: Tensor, turn: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Normal (F, 3) of a bent limb, as long as the sine of its bend, and the axis (3,) that it lies on.

        A slight bend to the wrong side of a limb turned by `turn` (F, 3, 3) is noise, and none.
        """
        joint, axis = hinge
        middle = self.centre[joint]
        own = next((weight for j, _, weight, _ in self.steps if j == joint), None)
        if own is None:
            return torch.zeros_like(place), points.new_tensor(axis)
        weight = weights * points.new_tensor(own)
        total = weight.sum(1, keepdim=True)
        end = (weight[..., None] * points).sum(1) / total.clamp_min(1e-12)
        first, second = points[:, middle] - place, end - points[:, middle]
        unit = torch.nn.functional.normalize
        normal = torch.linalg.cross(unit(first, dim=-1), unit(second, dim=-1), dim=-1)
        seen = (weights[:, middle] > 0) & (total.squeeze(1) > 0)
        wrong = (normal * (turn @ points.new_tensor(axis))).sum(-1) < 0
        seen = seen & ~(wrong & (normal.norm(dim=-1) < _SLIGHT))
        return normal * seen[:, None], points.new_tensor(axis)

    def expected(self, rest: PointRest) -> Tensor:
        """Points (i, K, P, 3) about each joint in its own axes, where all joints are as expected."""
        model = self.model
        count = len(rest.local)
        relative = model.mean.expand(count, -1, 3, 3)
        pose = Pose.begin(relative, rest.offsets.new_zeros(count, 3))
        turns, places = model.solver.walk_public(pose, rest.offsets)
        points = model.points(rest, turns, places)
        away = points[:, None] - places[:, :, None]
        return (turns[:, :, None].mT @ away[..., None]).squeeze(-1)

    def _nearest(self, covariance: Tensor) -> Tensor:
        if not self.warp:
            return rotation_from_covariance(covariance)
        from soma_core.kernels.nearest_rotation_wp import nearest_rotation

        return nearest_rotation(covariance)


def _owner(model: PointModel) -> np.ndarray:
    """(P,) the joint that carries most of each point."""
    local = model.rest(model.layer.identity()).local[0].double().cpu().numpy()
    return model.joints[np.abs(local[..., 3]).argmax(1)]


def _centres(model: PointModel) -> np.ndarray:
    """(J,) the point that is the centre of each joint of the rig; -1 where none is."""
    body, parents, kept = model.layer.identity(), model.layer.rig.parents, model.kept.cpu().numpy()
    local = model.rest(body).local[0].double().cpu().numpy()  # (P, T, 4)
    bones = model.layer.animation.bone_vectors(body)[0].double().cpu().numpy()
    owner, joints = kept[_owner(model)], kept[model.joints]
    centre = np.full(len(parents), -1)
    for joint in range(1, len(parents)):
        above = max(int(parents[joint]), 1)
        own = np.flatnonzero(owner == above)
        place = bones[joint] * (joint > 1)
        rows = local[own, np.searchsorted(joints, above)][:, :3] if len(own) else np.zeros((0, 3))
        away = np.linalg.norm(rows - place, axis=1)
        if len(own) and away.min() < 1e-4:  # exactly the centre: what else a body has, is not
            centre[joint] = own[away.argmin()]
    return centre
