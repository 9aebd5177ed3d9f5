"""The gallery's random identities: coefficients that differ visibly, and no giants."""

import numpy as np
import pytest

from soma_core.plugin.spec import BackendSpec, Parameter
from soma_core.tasks.gallery import _random_parameters

SPEC = BackendSpec(
    name="x",
    unit="m",
    up="+y",
    forward="+z",
    wrap=None,
    params=(
        Parameter(name="age", default=0.5, range=(0.0, 1.0)),
        Parameter(name="shape", shape=(8,), range=(-3.0, 3.0)),
        Parameter(name="nose", range=(-1.0, 1.0), group="local"),
    ),
)


def test_coefficients_depart_by_about_one_deviation():
    drawn = _random_parameters(SPEC, 4000, np.random.default_rng(0))
    assert set(drawn) == {"age", "shape"}
    size, *builds = np.abs(drawn["shape"]).max(axis=0)
    assert size == pytest.approx(0.7)
    assert builds == pytest.approx([1.2] * 7)
    # A unit normal clipped at 1.2 has a deviation of 0.797; 28,000 draws give it to a percent.
    assert drawn["shape"][:, 1:].std() == pytest.approx(0.797, rel=0.02)
    assert np.ptp(drawn["age"]) > 0.9
