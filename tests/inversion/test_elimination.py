"""The elimination plan: its blocks are those of a dense factorisation, and its lists compute it."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from soma_core.inversion.elimination import elimination_plan
from soma_core.rig import load_canonical
from tests.bodies import tiny_canonical
from tests.inversion.small_problem import canonical_structure

ROUNDING = 1e-12
"""Relative; block sums run in another order than dense ones."""


def random_structure(seed):
    """A random tree, random weighted joints and random pairs: more awkward than any body."""
    random = np.random.default_rng(seed)
    count = int(random.integers(3, 25))
    parents = np.array([-1, *(int(random.integers(0, joint)) for joint in range(1, count))])
    joints = np.flatnonzero(random.uniform(size=count) < 0.7)
    joints = joints[joints > 0] if (joints > 0).any() else np.array([count - 1])
    shared = np.triu(random.uniform(size=(len(joints),) * 2) < 0.2) | np.eye(len(joints), dtype=bool)
    structure = replace(
        canonical_structure(*tiny_canonical()), parents=parents, joints=joints, pairs=np.argwhere(shared)
    )
    below = structure.ancestors[:, joints].any(1)
    return replace(structure, variables=np.flatnonzero(below)[np.flatnonzero(below) > 0])


def structures():
    yield pytest.param(lambda: canonical_structure(*tiny_canonical()), id="synthetic")
    yield pytest.param(lambda: canonical_structure(*load_canonical("low")), id="low")
    for seed in range(12):
        yield pytest.param(functools.partial(random_structure, seed), id=f"random{seed}")


@pytest.fixture(scope="module", params=structures())
def structure(request):
    return request.param()


def matrix_pattern(structure):
    """Blocks of ``J^T J`` in elimination order: two joints whose subtrees share vertices."""
    first, second = structure.joints[structure.pairs].T
    meet = np.zeros((len(structure.parents),) * 2, bool)
    meet[first, second] = meet[second, first] = True
    above = structure.ancestors.astype(int)
    columns = structure.variables[::-1]
    return ((above @ meet @ above.T) > 0)[np.ix_(columns, columns)]


def random_matrix(pattern, seed=0):
    """A positive definite matrix of 3 x 3 blocks with a pattern."""
    random = np.random.default_rng(seed)
    full = random.standard_normal((3 * len(pattern),) * 2) * np.kron(pattern, np.ones((3, 3)))
    full = full + full.T
    return full + np.diag(1 + np.abs(full).sum(1))


def blocks_of(matrix, plan):
    """The (slot, 3, 3) blocks that the plan keeps."""
    return np.stack(
        [
            matrix[3 * row : 3 * row + 3, 3 * k : 3 * k + 3]
            for k in range(len(plan.joint))
            for row in plan.block_row[plan.block_start[k] : plan.block_start[k + 1]]
        ]
    )


def kept(plan):
    """Pattern (n, n) of the blocks that the plan keeps."""
    found = np.zeros((len(plan.joint),) * 2, bool)
    found[plan.block_row, np.repeat(np.arange(len(plan.joint)), np.diff(plan.block_start))] = True
    return found


def test_blocks_are_those_of_the_dense_factor(structure):
    plan, pattern = elimination_plan(structure), matrix_pattern(structure)
    factor = np.linalg.cholesky(random_matrix(pattern))
    size = len(pattern)
    filled = np.abs(factor).reshape(size, 3, size, 3).max((1, 3)) > 0
    np.testing.assert_array_equal(kept(plan), filled | np.eye(size, dtype=bool))


def test_blocks_of_a_column_come_in_elimination_order(structure):
    plan = elimination_plan(structure)
    for k in range(len(plan.joint)):
        rows = plan.block_row[plan.block_start[k] : plan.block_start[k + 1]]
        assert rows[0] == k
        assert (np.diff(rows) > 0).all()


def test_factorising_by_the_lists_equals_dense_cholesky(structure):
    plan = elimination_plan(structure)
    matrix = random_matrix(matrix_pattern(structure), seed=1)
    blocks = blocks_of(matrix, plan)
    for k in range(len(plan.joint)):
        first, stop = plan.block_start[k], plan.block_start[k + 1]
        diagonal = np.linalg.cholesky(blocks[first])
        blocks[first] = diagonal
        for slot in range(first + 1, stop):
            blocks[slot] = np.linalg.solve(diagonal, blocks[slot].T).T
        update = plan.update_start[k]
        for a in range(first + 1, stop):
            for b in range(a, stop):
                blocks[plan.update_target[update]] -= blocks[b] @ blocks[a].T
                update += 1
        assert update == plan.update_start[k + 1]
    expected = blocks_of(np.linalg.cholesky(matrix), plan)
    np.testing.assert_allclose(blocks, expected, atol=ROUNDING * np.abs(expected).max())


def test_sums_up_the_tree_by_the_lists_fill_the_matrix(structure):
    """Scalar moments of pairs, summed over both subtrees as the kernel walks the lists."""
    plan = elimination_plan(structure)
    random = np.random.default_rng(2)
    moment = random.standard_normal(len(structure.pairs))
    slots = np.zeros(len(plan.block_row))
    root = np.zeros(len(plan.joint))
    for k in range(len(plan.joint)):
        column = np.zeros(len(structure.parents))
        for e in range(plan.near_start[k], plan.near_start[k + 1]):
            column[plan.near_joint[e]] = moment[plan.near_pair[e]]
        for e in range(plan.row_start[k], plan.row_start[k + 1]):
            joint, slot = plan.row_joint[e], plan.row_slot[e]
            if joint == 0:
                root[k] += column[0]
                continue
            column[plan.row_parent[e]] += column[joint]
            if slot >= 0:
                slots[slot] += column[joint]
        if plan.parent_column[k] >= 0:
            pushed = slice(plan.push_start[k], plan.push_start[k + 1])
            slots[plan.push_target[pushed]] += slots[plan.push_source[pushed]]
            root[plan.parent_column[k]] += root[k]
    meet = np.zeros((len(structure.parents),) * 2)
    first, second = structure.joints[structure.pairs].T
    meet[first, second] = meet[second, first] = moment
    above = structure.ancestors.astype(float)
    sums = above @ meet @ above.T
    expected = np.zeros((len(plan.joint),) * 2)
    columns = structure.variables[::-1]
    expected[kept(plan)] = sums[np.ix_(columns, columns)][kept(plan)]
    found = np.zeros_like(expected)
    found[plan.block_row, np.repeat(np.arange(len(plan.joint)), np.diff(plan.block_start))] = slots
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(root, sums[0, columns], atol=1e-9)


def test_columns_are_the_variables_leaves_first(structure):
    plan = elimination_plan(structure)
    np.testing.assert_array_equal(plan.joint, structure.variables[::-1])
    np.testing.assert_array_equal(plan.parent, structure.parents[plan.joint])
    for k, above in enumerate(plan.parent_column):
        assert above > k or (above == -1 and plan.parent[k] == 0)
        if above >= 0:
            assert plan.joint[above] == plan.parent[k]


def test_flips_mark_pairs_that_hold_the_transpose(structure):
    plan = elimination_plan(structure)
    for k, joint in enumerate(plan.joint):
        span = slice(plan.near_start[k], plan.near_start[k + 1])
        for near, pair, flip in zip(
            plan.near_joint[span], plan.near_pair[span], plan.near_flip[span], strict=True
        ):
            held = tuple(structure.joints[structure.pairs[pair]])
            assert held == ((joint, near) if flip else (near, joint))
