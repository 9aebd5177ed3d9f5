"""The order of work of one sparse Gauss-Newton step: index lists that a kernel walks through.

The Gauss-Newton matrix has a block for every two variable joints whose subtrees share vertices: few, since
most joints of a body never meet. Leaves come first in the elimination (children have higher ids than their
parents), the translation last; fill then stays on chains towards the root.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sized
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from soma_core.inversion.structure import MomentStructure

__all__ = ["EliminationPlan", "elimination_plan"]


@dataclass(frozen=True, kw_only=True, eq=False)
class EliminationPlan:
    """Lists of int32; ``*_start`` are row starts. A column is a variable joint, in descending order.

    Attributes:
        driven: how many columns, the first ones, are those of driven joints.
        joint: (n,) joint of each column.
        parent: (n,) parent joint of each column's joint.
        parent_column: (n,) column of that parent, -1 for the topmost joints.
        near_start, near_joint, near_pair, near_flip: joints that share vertices with the column's joint,
            the pair that holds their moment, and whether it holds the transpose.
        row_start, row_joint, row_parent, row_slot: rows that a column's own moments reach, descending, the
            root last; `row_slot` is the block that keeps the row, -1 where it belongs to another column.
        push_start, push_source, push_target: blocks that a finished column hands to its parent's.
        block_start, block_row: blocks of each column: the diagonal first, then rows in elimination order;
            the slot is the position in the list, the row a column.
        update_start, update_target: for every two rows a, b (b after a, or a itself) of a column the slot
            of block (b, a), which elimination lowers by ``L_b L_a^T``.
    """

    driven: int
    joint: np.ndarray
    parent: np.ndarray
    parent_column: np.ndarray
    near_start: np.ndarray
    near_joint: np.ndarray
    near_pair: np.ndarray
    near_flip: np.ndarray
    row_start: np.ndarray
    row_joint: np.ndarray
    row_parent: np.ndarray
    row_slot: np.ndarray
    push_start: np.ndarray
    push_source: np.ndarray
    push_target: np.ndarray
    block_start: np.ndarray
    block_row: np.ndarray
    update_start: np.ndarray
    update_target: np.ndarray


def elimination_plan(
    structure: MomentStructure, *, public_count: int | None = None, coupled: Iterable[tuple[int, int]] = ()
) -> EliminationPlan:
    """Symbolic assembly and factorisation for one rig.

    Args:
        structure: joints, driven ones last.
        public_count: joints that are not driven; None for all. Columns of driven joints come first, are
            handed to their parent and are not eliminated.
        coupled: further pairs of variable joints that share a block.
    """
    public_count = len(structure.parents) if public_count is None else public_count
    columns = structure.variables[::-1]
    driven = int((columns >= public_count).sum())
    column_of = np.full(len(structure.parents), -1)
    column_of[columns] = np.arange(len(columns))
    near = _neighbours(structure)
    above = structure.ancestors
    reach = {u: np.flatnonzero(above[:, [t for t, _, _ in near[u]]].any(1))[::-1] for u in columns}
    last = [int(u if k >= driven else structure.parents[u]) for k, u in enumerate(columns)]
    filled, pattern = _fill(structure, columns, reach, last, driven, coupled)
    block_rows = [
        k + np.flatnonzero((filled if k >= driven else pattern)[k:, k]) for k in range(len(columns))
    ]
    start = _starts(block_rows)
    slot = {(int(r), k): start[k] + i for k, rows in enumerate(block_rows) for i, r in enumerate(rows)}
    row_slots = [
        [slot[column_of[i], k] if 0 < i <= last[k] else -1 for i in reach[u]] for k, u in enumerate(columns)
    ]
    pushes = [_pushes(k, structure, columns, column_of, pattern, slot) for k in range(len(columns))]
    updates = [
        [slot[int(b), int(a)] for i, a in enumerate(rows[1:]) for b in rows[1 + i :]] if k >= driven else []
        for k, rows in enumerate(block_rows)
    ]
    parent = structure.parents[columns]
    return EliminationPlan(
        driven=driven, joint=_ints(columns), parent=_ints(parent), parent_column=_ints(column_of[parent]),
        near_start=_ints(_starts([near[u] for u in columns])),
        near_joint=_ints([t for u in columns for t, _, _ in near[u]]),
        near_pair=_ints([p for u in columns for _, p, _ in near[u]]),
        near_flip=_ints([f for u in columns for _, _, f in near[u]]),
        row_start=_ints(_starts([reach[u] for u in columns])),
        row_joint=_ints([i for u in columns for i in reach[u]]),
        row_parent=_ints([structure.parents[i] for u in columns for i in reach[u]]),
        row_slot=_ints([s for slots in row_slots for s in slots]),
        push_start=_ints(_starts(pushes)),
        push_source=_ints([a for push in pushes for a, _ in push]),
        push_target=_ints([b for push in pushes for _, b in push]),
        block_start=_ints(start), block_row=_ints(np.concatenate(block_rows)),
        update_start=_ints(_starts(updates)), update_target=_ints([t for u in updates for t in u]),
    )  # fmt: skip


def _neighbours(structure: MomentStructure) -> dict[int, list[tuple[int, int, int]]]:
    """For every variable joint: (joint, pair, flip) of those it shares vertices with, itself included."""
    near: dict[int, list[tuple[int, int, int]]] = {int(u): [] for u in structure.variables}
    for index, (first, second) in enumerate(structure.pairs):
        a, b = int(structure.joints[first]), int(structure.joints[second])
        near[b].append((a, index, 0))
        if a != b:
            near[a].append((b, index, 1))
    return near


def _fill(
    structure: MomentStructure,
    columns: np.ndarray,
    reach: dict[int, np.ndarray],
    last: list[int],
    driven: int,
    coupled: Iterable[tuple[int, int]],
) -> tuple[np.ndarray, np.ndarray]:
    """Blocks of the factor, and of the sums up the tree, (n, n) lower triangular in elimination order."""
    pattern = np.zeros((len(columns), len(columns)), bool)
    column_of = {int(u): k for k, u in enumerate(columns)}
    for k, u in enumerate(columns):
        pattern[[column_of[int(i)] for i in reach[u] if 0 < i <= last[k]], k] = True
        pattern[k, k] = k >= driven
        above = column_of.get(int(structure.parents[u]))
        if above is not None:
            pattern[above:, above] |= pattern[above:, k]
    filled = pattern.copy()
    filled[:, :driven] = False
    for first, second in coupled:
        a, b = sorted((column_of[first], column_of[second]))
        filled[b, a] = True
    for k in range(driven, len(columns)):
        rows = k + 1 + np.flatnonzero(filled[k + 1 :, k])
        for i, row in enumerate(rows):
            filled[rows[i:], row] = True
    return filled, pattern


def _pushes(
    k: int,
    structure: MomentStructure,
    columns: np.ndarray,
    column_of: np.ndarray,
    pattern: np.ndarray,
    slot: Mapping[tuple[int, int], int],
) -> list[tuple[int, int]]:
    """(source, target) slots of the rows that column k hands to its parent's column."""
    above = column_of[structure.parents[columns[k]]]
    if above < 0:
        return []
    rows = above + np.flatnonzero(pattern[above:, k])
    return [(slot[int(r), k], slot[int(r), int(above)]) for r in rows]


def _starts(lists: Iterable[Sized]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([len(one) for one in lists])])


def _ints(values: npt.ArrayLike) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.int32)
