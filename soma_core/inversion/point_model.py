"""Points as one more cloud of the solver: their moments, and what is known of poses without them.

A point is a sum over joints of ``G_t b_t`` with ``G_t = [D_t | c_t]`` and fixed ``b_t`` (x, y, z, w), just as
a skinned vertex is, so that its squared error is quadratic in the transforms and the moments of
``moments.py`` hold it. A joint's own centre is a point of its parent, whatever the joint itself does. What is
known of a joint without points is of the same form: an axis a of the joint that is expected at M a in its
parent adds ``s |D a - D_parent M a|^2``, a cloud of directions, which have no place (w = 0).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.inversion.gauss_newton import HINGE_STIFFNESS, GaussNewton, damped_inverse
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.point_priors import JointPrior
from soma_core.inversion.problem import Pose
from soma_core.inversion.structure import MomentStructure, skin_structure
from soma_core.layer import SomaLayer
from soma_core.points.places import PointPlaces
from soma_core.skeleton.identity import Identity

__all__ = ["PointModel", "PointRest"]

_HELD = 5.0
"""Pull of turns that are held, as a prior has it [1/rad^2]."""

_LEAST_SKIN = 0.02
"""Smaller skin weights of a point are left out of the solver; its correction has them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointRest:
    """What a fit needs of identities; batch i is 1, shared by all frames, or one a frame.

    Attributes:
        local: ``b`` of every point at every weighted joint, (i, P, T, 4) [m].
        offsets: bone vectors of the kept joints in T-pose world axes, (i, K, 3) [m].
    """

    local: Tensor
    offsets: Tensor


