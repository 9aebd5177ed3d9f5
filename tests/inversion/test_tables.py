"""Lists of the native solver: every product that the matrix holds has a place, every index is in range."""

import functools

import numpy as np
import pytest
import torch

from soma_core.inversion.elimination import elimination_plan
from soma_core.inversion.model import PoseModel
from soma_core.inversion.tables import SolverTables, solver_tables
from tests.bodies import randn
from tests.inversion.driven_layers import MODES, as_pose, layer_of, poses, problem_of
from tests.inversion.small_problem import real

NOTHING = 1e-14
"""Relative to the largest entry: a block of rounding is none."""
LEFT_OUT = 2e-3
"""Relative to the root of both diagonals: products of modes that the tables may do without."""
KINDS = ("plain", "driven", "whole")
HIPS = torch.tensor([[0.1, 0.9, -0.2]], dtype=torch.float64)


@functools.cache
def model_of(kind):
    return PoseModel(layer_of(correct=kind == "whole"), plain=kind == "plain", warp=False)


@functools.cache
def tables_of(kind) -> SolverTables:
    model = model_of(kind)
    return solver_tables(model.structure, model.driven, model.offsets)


def blocks_of(lists, driven):
    """Pairs of joints (the later one first) that have a slot in the eliminated part."""
    joint, start, row = lists["joint"], lists["block_start"], lists["block_row"]
    return {
        (int(joint[k]), int(joint[r]))
        for k in range(driven, len(joint))
        for r in row[start[k] : start[k + 1]]
    }


@pytest.mark.parametrize("kind", KINDS)
def test_every_pair_of_joints_that_couples_has_a_slot(kind):
    model, layer = model_of(kind), layer_of(correct=kind == "whole")
    identity, rotations = layer.identity({"shape": randn(1, 16, seed=1)}), poses(layer, "random")
    problem = problem_of(model, identity, layer.pose(identity, rotations, HIPS).vertices)
    pose = as_pose(rotations, HIPS - problem.origin)
    view = model.view(problem, pose)
    matrix = model.matrix(problem, pose, view.turns, view.places, view.activity)[0, :-1, :, :-1]
    size = matrix.abs().amax((1, 3))
    scale = size.diagonal().sqrt()
    bound = LEFT_OUT * scale[:, None] * scale if kind == "whole" else NOTHING * size.max()
    couples = torch.nonzero(size > bound).tolist()
    n = model.solver.variables.tolist()
    pairs = {(n[a], n[b]) for a, b in couples if a >= b}
    tables = tables_of(kind)
    kept = blocks_of(tables.lists, tables.counts["driven_count"])
    assert len(pairs) > len(n)
    assert pairs <= kept, sorted(pairs - kept)
    assert len(kept) < len(n) * (len(n) + 1) / 2, "the matrix is sparse"


@pytest.mark.parametrize("kind", KINDS)
def test_rows_of_a_list_add_up_to_it(kind):
    """Every list of starts ends where its list ends, and rises."""
    lists, numbers = tables_of(kind).lists, tables_of(kind).numbers
    spans = {
        "near_start": "near_joint", "row_start": "row_joint", "push_start": "push_source",
        "block_start": "block_row", "update_start": "update_target", "mix_start": "mix_channel",
        "drive_start": "drive_row", "cross_start": "cross_row", "taken_start": "taken",
        "read_start": "read_used", "tree_start": "tree_joint", "cloud_start": "cloud_tree",
        "fold_start": "fold_tree", "apply_start": "apply_row", "near_start_mode": "near_block",
    }  # fmt: skip
    known = {start: rows for start, rows in spans.items() if start in lists}
    assert len(known) == {"plain": 5, "driven": 8, "whole": len(spans)}[kind]
    for start, rows in known.items():
        assert lists[start][0] == 0
        assert (np.diff(lists[start]) >= 0).all()
        assert lists[start][-1] == len(lists[rows]), start
    values = {"mix_value": "mix_channel", "drive_value": "drive_row", "cross_value": "cross_row"}
    for value, rows in values.items():
        assert kind == "plain" or len(numbers[value]) == len(lists[rows])
    for array in numbers.values():
        assert np.isfinite(array).all()


