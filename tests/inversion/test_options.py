"""Plain values become the options of a fit."""

import pytest

from soma_core.errors import InputError
from soma_core.inversion.options import inversion_options
from soma_core.inversion.priors import HINGES


def test_plain_values_become_options():
    found = inversion_options(
        {
            "stages": ["transfer", "analytical"], "robust": 0.02, "analytical": {"full": 3},
            "autograd": {"regions": {"hands": 4.0}}, "priors": {"hinges": True, "rest_strength": 0.01},
        }
    )  # fmt: skip
    assert (found["stages"], found["robust"]) == (("transfer", "analytical"), 0.02)
    assert (found["analytical"].full, found["autograd"].regions) == (3, {"hands": 4.0})
    assert (found["priors"].hinges, found["priors"].rest_strength) == (HINGES, 0.01)


def test_without_hinges_every_joint_turns_freely():
    assert inversion_options({"stages": ["transfer"]})["priors"].hinges == {}


def test_a_number_out_of_range_is_refused():
    with pytest.raises(InputError, match=r"analytical\.full: got -1, expected at least 0"):
        inversion_options({"stages": ["analytical"], "analytical": {"full": -1}})
