"""Weights spread over twist joints: a smooth partition that folds back to the last bit."""

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st

from assets.make.twist_weights import _exact_parts, _shares, spread_weights
from soma_core.rig import load_canonical
from soma_core.rig.procedural import fold_weights

NODES = (0.0, 0.05, 0.3333333, 0.6666667, 0.95)
ROUNDING = 1e-12


@pytest.fixture(scope="module", params=["mid", "low"])
def rig(request):
    return load_canonical(request.param)[1]


def folded(rig):
    target = np.concatenate([np.arange(rig.joint_count), rig.procedural.start_joints])
    return fold_weights(rig.procedural.weights, target, rig.joint_count)


def test_the_shipped_rig_folds_to_its_own_weights(rig):
    assert abs(folded(rig) - rig.weights).max() < ROUNDING
    assert rig.procedural.weights.data.min() > 0
    assert rig.procedural.weights.shape == (len(rig.bind_shape), 110)


def test_only_the_start_joints_give_weight_away(rig):
    public = rig.procedural.weights[:, : rig.joint_count]
    given_away = abs(public - rig.weights).sum(axis=0)
    starts = np.unique(rig.procedural.start_joints)
    assert np.flatnonzero(given_away > ROUNDING).tolist() == starts.tolist()
    reversed_ones = {segment.start for segment in rig.procedural.definition.segments if segment.reverse}
    kept = {rig.joint_names[joint] for joint in starts if public[:, [joint]].sum() > 0}
    assert kept == {rig.joint_names[joint] for joint in starts} - reversed_ones


def test_the_sum_is_exact_in_single_precision(rig):
    single = scipy.sparse.csr_array(rig.weights, dtype=np.float32).astype(np.float64)
    spread = spread_weights(single, rig.bind_shape, rig.bind_world[:, :3, 3], rig.procedural.definition)
    np.testing.assert_array_equal(spread.data, spread.data.astype(np.float32))
    target = np.concatenate([np.arange(rig.joint_count), rig.procedural.start_joints])
    assert (fold_weights(spread, target, rig.joint_count) != single).nnz == 0


def test_left_and_right_are_spread_alike():
    """As far as the painted weights are alike, which for a few vertices they are not."""
    mesh, rig = load_canonical("low")

    def difference(names, weights):
        swapped = [n.replace("Left", "\0").replace("Right", "Left").replace("\0", "Right") for n in names]
        return abs(weights[mesh.mirror][:, [names.index(name) for name in swapped]] - weights).max()

    painted = difference(rig.joint_names, rig.weights)
    spread = difference((*rig.joint_names, *rig.procedural.joint_names), rig.procedural.weights)
    assert spread < painted + 1e-4  # the source's two sides differ by 2e-7 m


@given(st.lists(st.floats(-1, 2), min_size=1, max_size=20))
def test_shares_are_a_partition(positions):
    shares = _shares(np.array(positions), NODES)
    assert shares.min() >= 0
    np.testing.assert_allclose(shares.sum(1), 1, atol=ROUNDING)


def test_shares_pass_from_one_node_to_the_next():
    """Their mean place never runs back along the bone, and follows it to within the smoothing."""
    position = np.linspace(-0.3, 1.3, 3201)
    place = _shares(position, NODES) @ NODES
    assert np.diff(place).min() > -1e-6
    inside = (position > NODES[0]) & (position < NODES[-1])
    assert np.abs(place - position)[inside].max() < 0.03
    assert place[0] == NODES[0]
    assert place[-1] == NODES[-1]


def test_shares_have_no_creases():
    """Along a twentieth of the bone slopes change by part of what a hat function's do at its node."""
    position = np.linspace(0.2, 0.8, 601)
    slope = np.diff(_shares(position, NODES), axis=0) / np.diff(position)[:, None]
    kink = 2 / (NODES[2] - NODES[1])
    assert np.abs(slope[10:] - slope[:-10]).max() < 0.1 * kink


@given(
    st.lists(st.floats(2.0**-149, 1, width=32, exclude_min=False), min_size=1, max_size=10),
    st.lists(st.floats(0.001, 1), min_size=2, max_size=5),
)
def test_parts_of_any_single_add_up_to_it(weights, shares):
    weights, shares = np.array(weights), np.array(shares)
    parts = _exact_parts(weights, np.tile(shares / shares.sum(), (len(weights), 1)))
    np.testing.assert_array_equal(parts, parts.astype(np.float32))
    np.testing.assert_array_equal(parts.sum(axis=1), weights)
    assert parts.min() >= 0
