"""The sparse product equals the dense one, forward and backward."""

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core.geometry.sparse import SparseRows, gather_rows
from tests.bodies import CPU, randn

ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-13}
"""Sums of about ten products of order one."""
DTYPES = [torch.float32, torch.float64]


def matrix(rows=30, columns=20, density=0.2, seed=0):
    """Random, with empty rows and an empty column, indices shuffled within rows."""
    dense = scipy.sparse.random_array(
        (rows, columns), density=density, rng=np.random.default_rng(seed), format="csr"
    ).toarray()
    dense[[0, rows - 1]] = 0
    dense[:, columns // 2] = 0
    made = scipy.sparse.csr_array(dense)
    for row in range(rows):  # scipy does not promise sorted rows
        part = slice(made.indptr[row], made.indptr[row + 1])
        made.indices[part], made.data[part] = made.indices[part][::-1].copy(), made.data[part][::-1].copy()
    made.has_sorted_indices = False
    return made, dense


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("width", [0, 1, 3, 96])
def test_equals_the_dense_product(width, dtype):
    sparse, dense = matrix()
    operator = SparseRows(sparse, dtype=dtype, device=CPU)
    assert operator.shape == (30, 20)
    given = randn(20, width, seed=1, dtype=dtype).requires_grad_()
    twin = given.detach().clone().requires_grad_()
    out, expected = operator(given), torch.as_tensor(dense, dtype=dtype) @ twin
    torch.testing.assert_close(out, expected, atol=ROUNDING[dtype], rtol=0)
    pull = randn(30, width, seed=2, dtype=dtype)
    out.backward(pull)
    expected.backward(pull)
    torch.testing.assert_close(given.grad, twin.grad, atol=ROUNDING[dtype], rtol=0)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated:DeprecationWarning")
def test_gradcheck():
    operator = SparseRows(matrix()[0], dtype=torch.float64, device=CPU)
    given = randn(20, 2, seed=3).requires_grad_()
    assert torch.autograd.gradcheck(operator, given, check_forward_ad=True)
    many = randn(3, 20, 2, seed=4)
    torch.testing.assert_close(torch.func.vmap(operator)(many), torch.stack([operator(one) for one in many]))
    curved = torch.func.hessian(lambda dense: operator(dense).square().sum() / 2)(many[0])
    dense = torch.as_tensor(matrix()[0].toarray())
    expected = torch.einsum("va,vb,fg->afbg", dense, dense, torch.eye(2, dtype=torch.float64))
    torch.testing.assert_close(curved, expected)


def test_backward_accepts_gradients_that_are_not_contiguous():
    operator = SparseRows(matrix()[0], dtype=torch.float64, device=CPU)
    given = randn(20, 4, seed=4).requires_grad_()
    (strided,) = torch.autograd.grad(operator(given).t().sum(0).sum(), given)
    (expanded,) = torch.autograd.grad(operator(given).sum(), given)  # an expanded gradient
    torch.testing.assert_close(strided, expanded)


def test_results_are_deterministic():
    operator = SparseRows(matrix(300, 200, 0.3)[0], dtype=torch.float32, device=CPU)
    given = randn(200, 33, seed=5, dtype=torch.float32)
    assert torch.equal(operator(given), operator(given.clone()))


@pytest.mark.parametrize("shape", [(4, 3), (1, 3), (4, 1)])
def test_a_matrix_without_entries_gives_zeros(shape):
    operator = SparseRows(scipy.sparse.csr_array(shape), dtype=torch.float64, device=CPU)
    given = randn(shape[1], 2).requires_grad_()
    out = operator(given)
    assert torch.equal(out, torch.zeros(shape[0], 2, dtype=torch.float64))
    assert torch.equal(torch.autograd.grad(out.sum(), given)[0], torch.zeros_like(given))


def test_gather_rows_takes_a_matrix_and_its_transpose():
    sparse, dense = matrix()
    operator = SparseRows(sparse, dtype=torch.float64, device=CPU)
    given = randn(30, 2, seed=6)
    turned = gather_rows(given, operator.transpose, operator.csr)
    torch.testing.assert_close(turned, torch.as_tensor(dense).T @ given)


def test_constants_are_buffers_outside_the_state_dict():
    operator = SparseRows(matrix()[0], dtype=torch.float64, device=CPU)
    assert len(list(operator.buffers())) == 6
    assert not operator.state_dict()
    assert not list(operator.parameters())


def test_the_callers_matrix_is_not_shared():
    sparse, dense = matrix()
    operator = SparseRows(sparse, dtype=torch.float64, device=CPU)
    sparse.data[:] = 0
    given = randn(20, 2)
    torch.testing.assert_close(operator(given), torch.as_tensor(dense) @ given)
