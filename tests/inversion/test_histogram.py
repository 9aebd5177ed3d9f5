"""Quantiles without the numbers: right to 0.1 % whatever their scale."""

import numpy as np
import pytest

from soma_core.inversion.histogram import BIN_COUNT, bin_counts, quantile

RELATIVE_TOLERANCE = 1.5e-3
"""A bin is 0.1 % wide; with 100,000 numbers neighbours add a little."""


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 3.0])
@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_quantiles_agree_with_those_of_the_numbers(scale, share):
    values = scale * np.random.default_rng(0).gamma(2.0, size=100_000).astype(np.float32)
    found = quantile(bin_counts(values), share)
    assert abs(found / np.quantile(values, share) - 1) < RELATIVE_TOLERANCE


def test_counts_of_parts_add_up():
    values = np.random.default_rng(0).gamma(2.0, size=1000).astype(np.float32)
    parts = bin_counts(values[:300]) + bin_counts(values[300:])
    np.testing.assert_array_equal(parts, bin_counts(values))
    assert parts.sum() == 1000


def test_numbers_outside_the_bins_count_at_the_ends():
    counts = bin_counts(np.array([0.0, 1e-30, 1e9], np.float32))
    assert (counts[0], counts[-1], len(counts)) == (2, 1, BIN_COUNT)
    assert quantile(counts, 0.1) < 1e-10


def test_nothing_has_no_quantile():
    assert np.isnan(quantile(bin_counts(np.empty(0, np.float32)), 0.5))
