"""Functions of the Gauss-Newton kernel that assemble ``J^T J`` and ``J^T r`` from the moments of pairs."""

import functools
from types import SimpleNamespace

import warp as wp

from soma_core.kernels._gn_tree import Indices, tree_functions
from soma_core.kernels._lanes import lane_types

__all__ = ["Plan", "assembly_functions"]


@wp.struct
class Plan:
    """``inversion.elimination.EliminationPlan`` and the tree, as device arrays."""

    parents: Indices
    weighted: Indices
    pairs: Indices
    joint: Indices
    parent: Indices
    parent_column: Indices
    near_start: Indices
    near_joint: Indices
    near_pair: Indices
    near_flip: Indices
    row_start: Indices
    row_joint: Indices
    row_parent: Indices
    row_slot: Indices
    push_start: Indices
    push_source: Indices
    push_target: Indices
    block_start: Indices
    block_row: Indices
    update_start: Indices
    update_target: Indices


@functools.cache
def assembly_functions(scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    """Sums of moments and forces up the tree, kept to the blocks that are not zero."""
    types, tree = lane_types(scalar, lanes), tree_functions(scalar, lanes, shared=shared)
    pair_moment = _pair_moment(types, tree)
    column_moments = _column_moments(types, tree, pair_moment, _hand_up(tree))
    moments = _moments(types, tree, column_moments, _push(tree))
    return SimpleNamespace(moments=moments, forces=_forces(types, tree), finish=_finish(tree))


def _pair_moment(types, tree):
    vec, frames, constants, scaled = types.vec, tree.frames, tree.constants, tree.scaled

    @wp.func
    def turned(g: int, n: int, row: int, x: vec, y: vec, z: vec, second: constants):
        return scaled(second, g, n, x) + scaled(second, g, n + row, y) + scaled(second, g, n + 2 * row, z)

    @wp.func
    def pair_moment(
        w: int, g: int, n: int, flip: int, t: int, u: int, second: constants, turns: frames, out: frames
    ):
        """Row t of `out`: ``K = diag(D_t, 1) N diag(D_u, 1)^T`` of one pair, N transposed where `flip`."""
        row = wp.where(flip == 1, 1, 4)
        col = wp.where(flip == 1, 4, 1)
        k = 16 * t
        for r in range(3):
            d0 = turns[w, 9 * t + 3 * r]
            d1 = turns[w, 9 * t + 3 * r + 1]
            d2 = turns[w, 9 * t + 3 * r + 2]
            x0 = turned(g, n, row, d0, d1, d2, second)
            x1 = turned(g, n + col, row, d0, d1, d2, second)
            x2 = turned(g, n + 2 * col, row, d0, d1, d2, second)
            out[w, k + 4 * r + 3] = turned(g, n + 3 * col, row, d0, d1, d2, second)
            for c in range(3):
                e = 9 * u + 3 * c
                product = wp.cw_mul(x0, turns[w, e]) + wp.cw_mul(x1, turns[w, e + 1])
                out[w, k + 4 * r + c] = product + wp.cw_mul(x2, turns[w, e + 2])
        m = n + 3 * row
        for c in range(3):
            e = 9 * u + 3 * c
            out[w, k + 12 + c] = turned(g, m, col, turns[w, e], turns[w, e + 1], turns[w, e + 2], second)
        # turns[0] is the identity of the root: its first entry is one in every lane.
        out[w, k + 15] = scaled(second, g, m + 3 * col, turns[w, 0])

    return pair_moment


def _hand_up(tree):
    frames = tree.frames

    @wp.func
    def hand_up(
        w: int, e: int, k: int, plan: Plan, places: frames, column: frames, blocks: frames, root: frames
    ):
        """Keep one row of a column, and add it to the row of the joint's parent, about the parent."""
        i = 16 * plan.row_joint[e]
        slot = plan.row_slot[e]
        if slot >= 0:
            for c in range(12):
                blocks[w, 12 * slot + c] += column[w, i + c]
        if i == 0:
            for c in range(4):
                root[w, 4 * k + c] += column[w, 12 + c]
        else:
            p = 16 * plan.row_parent[e]
            for r in range(3):
                shift = places[w, 3 * plan.row_joint[e] + r] - places[w, 3 * plan.row_parent[e] + r]
                for c in range(4):
                    moved = wp.cw_mul(shift, column[w, i + 12 + c])
                    column[w, p + 4 * r + c] += column[w, i + 4 * r + c] + moved
            for c in range(4):
                column[w, p + 12 + c] += column[w, i + 12 + c]

    return hand_up


def _column_moments(types, tree, pair_moment, hand_up):
    real, vec, frames, constants = types.real, types.vec, tree.frames, tree.constants

    @wp.func
    def column_moments(
        w: int, g: int, k: int, plan: Plan, second: constants, turns: frames, places: frames,
        column: frames, blocks: frames, root: frames,
    ):  # fmt: skip
        """Moments of every subtree against the own points of column k's joint, summed up the tree."""
        for e in range(plan.row_start[k], plan.row_start[k + 1]):
            i = 16 * plan.row_joint[e]
            for c in range(16):
                column[w, i + c] = vec(real(0.0))
        for e in range(plan.near_start[k], plan.near_start[k + 1]):
            pair_moment(
                w, g, 16 * plan.near_pair[e], plan.near_flip[e], plan.near_joint[e], plan.joint[k], second,
                turns, column,
            )  # fmt: skip
        for e in range(plan.row_start[k], plan.row_start[k + 1]):
            hand_up(w, e, k, plan, places, column, blocks, root)

    return column_moments


def _push(tree):
    frames = tree.frames

    @wp.func
    def push(w: int, k: int, plan: Plan, places: frames, blocks: frames, root: frames):
        """Add a finished column to that of the joint's parent, about the parent."""
        above = plan.parent_column[k]
        j = 3 * plan.joint[k]
        p = 3 * plan.parent[k]
        s0 = places[w, j] - places[w, p]
        s1 = places[w, j + 1] - places[w, p + 1]
        s2 = places[w, j + 2] - places[w, p + 2]
        for e in range(plan.push_start[k], plan.push_start[k + 1]):
            for r in range(3):
                a = 12 * plan.push_source[e] + 4 * r
                b = 12 * plan.push_target[e] + 4 * r
                last = blocks[w, a + 3]
                blocks[w, b] += blocks[w, a] + wp.cw_mul(last, s0)
                blocks[w, b + 1] += blocks[w, a + 1] + wp.cw_mul(last, s1)
                blocks[w, b + 2] += blocks[w, a + 2] + wp.cw_mul(last, s2)
                blocks[w, b + 3] += last
        m = root[w, 4 * k + 3]
        root[w, 4 * above] += root[w, 4 * k] + wp.cw_mul(m, s0)
        root[w, 4 * above + 1] += root[w, 4 * k + 1] + wp.cw_mul(m, s1)
        root[w, 4 * above + 2] += root[w, 4 * k + 2] + wp.cw_mul(m, s2)
        root[w, 4 * above + 3] += m

    return push


def _moments(types, tree, column_moments, push):
    real, vec, frames, constants = types.real, types.vec, tree.frames, tree.constants

    @wp.func
    def moments(
        w: int, g: int, plan: Plan, second: constants, turns: frames, places: frames,
        column: frames, blocks: frames, root: frames,
    ):  # fmt: skip
        """``H_ij`` without its last row in `blocks`, that row for the root in `root`; leaves first."""
        for i in range(blocks.shape[1]):
            blocks[w, i] = vec(real(0.0))
        for i in range(root.shape[1]):
            root[w, i] = vec(real(0.0))
        for k in range(plan.joint.shape[0]):
            column_moments(w, g, k, plan, second, turns, places, column, blocks, root)
            if plan.parent_column[k] >= 0:
                push(w, k, plan, places, blocks, root)

    return moments


def _forces(types, tree):
    real, vec, frames = types.real, types.vec, tree.frames

    @wp.func
    def forces(
        w: int, plan: Plan, turns: frames, places: frames, residual: frames, spread: frames, force: frames,
        slope: frames,
    ):  # fmt: skip
        """``J^T r``: torque of each subtree about its joint, and the force on all of it last."""
        for i in range(spread.shape[1]):
            spread[w, i] = vec(real(0.0))
        for i in range(force.shape[1]):
            force[w, i] = vec(real(0.0))
        for t in range(plan.weighted.shape[0]):
            j = plan.weighted[t]
            for r in range(3):
                force[w, 3 * j + r] = residual[w, 12 * t + 4 * r + 3]
                for c in range(3):
                    spread[w, 9 * j + 3 * r + c] = (
                        wp.cw_mul(turns[w, 9 * j + 3 * r], residual[w, 12 * t + 4 * c])
                        + wp.cw_mul(turns[w, 9 * j + 3 * r + 1], residual[w, 12 * t + 4 * c + 1])
                        + wp.cw_mul(turns[w, 9 * j + 3 * r + 2], residual[w, 12 * t + 4 * c + 2])
                    )
        for k in range(plan.joint.shape[0]):
            j = plan.joint[k]
            p = plan.parent[k]
            for r in range(3):
                shift = places[w, 3 * j + r] - places[w, 3 * p + r]
                for c in range(3):
                    spread[w, 9 * p + 3 * r + c] += spread[w, 9 * j + 3 * r + c] + wp.cw_mul(
                        shift, force[w, 3 * j + c]
                    )
            for r in range(3):
                force[w, 3 * p + r] += force[w, 3 * j + r]
            slope[w, 3 * k] = spread[w, 9 * j + 5] - spread[w, 9 * j + 7]
            slope[w, 3 * k + 1] = spread[w, 9 * j + 6] - spread[w, 9 * j + 2]
            slope[w, 3 * k + 2] = spread[w, 9 * j + 1] - spread[w, 9 * j + 3]
        for r in range(3):
            slope[w, 3 * plan.joint.shape[0] + r] = force[w, r]

    return forces


def _finish(tree):
    frames = tree.frames

    @wp.func
    def finish(w: int, plan: Plan, blocks: frames):
        """Turn every second moment S into its block of ``J^T J``, ``tr(S) I - S^T``, in place."""
        for s in range(plan.block_row.shape[0]):
            b = 12 * s
            s00 = blocks[w, b]
            s11 = blocks[w, b + 5]
            s22 = blocks[w, b + 10]
            blocks[w, b] = s11 + s22
            blocks[w, b + 5] = s00 + s22
            blocks[w, b + 10] = s00 + s11
            for r in range(3):
                for c in range(r):
                    lower = blocks[w, b + 4 * r + c]
                    blocks[w, b + 4 * r + c] = -blocks[w, b + 4 * c + r]
                    blocks[w, b + 4 * c + r] = -lower

    return finish
