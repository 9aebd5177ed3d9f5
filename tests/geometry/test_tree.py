import numpy as np
import pytest

from soma_core.geometry.tree import depth_order, descendants, joint_levels

PARENTS = np.array([-1, 0, 1, 1, 3, 0])


def chain(joint):
    """A joint and all above it."""
    return [joint, *(chain(PARENTS[joint]) if PARENTS[joint] >= 0 else [])]


def test_descendants_are_the_joints_whose_chain_passes():
    below = descendants(PARENTS)
    for joint in range(len(PARENTS)):
        assert np.flatnonzero(below[:, joint]).tolist() == sorted(chain(joint))


def test_every_level_hangs_on_the_one_before():
    levels = joint_levels(PARENTS)
    assert [level.tolist() for level in levels] == [[1, 5], [2, 3], [4]]
    for above, level in zip([np.array([0]), *levels], levels, strict=False):
        assert set(PARENTS[level]) <= set(above.tolist())


@pytest.mark.parametrize("seed", range(3))
def test_depth_order_puts_parents_first_whatever_the_order(seed):
    shuffle = np.random.default_rng(seed).permutation(len(PARENTS))
    place = np.append(np.argsort(shuffle), -1)
    parents = place[PARENTS[shuffle]]
    order = depth_order(parents).tolist()
    assert all(parents[joint] < 0 or order.index(parents[joint]) < order.index(joint) for joint in order)


def test_a_forest_has_several_roots():
    parents = np.array([-1, -1, 1])
    assert descendants(parents).tolist() == [[1, 0, 0], [0, 1, 1], [0, 0, 1]]
    assert depth_order(parents).tolist() == [0, 1, 2]