@pytest.mark.parametrize("kind", KINDS)
def test_indices_are_in_range(kind):
    counts, lists = tables_of(kind).counts, tables_of(kind).lists
    limits = {
        "joint": counts["all_count"], "near_pair": counts["pair_count"], "push_source": counts["slot_count"],
        "push_target": counts["slot_count"], "update_target": counts["slot_count"],
        "block_row": counts["column_count"], "twist_block": counts["slot_count"],
        "twist_channel": counts["channel_count"], "mix_channel": counts["channel_count"],
        "chain_column": counts["column_count"], "channel_joint": counts["joint_count"],
        "channel_reference": counts["joint_count"], "twist_slot": counts.get("twist_rows", 0),
        "drive_slot": counts.get("twist_rows", 0), "add_slot": counts.get("twist_rows", 0),
        "apply_block": counts["slot_count"], "taken": counts.get("activation_count", 0),
        "tree_joint": counts["all_count"], "read_column": counts["column_count"],
        "read_used": counts.get("used_count", 0), "near_block": counts["block_count"],
        "fold_channel": counts["channel_count"], "fold_helper": counts["helper_count"],
    }  # fmt: skip
    for name, limit in limits.items():
        if name in lists and len(lists[name]):
            assert lists[name].min() >= 0, name
            assert lists[name].max() < limit, name
    for name in ("twist_kind", "apply_kind"):
        assert set(lists.get(name, [0])) <= {0, 1, 2}


def test_places_of_products_are_blocks_of_their_two_joints():
    """`Y_i A_j^T` on the diagonal, below it, or transposed."""
    lists, counts = tables_of("driven").lists, tables_of("driven").counts
    joint, start = lists["joint"], lists["block_start"]
    column = np.repeat(np.arange(counts["column_count"]), np.diff(start))
    for block, kind in zip(lists["twist_block"], lists["twist_kind"], strict=True):
        row = lists["block_row"][block]
        assert (row == column[block]) == (kind == 0)
        assert {int(joint[row]), int(joint[column[block]])} <= set(
            model_of("driven").solver.variables.tolist()
        )


def test_driven_columns_come_first_and_are_not_eliminated():
    tables, model = tables_of("driven"), model_of("driven")
    lists, driven = tables.lists, tables.counts["driven_count"]
    assert 0 < driven == tables.counts["helper_count"]
    assert (lists["joint"][:driven] >= tables.counts["joint_count"]).all()
    np.testing.assert_array_equal(lists["joint"][driven:][::-1], model.solver.variables.numpy())
    assert lists["update_start"][driven] == 0


def test_a_rig_without_twist_joints_has_no_coordinates():
    counts = tables_of("plain").counts
    assert [counts[name] for name in ("channel_count", "helper_count", "block_count", "driven_count")] == [
        0
    ] * 4
    assert "mode_size" not in tables_of("plain").lists


@pytest.mark.parametrize("mode", MODES[:2])
def test_both_ways_of_reading_half_angles_have_tables(mode):
    layer = layer_of(mode)
    model = PoseModel(layer, plain=False, warp=False)
    tables = solver_tables(model.structure, model.driven)
    assert tables.counts["channel_count"] == len(model.driven.joint)
    # A twist is read between a joint and one above it: what lies between turns it.
    chains = {}
    for channel, column in zip(tables.lists["chain_channel"], tables.lists["chain_column"], strict=True):
        chains.setdefault(int(channel), []).append(int(tables.lists["joint"][column]))
    for channel, (joint, reference) in enumerate(
        zip(model.driven.joint.tolist(), model.driven.reference.tolist(), strict=True)
    ):
        expected, step = set(), joint
        while step != reference and step > 0:
            expected.add(step)
            step = int(layer.rig.parents[step])
        assert set(chains[channel]) == expected


@pytest.mark.parametrize("seed", range(4))
def test_joints_that_are_coupled_by_hand_have_blocks_and_fill(seed):
    """The factor's blocks are those of a dense Cholesky factorisation of the coupled pattern."""
    structure = real().structure
    random = np.random.default_rng(seed)
    pairs = [tuple(map(int, random.choice(structure.variables, 2, replace=False))) for _ in range(3)]
    plan = elimination_plan(structure, coupled=pairs)
    meet = np.zeros((len(structure.parents),) * 2, bool)
    first, second = structure.joints[structure.pairs].T
    meet[first, second] = meet[second, first] = True
    above = structure.ancestors.astype(int)
    columns = structure.variables[::-1]
    pattern = (above @ meet @ above.T) > 0
    for one, other in pairs:
        pattern[one, other] = pattern[other, one] = True
    full = random.standard_normal((len(columns),) * 2) * pattern[np.ix_(columns, columns)]
    full = full + full.T
    factor = np.linalg.cholesky(full + np.diag(1 + np.abs(full).sum(1)))
    kept = np.zeros_like(factor, dtype=bool)
    kept[plan.block_row, np.repeat(np.arange(len(columns)), np.diff(plan.block_start))] = True
    assert not (np.abs(factor) > 0)[~kept].any()
