"""All lists of the native solver: the tree, the sparse step, and internal coordinates of a pose.

An internal coordinate is one number that follows from the pose: a twist angle that turns helpers, or a mode
of what the pose adds to the rest shape. With A its derivative by the turns of the joints and S its coupling
to them through skin, all coordinates together add ``Y A + (Y A)^T`` to the Gauss-Newton matrix, where
``Y = S + A^T G / 2`` and G holds the coordinates' own products.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from soma_core.inversion.driven import DrivenJoints
from soma_core.inversion.elimination import EliminationPlan, elimination_plan
from soma_core.inversion.offsets import PoseOffsets
from soma_core.inversion.structure import MomentStructure
from soma_core.kernels._share_text import MOST_HELPERS, share_room

__all__ = ["SolverTables", "solver_tables"]

_SMALL = 1e-3
"""Relative to the largest: smaller products of modes, and moments on a joint's cloud, are left out."""

_DIAGONAL, _BELOW, _TURNED = 0, 1, 2
"""Where ``Y_i A_j^T`` goes: a diagonal block, block (i, j), or transposed into block (j, i)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SolverTables:
    """Integers and numbers by name; a list of the one is int32, of the other float64.

    Attributes:
        counts: sizes.
        lists: index lists.
        numbers: constants.
    """

    counts: Mapping[str, int]
    lists: Mapping[str, np.ndarray]
    numbers: Mapping[str, np.ndarray]


class _Slots:
    """Where a block of the matrix lies, and how two rows meet in it."""

    def __init__(self, plan: EliminationPlan) -> None:
        self.column = {int(joint): k for k, joint in enumerate(plan.joint)}
        self._slot = {
            (int(row), k): slot
            for k in range(len(plan.joint))
            for slot, row in enumerate(
                plan.block_row[plan.block_start[k] : plan.block_start[k + 1]], plan.block_start[k]
            )
        }

    def meet(self, row: int, joint: int) -> tuple[int, int]:
        """Slot, and kind of place, of the product of a row's and a joint's vectors."""
        a, b = self.column[row], self.column[joint]
        if a == b:
            return self._slot[a, a], _DIAGONAL
        return (self._slot[a, b], _BELOW) if a > b else (self._slot[b, a], _TURNED)


def solver_tables(
    structure: MomentStructure, driven: DrivenJoints | None, offsets: PoseOffsets | None = None
) -> SolverTables:
    """Lists of one rig; with `offsets`, of the whole model's matrix."""
    public = len(structure.parents) if driven is None else driven.public_count
    free = {int(joint) for joint in structure.variables if joint < public}
    twists = _Twists(structure, driven, free)
    modes = _Modes(structure, driven, offsets, free)
    plan = elimination_plan(structure, public_count=public, coupled={*twists.coupled(), *modes.coupled()})
    slots = _Slots(plan)
    lists = {name: value for name, value in vars(plan).items() if isinstance(value, np.ndarray)}
    lists |= {"parents": structure.parents, "weighted": structure.joints, "pairs": structure.pairs.ravel()}
    own, numbers = twists.tables(plan, slots)
    more, constants = modes.tables(slots)
    counts = {
        "joint_count": public, "all_count": len(structure.parents), "weighted_count": len(structure.joints),
        "pair_count": len(structure.pairs), "column_count": len(plan.joint), "driven_count": plan.driven,
        "slot_count": len(plan.block_row), **twists.counts, **modes.counts,
    }  # fmt: skip
    return SolverTables(counts=counts, lists={**lists, **own, **more}, numbers={**numbers, **constants})


