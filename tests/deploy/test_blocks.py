"""Blocks give the sparse product, whatever the pattern, and hold far fewer zeros than the dense matrix."""

import itertools

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core.animation.skinning import Skinning
from soma_core.deploy import blocks
from soma_core.deploy.blocks import BlockRows, BlockSkinning, split_rows
from soma_core.deploy.correctives import alike, equal_parts
from tests.bodies import CPU, randn

ROUNDING = 1e-12
"""Of float64, for sums of some tens of products of order one."""


def patchy(rows, columns, seed=0):
    """Rows of four kinds, each on columns of its own, one of them without entries, in random order."""
    random = np.random.default_rng(seed)
    dense = np.zeros((rows, columns))
    kinds = random.integers(0, 4, rows)
    for kind in range(3):
        mine, part = np.flatnonzero(kinds == kind), slice(kind * columns // 4, (kind + 2) * columns // 4)
        dense[mine, part] = random.normal(size=(len(mine), part.stop - part.start))
    return scipy.sparse.csr_array(dense), dense


def product(matrix, dense):
    return BlockRows(matrix, dtype=torch.float64, device=CPU)(dense)


@pytest.mark.parametrize("gain", [0, 20_000])
@pytest.mark.parametrize("shape", [(40, 12), (7, 30), (1, 4)])
def test_the_product_is_that_of_the_matrix(monkeypatch, gain, shape):
    monkeypatch.setattr(blocks, "_LEAST_GAIN", gain)
    matrix, dense = patchy(*shape)
    right = randn(shape[1], 5)
    assert (product(matrix, right) - torch.as_tensor(dense) @ right).abs().max() < ROUNDING


@pytest.mark.parametrize("density", [0.01, 0.5])
def test_wide_matrices_are_gathered_or_dense(monkeypatch, density):
    monkeypatch.setattr(blocks, "_WIDEST", 10)
    random = np.random.default_rng(1)
    dense = np.where(random.uniform(size=(30, 60)) < density, random.normal(size=(30, 60)), 0)
    right = randn(60, 3)
    found = product(scipy.sparse.csr_array(dense), right)
    assert (found - torch.as_tensor(dense) @ right).abs().max() < ROUNDING


def test_a_matrix_without_entries_gives_zeros():
    assert not product(scipy.sparse.csr_array((3, 4)), randn(4, 2)).any()


def test_a_split_keeps_each_row_once_and_spares_zeros(monkeypatch):
    monkeypatch.setattr(blocks, "_LEAST_GAIN", 50)
    matrix, dense = patchy(200, 40)
    parts = split_rows(matrix)
    assert sorted(np.concatenate(parts)) == np.flatnonzero(dense.any(1)).tolist()
    held = sum(len(rows) * np.count_nonzero(dense[rows].any(0)) for rows in parts)
    assert held < 1.2 * matrix.nnz < 0.5 * dense.size


@pytest.mark.parametrize("bodies", [1, 4])
@pytest.mark.parametrize("rows", [True, False])
def test_skinning_is_that_of_the_layer(bodies, rows):
    weights = scipy.sparse.csr_array(np.random.default_rng(0).dirichlet(np.ones(6), 50))
    mine, theirs = (kind(weights, dtype=torch.float64, device=CPU) for kind in (BlockSkinning, Skinning))
    points, transforms = randn(3, 50, bodies), randn(4, 6, 3, 4)
    found, wanted = (each(points, transforms, rows=rows) for each in (mine, theirs))
    assert found.shape == wanted.shape
    assert (found - wanted).abs().max() < ROUNDING
    one = points[:, :, 0].T
    assert (mine.shared(one, transforms) - theirs.shared(one, transforms)).abs().max() < ROUNDING


@pytest.mark.parametrize("widths", [[9, 9, 8, 5, 5, 5, 2, 1], [3], [4, 4, 4]])
@pytest.mark.parametrize("parts", [1, 2, 3])
def test_runs_of_equal_width_waste_least(widths, parts):
    wide = np.array(widths)

    def waste(ends):
        begins = [0, *ends[:-1]]
        return sum((end - begin) * wide[begin] for begin, end in zip(begins, ends, strict=True)) - wide.sum()

    found = equal_parts(wide, parts)
    cuts = itertools.combinations(range(1, len(wide)), min(parts, len(set(widths))) - 1)
    assert found[-1] == len(wide)
    assert waste(found) == min(waste([*cut, len(wide)]) for cut in cuts)


def test_rows_that_use_the_same_columns_stand_together():
    _, dense = patchy(60, 12)
    kinds = [tuple(row) for row in (dense != 0)[alike(dense != 0)]]
    assert sum(kinds[i] != kinds[i + 1] for i in range(59)) == len(set(kinds)) - 1
    assert sorted(alike(dense != 0)) == list(range(60))
