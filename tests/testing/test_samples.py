"""Parameter values that checks try: inside the ranges, the same everywhere, grouped ones one at a time."""

from __future__ import annotations

import pytest
import torch

from soma_core.plugin.spec import Parameter
from soma_core.testing.samples import at_range_ends, changed_rows, entry_changes, near_defaults, random_rows

PARAMETERS = (
    Parameter(name="shape", shape=(20,)),
    Parameter(name="size", default=1.0, range=(0.5, 1.2)),
    Parameter(name="nose", range=(-1.0, 1.0), group="face"),
    Parameter(name="ears", default=0.5, range=(0.0, 1.0), group="face"),
)
WIDE = torch.float64


def test_random_rows_lie_in_the_ranges_and_differ():
    rows = random_rows(PARAMETERS, 50, seed=3, dtype=WIDE)
    for item in PARAMETERS:
        value = rows[item.name]
        assert value.shape == (50, *item.shape)
        assert value.min() >= item.range[0]
        assert value.max() <= item.range[1]
        assert value.std() > 0


def test_random_rows_are_reproducible_and_leave_the_global_state():
    before = torch.random.get_rng_state()
    first, again = (random_rows(PARAMETERS, 5, seed=3, dtype=WIDE) for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["size"], random_rows(PARAMETERS, 5, seed=4, dtype=WIDE)["size"])
    assert torch.equal(before, torch.random.get_rng_state())


def test_one_parameter_of_a_group_leaves_its_default_at_a_time():
    rows = random_rows(PARAMETERS, 50, seed=0, dtype=WIDE)
    moved = torch.stack((rows["nose"] != 0, rows["ears"] != 0.5))
    assert (moved.sum(0) <= 1).all()
    assert moved.any(1).all()


@pytest.mark.parametrize("count", [0, 1, 5])
def test_rows_change_one_entry_each_and_leave_groups_out(count):
    changes = entry_changes(PARAMETERS[:2], to="far")[:count]
    rows = changed_rows(PARAMETERS, changes, dtype=WIDE)
    assert set(rows) == {"shape", "size"}
    assert rows["shape"].shape == (count, 20)
    assert int((rows["shape"] != 0).sum() + (rows["size"] != 1).sum()) == count


def test_changes_go_to_the_far_end_and_name_their_entry():
    far = entry_changes(PARAMETERS, to="far")
    assert len(far) == 23
    assert [str(change) for change in (far[19], far[20], far[22])] == ["shape[19]=3", "size=0.5", "ears=1"]
    assert entry_changes(PARAMETERS, to="inner")[20].value == pytest.approx(2 / 3)
    assert len(entry_changes(PARAMETERS, to="far", limit=2)) == 5


def test_both_ends_of_leading_entries():
    assert [str(change) for change in at_range_ends(PARAMETERS)[:2]] == ["shape[0]=-3", "shape[0]=3"]
    assert len(at_range_ends(PARAMETERS)) == 2 * (16 + 3)
    assert at_range_ends((Parameter(name="empty", shape=(0,)),)) == []


def test_near_the_defaults_nothing_is_at_its_default():
    rows = near_defaults(PARAMETERS, dtype=WIDE)
    for item in PARAMETERS:
        away = (rows[item.name] - item.default).abs()
        assert (away > 0).all()
        assert away.max() < 0.2 * (item.range[1] - item.range[0])