class _Twists:
    """Twist angles as coordinates."""

    def __init__(self, structure: MomentStructure, driven: DrivenJoints | None, free: set[int]) -> None:
        self.structure, self.driven, self.free = structure, driven, free
        mix = np.zeros((0, 0)) if driven is None else driven.mix.double().cpu().numpy()
        chain = np.zeros((0, 0)) if driven is None else driven.chain.cpu().numpy()
        self.mix = mix
        self.chains = [[int(j) for j in np.flatnonzero(row) if int(j) in free] for row in chain]
        self.counts = {"channel_count": mix.shape[1] if driven else 0, "helper_count": len(mix)}
        self.near = structure.meeting()
        self.first = 0 if driven is None else driven.public_count
        self.rows = [self._rows(channel) for channel in range(self.counts["channel_count"])]

    def _helpers(self, channel: int) -> list[int]:
        return [self.first + int(h) for h in np.flatnonzero(self.mix[:, channel])]

    def _rows(self, channel: int) -> list[int]:
        """Free joints that a helper of the channel shares vertices with, or that lie above such."""
        met = [t for helper in self._helpers(channel) for t in self.near.get(helper, ())]
        above = self.structure.ancestors[:, met].any(1) if met else np.zeros(0, bool)
        others = [
            other for other in range(self.counts["channel_count"]) if set(self._helpers(other)) & set(met)
        ]
        own = {int(i) for i in np.flatnonzero(above)} & self.free
        return sorted(own | {joint for other in others for joint in self.chains[other]})

    def coupled(self) -> Iterable[tuple[int, int]]:
        """Pairs of joints that meet through a twist angle."""
        return (
            (row, joint)
            for rows, chain in zip(self.rows, self.chains, strict=True)
            for row in rows
            for joint in chain
        )

    def tables(
        self, plan: EliminationPlan, slots: _Slots
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        if self.driven is None:
            return {}, {}
        driven, count = self.driven, self.counts["channel_count"]
        first = np.cumsum([0, *map(len, self.rows)])
        place = {(c, i): int(first[c]) + k for c, rows in enumerate(self.rows) for k, i in enumerate(rows)}
        drives, crosses = [], []
        for k in range(plan.driven):
            helper = int(plan.joint[k]) - self.first
            reached = [int(i) for i in plan.row_joint[plan.row_start[k] : plan.row_start[k + 1]]]
            channels = np.flatnonzero(self.mix[helper]).tolist()
            drives.append(
                [(i, place[c, i], self.mix[helper, c]) for i in reached for c in channels if i in self.free]
            )
            crosses.append(
                [
                    (i, d * count + c, self.mix[helper, c] * self.mix[i - self.first, d])
                    for i in reached if i >= self.first for c in channels
                    for d in np.flatnonzero(self.mix[i - self.first])
                ]
            )  # fmt: skip
        adds = [
            (place[c, j], d * count + c, d) for c in range(count) for d in range(count)
            for j in self.chains[d] if (c, j) in place
        ]  # fmt: skip
        applies = [
            (place[c, i], c, *slots.meet(i, j)) for c in range(count) for i in self.rows[c]
            for j in self.chains[c]
        ]  # fmt: skip
        chained = [(c, slots.column[j]) for c in range(count) for j in self.chains[c]]
        mixed = [[(int(c), row[c]) for c in np.flatnonzero(row)] for row in self.mix]
        lists = {
            "channel_joint": driven.joint.cpu().numpy(), "channel_reference": driven.reference.cpu().numpy(),
            "mix_start": _starts(mixed), "mix_channel": _flat(mixed, 0),
            "drive_start": _starts(drives), "drive_row": _flat(drives, 0), "drive_slot": _flat(drives, 1),
            "cross_start": _starts(crosses), "cross_row": _flat(crosses, 0), "cross_slot": _flat(crosses, 1),
            "add_slot": _flat([adds], 0), "add_pair": _flat([adds], 1), "add_channel": _flat([adds], 2),
            "twist_slot": _flat([applies], 0), "twist_channel": _flat([applies], 1),
            "twist_block": _flat([applies], 2), "twist_kind": _flat([applies], 3),
            "chain_channel": _flat([chained], 0), "chain_column": _flat([chained], 1),
        }  # fmt: skip
        numbers = {
            "mix_value": _flat(mixed, 1, float), "drive_value": _flat(drives, 2, float),
            "cross_value": _flat(crosses, 2, float),
            "spin_axis": driven.spin_axis.double().cpu().numpy().ravel(),
        }  # fmt: skip
        self.counts |= {
            "add_count": len(adds), "twist_count": len(applies), "chain_count": len(chained),
            "twist_rows": int(first[-1]),
        }  # fmt: skip
        return lists, numbers


class _Modes:
    """Modes of pose offsets as coordinates, block by block of those that one joint owns."""

    def __init__(
        self,
        structure: MomentStructure,
        driven: DrivenJoints | None,
        offsets: PoseOffsets | None,
        free: set[int],
    ) -> None:
        self.structure, self.driven, self.offsets, self.free = structure, driven, offsets, free
        self.counts = {"block_count": 0}
        self.rows: list[list[int]] = []
        self.reads: list[list[int]] = []
        if offsets is None:
            return
        blocks, width = offsets.modes.shape[:2]
        gram = offsets.gram.double().cpu().numpy().reshape(blocks, width, blocks, width)
        self.gram = gram
        self.sizes = [int((np.einsum("kk->k", gram[p, :, p]) > 0).sum()) for p in range(blocks)]
        largest = np.abs(gram).max()
        near = np.abs(gram).max((1, 3)) > _SMALL * largest
        moments = [
            one.double().cpu().numpy().reshape(-1, 3, blocks, width)
            for one in (offsets.torque, offsets.force)
        ]
        self.moments = np.stack(moments, 1)  # (T, 2, 3, P, K)
        sizes = [np.linalg.norm(one, axis=1).max(-1) for one in moments]
        touch = np.logical_or(*(one > _SMALL * one.max() for one in sizes))
        joint_count = len(offsets.left)
        reads = offsets.reads.cpu().numpy()
        self.columns = [[int(r) for r in row if r < joint_count] for row in reads]
        self.reads = [[j for j in row if j in free] for row in self.columns]
        # Each pair of blocks once: what the other would add is what this one adds, transposed.
        self.near = [[int(q) for q in np.flatnonzero(near[p]) if q >= p] for p in range(blocks)]
        self.clouds = [[int(t) for t in np.flatnonzero(touch[:, p])] for p in range(blocks)]
        self.trees = [self._tree(clouds) for clouds in self.clouds]
        self.rows = [self._rows(p) for p in range(blocks)]

    def _tree(self, clouds: Sequence[int]) -> list[int]:
        """Joints that the clouds hang on, children first, the root last."""
        found = self.structure.ancestors[:, self.structure.joints[list(clouds)]].any(1)
        return [int(i) for i in np.flatnonzero(found)[::-1]]

    def _rows(self, block: int) -> list[int]:
        rows = set(self.trees[block]) | {j for q in self.near[block] for j in self.reads[q]}
        if self.driven is not None:
            chain, mix = self.driven.chain.cpu().numpy(), self.driven.mix.cpu().numpy()
            helpers = [i - self.driven.public_count for i in rows if i >= self.driven.public_count]
            rows |= {
                int(j) for h in helpers for c in np.flatnonzero(mix[h]) for j in np.flatnonzero(chain[c])
            }
        return sorted(rows & self.free)

    def coupled(self) -> Iterable[tuple[int, int]]:
        """Pairs of joints that meet through a mode."""
        return (
            (row, joint)
            for rows, reads in zip(self.rows, self.reads, strict=True)
            for row in rows
            for joint in reads
        )

    def tables(self, slots: _Slots) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        if self.offsets is None:
            return {}, {}
        offsets, blocks, size = self.offsets, range(len(self.rows)), self.sizes
        activations = offsets.shapes.shape[1]
        taken = [[int(c) for c in row if c < activations] for row in offsets.taken.cpu().numpy()]
        place = [{joint: k for k, joint in enumerate(rows)} for rows in self.rows]
        tree = [{joint: k for k, joint in enumerate(one)} for one in self.trees]
        folds = [self._folds(p, place[p], tree[p]) for p in blocks]
        reads = [
            [(k, j, place[p].get(j, -1)) for k, j in enumerate(self.columns[p]) if j in self.free]
            for p in blocks
        ]
        used = sorted({j for row in self.columns for j in row})
        lists = {
            "mode_size": np.array(size), "taken_start": _starts(taken), "taken": np.concatenate(taken),
            **self._tree_lists(place, tree),
            "fold_start": _starts(folds), "fold_tree": _flat(folds, 0), "fold_helper": _flat(folds, 1),
            "fold_channel": _flat(folds, 2), "fold_row": _flat(folds, 3),
            **self._read_lists(slots, place, reads, used),
        }  # fmt: skip
        numbers = {**self._numbers(taken, used), "fold_value": _flat(folds, 4, float)}
        seen, weighed = self._features(slots)
        lists, numbers = {**lists, **seen}, {**numbers, **weighed}
        most = max(blocks, key=lambda p: size[p] * len(self.trees[p]))
        self.counts = {
            "block_count": len(blocks), "feature_columns": offsets.columns, "used_count": len(used),
            "activation_count": activations, "feature_count": len(seen["feature_joint"]),
            "squash": 0 if offsets.first is None else 1 + offsets.squash,
            "response_size": max(int(lists["response_start"][-1]), share_room(MOST_HELPERS, activations)),
            "mode_rows": max(s * 3 * (len(r) + 1) for s, r in zip(size, self.rows, strict=True)),
            "mode_tree": size[most] * 6 * len(self.trees[most]),
            "opened": 3 * int((np.diff(lists["taken_start"]) * np.diff(lists["read_start"])).max()),
        }  # fmt: skip
        return lists, numbers

    def _tree_lists(
        self, place: Sequence[Mapping[int, int]], tree: Sequence[Mapping[int, int]]
    ) -> dict[str, np.ndarray]:
        """Of every block: its tree, and which of its joints carry clouds that its modes move."""
        parents, joints, blocks = self.structure.parents, self.structure.joints, range(len(self.rows))
        trees = [
            [(j, tree[p].get(int(parents[j]), -1), place[p].get(j, -1)) for j in self.trees[p]]
            for p in blocks
        ]
        clouds = [[(tree[p][int(joints[t])],) for t in self.clouds[p]] for p in blocks]
        return {
            "tree_start": _starts(trees), "tree_joint": _flat(trees, 0), "tree_up": _flat(trees, 1),
            "tree_row": _flat(trees, 2), "cloud_start": _starts(clouds), "cloud_tree": _flat(clouds, 0),
            "cloud_weighted": np.array([t for one in self.clouds for t in one]),
        }  # fmt: skip

    def _read_lists(
        self,
        slots: _Slots,
        place: Sequence[Mapping[int, int]],
        reads: Sequence[Sequence[tuple[int, int, int]]],
        used: Sequence[int],
    ) -> dict[str, np.ndarray]:
        """Of every block: the joints that its modes read, and where products with them go."""
        blocks = range(len(self.rows))
        applies = [
            [
                (place[p][i], k, *slots.meet(i, j))
                for i in self.rows[p]
                for k, (_, j, _) in enumerate(reads[p])
            ]
            for p in blocks
        ]
        nears = [[(q, [place[p][j] for _, j, _ in reads[q]]) for q in self.near[p]] for p in blocks]
        sizes = [3 * s * len(r) for s, r in zip(self.sizes, reads, strict=True)]
        return {
            "read_start": _starts(reads),
            "read_used": np.array([used.index(j) for one in reads for _, j, _ in one]),
            "read_column": np.array([slots.column[j] for one in reads for _, j, _ in one]),
            "response_start": np.cumsum([0, *sizes]),
            "mode_row_count": np.array([len(rows) for rows in self.rows]),
            "apply_start": _starts(applies), "apply_row": _flat(applies, 0), "apply_read": _flat(applies, 1),
            "apply_block": _flat(applies, 2), "apply_kind": _flat(applies, 3),
            "near_start_mode": _starts(nears), "near_block": _flat(nears, 0),
            "near_rows": np.array([r for one in nears for _, rows in one for r in rows]),
            "used_joint": np.array(used),
        }  # fmt: skip

    def _features(self, slots: _Slots) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """How activations read the joints' features, and where the joints are among the columns."""
        offsets = self.offsets
        assert offsets is not None
        width, count = 3 * offsets.columns, len(offsets.left)
        first = offsets.first
        rows = scipy.sparse.eye_array(width * count).tocsr() if first is None else first.scipy()
        used = np.unique(rows.indices // width)
        place = np.full(count, -1)
        place[used] = np.arange(len(used))
        left, right, still = (
            part[used].double().cpu().numpy() for part in (offsets.left, offsets.right, offsets.still)
        )
        lists = {
            "feature_joint": used,
            "feature_column": np.array([slots.column.get(int(joint), -1) for joint in used]),
            "weigh_start": rows.indptr,
            "weigh_feature": width * place[rows.indices // width] + rows.indices % width,
        }
        numbers = {
            "feature_left": left, "feature_right": right[..., : offsets.columns], "feature_still": still,
            "weigh_value": rows.data,
        }  # fmt: skip
        return lists, numbers

    def _numbers(self, taken: Sequence[Sequence[int]], used: Sequence[int]) -> dict[str, np.ndarray]:
        """Of every block: how its activations read features, its modes, and their moments and products."""
        assert self.offsets is not None
        offsets, blocks, size = self.offsets, range(len(self.rows)), self.sizes
        gate, modes, left, right = (
            one.double().cpu().numpy() for one in (offsets.gate, offsets.modes, offsets.left, offsets.right)
        )
        kept = [[k for k, j in enumerate(self.columns[p]) if j in self.free] for p in blocks]
        return {
            "gate": _joined(gate[p, : len(taken[p])][:, kept[p]] for p in blocks),
            "mode": _joined(modes[p, : size[p], : len(taken[p])] for p in blocks),
            "cloud_moment": _joined(
                self.moments[t, :, :, p, : size[p]].transpose(2, 0, 1) for p in blocks for t in self.clouds[p]
            ),
            "gram": _joined(
                (0.5 if p == q else 1.0) * self.gram[p, : size[p], q, : size[q]]
                for p in blocks
                for q in self.near[p]
            ),
            "left": left[used].ravel(),
            "right": right[used][..., : offsets.columns].ravel(),
        }

    def _folds(self, block: int, place: Mapping[int, int], tree: Mapping[int, int]) -> list[tuple]:
        """Of every helper in the block's tree: its rows are handed to the joints that drive it."""
        if self.driven is None:
            return []
        mix, chain = self.driven.mix.double().cpu().numpy(), self.driven.chain.cpu().numpy()
        first = self.driven.public_count
        return [
            (tree[i], i - first, int(c), place[int(j)], mix[i - first, c])
            for i in self.trees[block] if i >= first
            for c in np.flatnonzero(mix[i - first])
            for j in np.flatnonzero(chain[c]) if int(j) in self.free
        ]  # fmt: skip


def _starts(lists: Sequence[Sequence]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([len(one) for one in lists])])


def _flat(lists: Sequence[Sequence[tuple]], which: int, kind: type = int) -> np.ndarray:
    return np.array([entry[which] for one in lists for entry in one], kind)


def _joined(parts: Iterable[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in parts] or [np.zeros(0)])
