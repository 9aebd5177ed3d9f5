"""Which joints share vertices: the sparsity that makes a Gauss-Newton step independent of the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from soma_core.rig.skeleton import Rig

__all__ = ["MomentStructure", "skin_structure"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MomentStructure:
    """Index lists of one rig at one LOD; all joint ids are over the J joints of the rig.

    Attributes:
        parents: (J,) int64, -1 for the root.
        joints: (T,) joints that carry skin weight on vertices that can be fitted.
        variables: (n,) joints whose subtree carries weight, ascending, Root excluded: those that a fit
            can determine.
        influence_joint: (e,) position in `joints` of each influence, ascending.
        influence_vertex, influence_weight: (e,) vertex and skin weight of each influence.
        pairs: (p, 2) positions in `joints` (first <= second) of joints that share vertices.
        pair_entry: (m,) row in `pairs` of each shared vertex, ascending.
        pair_influences: (m, 2) positions in the influence lists of its two influences.
        fitted: (v,) bool, vertices that take part by default: all outside the face interior.
    """

    parents: np.ndarray
    joints: np.ndarray
    variables: np.ndarray
    influence_joint: np.ndarray
    influence_vertex: np.ndarray
    influence_weight: np.ndarray
    pairs: np.ndarray
    pair_entry: np.ndarray
    pair_influences: np.ndarray
    fitted: np.ndarray

    @property
    def ancestors(self) -> np.ndarray:
        """(J, J) bool: whether the row's joint is the column's joint or lies above it."""
        above = np.zeros((len(self.parents),) * 2, bool)
        for joint in range(len(self.parents)):
            step = joint
            while step >= 0:
                above[step, joint] = True
                step = self.parents[step]
        return above

    def meeting(self) -> dict[int, list[int]]:
        """Joint -> weighted joints that it shares vertices with, itself included."""
        near: dict[int, list[int]] = {}
        for first, second in self.joints[self.pairs].tolist():
            near.setdefault(first, []).append(second)
            if first != second:
                near.setdefault(second, []).append(first)
        return near


def skin_structure(rig: Rig, fitted: np.ndarray) -> MomentStructure:
    """Collect the influences on `fitted` vertices, by joint, and the vertices each two joints share.

    Args:
        rig: any skinned mesh whose joint 0 is a virtual root without weight.
        fitted: (v,) bool, vertices that a fit may look at.
    """
    weights = scipy.sparse.coo_array(rig.skin)
    chosen = (weights.data > 0) & fitted[weights.row] & (weights.col > 0)
    vertex, joint, weight = weights.row[chosen], weights.col[chosen], weights.data[chosen]
    order = np.lexsort((vertex, joint))
    vertex, joint, weight = vertex[order].astype(np.int64), joint[order], weight[order]
    joints, rank = np.unique(joint, return_inverse=True)
    first, second = _shared(vertex)
    swap = rank[first] > rank[second]
    first, second = np.where(swap, second, first), np.where(swap, first, second)
    code = rank[first] * len(joints) + rank[second]
    order = np.lexsort((vertex[first], code))
    codes, entry = np.unique(code[order], return_inverse=True)
    parents = rig.parents.astype(np.int64)
    carries = np.zeros(rig.joint_count, bool)
    for start in joints:
        step = start
        while step > 0 and not carries[step]:
            carries[step] = True
            step = parents[step]
    return MomentStructure(
        parents=parents,
        joints=joints.astype(np.int64),
        variables=np.flatnonzero(carries),
        influence_joint=rank.astype(np.int64),
        influence_vertex=vertex,
        influence_weight=weight,
        pairs=np.stack(np.divmod(codes, len(joints)), 1).astype(np.int64),
        pair_entry=entry.astype(np.int64),
        pair_influences=np.stack((first[order], second[order]), 1),
        fitted=fitted,
    )


def _shared(vertex: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every unordered pair of influences of one vertex, an influence with itself included."""
    count = len(vertex)
    incidence = scipy.sparse.csr_array(
        (np.ones(count, np.int32), (np.arange(count), vertex)), shape=(count, int(vertex.max(initial=-1)) + 1)
    )
    both = scipy.sparse.triu(incidence @ incidence.T).tocoo()
    return both.row.astype(np.int64), both.col.astype(np.int64)