class PointModel(torch.nn.Module):
    """Points on plain skinning of one rig, and the solver of its poses.

    A fit knows K joints, the root and those that points say anything about; their numbers here are among
    these. All others stay at rest.

    Args:
        layer: the forward model.
        places: the points.
        prior: what is known of each joint.
        warp: run the Warp twin of the solver.

    Attributes:
        solver: steps on moments.
        kept: (K,) numbers of the joints in the rig, ascending.
        joints: (T,) joints that carry points, or that a prior ties to these.
        variables: (n,) joints that points say anything about: all but the root.
        still: (J - 1, 3, 3) where the rig's joints are expected.
        spread: (J,) root mean square angle [degrees] that each joint of the rig is expected to be off by.
        mean: (K, 3, 3) where a pose is expected.
        pull: (K, 3, 3) how strongly it is, as ``JointPrior.of`` says [1/rad^2].
        hinged: (K,) whether a joint is a hinge.
        tells, follows: (K,) whose rest is a person's posture, as ``JointRange`` says.
        pace: (K,) usual angular accelerations [rad/s^2].
        prior: (p, 4, 4) moments of the prior, of the solver's pairs [1/rad^2].
    """

    prior: Tensor
    hold: Tensor
    kept: Tensor
    still: Tensor
    mean: Tensor
    pull: Tensor
    hinged: Tensor
    tells: Tensor
    follows: Tensor
    pace: Tensor
    spread: Tensor

    def __init__(self, layer: SomaLayer, places: PointPlaces, prior: JointPrior, *, warp: bool) -> None:
        super().__init__()
        kind = {"dtype": layer.dtype, "device": layer.device}
        self.layer, self.places = layer, places
        rig = layer.rig
        carried = self._influences(places, rig)
        parents = rig.parents.astype(np.int64)
        variables = _above(carried.any(0), parents)
        tied = np.array([j for j in variables if parents[j] > 0], np.int64)
        ties = np.zeros((len(tied), rig.joint_count))
        ties[np.arange(len(tied)), tied] = ties[np.arange(len(tied)), parents[tied]] = 1
        rows = scipy.sparse.csr_array(np.concatenate([carried.astype(float), ties]))
        whole = skin_structure(replace(rig, weights=rows, procedural=None), np.ones(rows.shape[0], bool))
        self.structure = structure = _alone(whole)
        self.solver = GaussNewton(structure, warp=warp, apart=True, **kind)
        self.joints, self.variables = structure.joints, structure.variables
        mean, blocks = prior.of(rig.joint_names)
        row = {int(joint): place for place, joint in enumerate(whole.joints)}
        pair = {tuple(one): place for place, one in enumerate(structure.pairs.tolist())}
        moments = np.zeros((len(structure.pairs), 4, 4))
        for joint in tied:
            own, above = row[int(joint)], row[int(parents[joint])]
            moved = np.einsum("ab,bc->ac", mean[joint], blocks[joint])
            moments[pair[own, own], :3, :3] += blocks[joint]
            moments[pair[above, above], :3, :3] += moved @ mean[joint].T
            assert above < own, "parents come before their children"
            moments[pair[above, own], :3, :3] -= moved
        kept = np.concatenate(([0], variables))
        hinged = np.isin(np.arange(rig.joint_count), list(prior.hinges(rig.joint_names)))
        each = {
            "mean": mean, "pull": blocks, "pace": prior.paces(rig.joint_names), "hinged": hinged,
            **prior.postures(rig.joint_names),
        }  # fmt: skip
        keep = {
            "prior": moments, "hold": _HELD * _hold(structure.pairs), "spread": _spread(blocks),
            "kept": kept, "still": mean[1:], "weighted": structure.joints,
            "parents": np.maximum(structure.parents, 0), **{key: of[kept] for key, of in each.items()},
        }  # fmt: skip
        for key, array in keep.items():
            tensor = torch.as_tensor(np.ascontiguousarray(array), device=layer.device)
            if tensor.dtype != torch.bool:
                tensor = tensor.to(layer.dtype) if tensor.is_floating_point() else tensor.long()
            self.register_buffer(key, tensor, persistent=False)
        self.first, self.second = (
            torch.as_tensor(side.copy(), device=layer.device) for side in structure.pairs.T
        )
        starts = [place for place in range(1, len(kept)) if place == 1 or kept[place] != kept[place - 1] + 1]
        ends = [*starts[1:], len(kept)]
        self.runs = [
            (int(kept[a]) - 1, int(kept[a]) - 1 + b - a, a) for a, b in zip(starts, ends, strict=True)
        ]
        self._build_atoms(row, parents, **kind)

    def _influences(self, places: PointPlaces, rig) -> np.ndarray:
        """(P, J) bool: which joints carry a point."""
        parents = np.maximum(rig.parents, 1)
        weight = places.joint_weight.double().cpu().numpy()
        carried = np.zeros(weight.shape, bool)
        for point, joint in np.argwhere(weight):
            carried[point, parents[joint]] = True
            if places.offset[point].any():
                carried[point, joint] = True
        self.skin = _skin(places, rig)
        return carried | (self.skin[1] > 0)

    def _build_atoms(self, row, parents, *, dtype, device) -> None:
        """Terms of the points: (point, row, joint or vertex, weight)."""
        places, vertex_weight = self.places, self.skin[0]
        weight = places.joint_weight.double().cpu().numpy()
        centres = [(p, row[max(int(parents[j]), 1)], j, weight[p, j]) for p, j in np.argwhere(weight)]
        reach = [(p, row[int(j)], j) for p, j in np.argwhere(weight) if places.offset[p].any()]
        skin = [
            (p, row[int(t)], u, places.vertex_weight[p, u] * vertex_weight[u, t])
            for p, u in zip(*places.vertex_weight.nonzero(), strict=True)
            for t in np.flatnonzero(vertex_weight[u])
        ]
        for key, atoms in (("centre", centres), ("reach", reach), ("skin", skin)):
            array = np.array([atom[:3] for atom in atoms], np.int64).reshape(-1, 3)
            self.register_buffer(f"{key}_at", torch.as_tensor(array, device=device), persistent=False)
            if key != "reach":
                values = torch.tensor([atom[3] for atom in atoms], dtype=dtype, device=device)
                self.register_buffer(f"{key}_weight", values, persistent=False)
        orient = self.layer.rig.t_pose_world[:, :3, :3].copy()
        orient[0] = np.eye(3)
        self.register_buffer("orient", torch.as_tensor(orient, device=device).to(dtype), persistent=False)

    def rest(self, identity: Identity, bone_scale: Tensor | None = None) -> PointRest:
        """What a fit needs of identities."""
        places, bind = self.places, identity.bind_world
        offsets = self.layer.animation.bone_vectors(identity, bone_scale)
        batch, shape = len(offsets), (len(places.names), len(self.joints))
        local = offsets.new_zeros(batch, *shape, 4)

        def add(at: Tensor, values: Tensor) -> None:
            flat = local.view(batch, -1, 4)
            flat.index_add_(1, at[:, 0] * shape[1] + at[:, 1], values)

        at, weight = self.centre_at, self.centre_weight
        bone = offsets[:, at[:, 2]] * (at[:, 2] > 1)[:, None]
        add(at, weight[:, None] * torch.nn.functional.pad(bone, (0, 1), value=1.0))
        if len(self.reach_at):
            at = self.reach_at
            size = places.size(bind[..., :3, 3])
            away = size[:, None, None] * places.offset[at[:, 0]]
            add(at, torch.nn.functional.pad(away, (0, 1)))
        if len(self.skin_at):
            at = self.skin_at
            joint = self.kept[self.weighted[at[:, 1]]]
            turn = self.orient[joint] @ bind[:, joint, :3, :3].mT
            step = identity.rest[:, places.vertex_ids[at[:, 2]]] - bind[:, joint, :3, 3]
            point = (turn @ step[..., None]).squeeze(-1)
            add(at, self.skin_weight[:, None] * torch.nn.functional.pad(point, (0, 1), value=1.0))
        return PointRest(local=local, offsets=offsets[:, self.kept])

    def moments(self, rest: PointRest, weights: Tensor, prior: float, *, held: bool = False) -> RestMoments:
        """``N`` of points with weights (1 or F, P), and of the prior times `prior` [m^2].

        With `held` every joint's turn in the world is pulled to one of the target's instead.
        """
        weighed = weights[:, :, None, None] * rest.local
        first, second = weighed[:, :, self.first], rest.local[:, :, self.second]
        pairs = torch.einsum("ipka,ipkb->ikab", first, second.expand(len(first), -1, -1, -1))
        pairs = pairs + prior * (self.hold if held else self.prior)
        own = pairs.new_zeros(len(pairs), len(self.joints), 4, 4)
        own[:, 0, 3, 3] = weights.sum(1)
        empty = pairs.new_empty(len(pairs), 0)
        return RestMoments(local=empty, weight=empty, own=own, second=pairs, offsets=rest.offsets)

    def pose(self, rotations: Tensor, translation: Tensor) -> Pose:
        """A pose of the kept joints, from all of the rig's rotations (F, J - 1, 3, 3)."""
        root = torch.eye(3).to(rotations).expand(len(rotations), 1, 3, 3)
        return Pose.begin(torch.cat((root, rotations[:, self.kept[1:] - 1]), 1), translation)

    def rotations(self, pose: Pose, others: Tensor | None = None, out: Tensor | None = None) -> Tensor:
        """All of the rig's rotations (F, J - 1, 3, 3); joints not kept have those of `others`, or rest."""
        others = self.still.expand(len(pose.relative), -1, -1, -1) if others is None else others
        every = torch.empty(others.shape, dtype=others.dtype, device=others.device) if out is None else out
        every.copy_(others)
        for first, stop, place in self.runs:
            every[:, first:stop] = pose.relative[:, place : place + stop - first]
        return every

    def held(self, target: Tensor, turns: Tensor, prior: float) -> Tensor:
        """``R`` (F, T, 3, 4) that also pulls to world turns (F, K, 3, 3)."""
        return target + _HELD * prior * torch.nn.functional.pad(turns[:, self.weighted], (0, 1))

    def target(self, rest: PointRest, points: Tensor, weights: Tensor) -> Tensor:
        """``R`` (F, T, 3, 4) of targets (F, P, 3) [m], finite, under weights (1 or F, P)."""
        weighed = (weights[..., None] * points).transpose(1, 2)
        if len(rest.local) == 1:
            product = weighed.reshape(-1, weighed.shape[2]) @ rest.local[0].flatten(1)
        else:
            product = weighed @ rest.local.flatten(2)
        return product.view(len(points), 3, len(self.joints), 4).transpose(1, 2).contiguous()

    @property
    def corrected(self) -> bool:
        """Whether the layer moves the points by more than plain skinning."""
        return len(self.places.vertex_ids) > 0 and not self.layer.plain

    def variances(self, moments: RestMoments, pose: Pose) -> Tensor:
        """Traces (F, n) of the variables' own blocks of the matrix's inverse."""
        kernels, mass = self.solver.kernels, pose.translation.new_ones(len(pose.translation))
        if kernels is not None:
            factor = kernels.factorise(
                self.solver.constants(moments), pose.relative, pose.translation, 0 * mass, mass, None, None,
                stiffness=HINGE_STIFFNESS, soft=self.solver.soft(None, pose.translation),
            )  # fmt: skip
            return kernels.variances(factor)
        matrix, slope = self.solver.normal_equations(*self.solver.walk(pose, moments), moments)
        solve = damped_inverse(matrix, 0 * mass)
        count = slope.shape[1] * 3
        columns = [
            solve(row.view(1, -1, 3).expand_as(slope)).flatten(1) for row in torch.eye(count).to(slope)
        ]
        own = torch.stack(columns, 1).diagonal(dim1=-2, dim2=-1)
        return own.unflatten(1, (-1, 3)).sum(-1)[:, :-1]

    def walk(self, pose: Pose, rest: PointRest) -> tuple[Tensor, Tensor]:
        """Turns (F, K, 3, 3) and places (F, K, 3) [m] of all joints."""
        kernels = self.solver.kernels
        if kernels is None:
            return self.solver.walk_public(pose, rest.offsets)
        none = rest.offsets.new_zeros(1, 16 * len(self.prior))
        return kernels.walked(kernels.constants(none, rest.offsets), pose.relative, pose.translation)

    def points(self, rest: PointRest, turns: Tensor, places: Tensor) -> Tensor:
        """Points (F, P, 3) [m] at turns (F, K, 3, 3) and places (F, K, 3) of all joints."""
        if len(self.joints) == len(self.variables):  # all but the root
            turns, places = turns[:, 1:], places[:, 1:]
        else:
            turns, places = turns[:, self.weighted], places[:, self.weighted]
        flat = torch.cat((turns.transpose(1, 2), places.mT[..., None]), -1).flatten(2)  # (F, 3, 4 T)
        local = rest.local.flatten(2).transpose(1, 2)  # (i, 4 T, P)
        product = flat.flatten(0, 1) @ local[0] if len(local) == 1 else flat @ local
        return product.view(len(flat), 3, len(self.places.names)).transpose(1, 2)


def _alone(structure: MomentStructure) -> MomentStructure:
    """The structure of a rig that has the root and the variables alone."""
    kept = np.concatenate(([0], structure.variables))
    place = np.full(len(structure.parents), -1)
    place[kept] = np.arange(len(kept))
    above = structure.parents[kept]
    return replace(
        structure, parents=np.where(above < 0, -1, place[above]), joints=place[structure.joints],
        variables=place[structure.variables],
    )  # fmt: skip


def _skin(places: PointPlaces, rig) -> tuple[np.ndarray, np.ndarray]:
    """Skin weights (u, J) of the vertices used, without the smallest, and those (P, J) of the points."""
    weights = rig.weights[places.vertex_ids.cpu().numpy()].toarray()
    weights[:, 0] = 0
    weights[weights < _LEAST_SKIN] = 0
    weights /= np.maximum(weights.sum(1, keepdims=True), 1e-12)
    return weights, (
        abs(places.vertex_weight) @ weights
        if len(weights)
        else np.zeros((len(places.names), rig.joint_count))
    )


def _above(carried: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Joints that carry something or lie above such, ascending, the root left out."""
    found = carried.copy()
    for joint in range(len(parents) - 1, 0, -1):
        if found[joint] and parents[joint] > 0:
            found[parents[joint]] = True
    found[0] = False
    return np.flatnonzero(found)


def _hold(pairs: np.ndarray) -> np.ndarray:
    """Moments (p, 4, 4) that pull every joint's turn in the world."""
    return (pairs[:, :1] == pairs[:, 1:])[..., None] * np.diag([1.0, 1.0, 1.0, 0.0])


def _spread(blocks: np.ndarray) -> np.ndarray:
    """Root mean square angles (J,) [degrees] of pulls (J, 3, 3); a joint that nothing is known of has 104."""
    stiffness = np.trace(blocks, axis1=1, axis2=2)[:, None] - np.linalg.eigvalsh(blocks)
    variance = np.where(stiffness > 0, 1 / np.maximum(stiffness, 1e-12), np.pi**2 / 3).sum(1)
    return np.degrees(np.sqrt(np.minimum(variance, np.pi**2 / 3)))
