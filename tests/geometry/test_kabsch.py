"""The rotation nearest to a covariance: equal to Kabsch by SVD, whatever the sign and the rank."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.geometry.kabsch import PRIOR_STRENGTH, cofactor, rotation_from_covariance
from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from tests.bodies import randn

ORTHONORMAL = {torch.float32: 2e-6, torch.float64: 1e-14}
"""Rounding of a polar iteration that ends with one averaging step."""
AGREEMENT = {torch.float32: 2e-5, torch.float64: 1e-12}
"""Against SVD of the same matrix, prior included; float32 loses digits to s2 + s s3 >= 0.05."""
DTYPES = [torch.float32, torch.float64]


def frames(count, seed):
    return torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())


def covariance(singular, sign=1.0, count=40, seed=0):
    """Covariances with given singular values and sign of the determinant, in random frames."""
    middle = torch.diag(torch.tensor(singular, dtype=torch.float64) * torch.tensor([1.0, 1.0, sign]))
    return frames(count, seed) @ middle @ frames(count, seed + 1)


def kabsch(matrix):
    """The textbook answer in float64: SVD, and the last axis flipped where the product is a reflection."""
    left, _, right = np.linalg.svd(matrix.double().numpy())
    left[..., :, 2] *= np.linalg.det(left @ right)[..., None]
    return torch.from_numpy(left @ right)


def with_prior(matrix, reference=None):
    """The covariance whose maximiser is meant: the weak pull towards the reference is part of it."""
    reference = torch.eye(3, dtype=matrix.dtype) if reference is None else reference
    return matrix + PRIOR_STRENGTH * matrix.norm(dim=(-1, -2))[..., None, None] * reference


SPECTRA = {
    "isotropic": ([1.0, 1.0, 1.0], 1),
    "limb": ([1.0, 0.02, 0.01], 1),
    "sheet": ([1.0, 0.5, 1e-3], 1),
    "rank two": ([1.0, 0.5, 0.0], 1),
    "rank two, equal": ([1.0, 1.0, 0.0], 1),
    "reflected": ([1.0, 0.7, 0.3], -1),
    "reflected sheet": ([1.0, 0.9, 0.05], -1),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", SPECTRA)
def test_agrees_with_svd(name, dtype):
    given = covariance(*SPECTRA[name]).to(dtype)
    found = rotation_from_covariance(given)
    gap = SPECTRA[name][0][1] + SPECTRA[name][1] * SPECTRA[name][0][2]  # conditioning of the problem
    assert orthonormality_error(found).max() < ORTHONORMAL[dtype]
    atol = AGREEMENT[dtype] * max(1.0, 0.1 / gap)
    torch.testing.assert_close(found.double(), kabsch(with_prior(given.double())), atol=atol, rtol=0)


def test_random_matrices_of_both_signs():
    given = randn(2000, 3, 3, seed=3)
    assert (torch.linalg.det(given) < 0).any()
    assert (torch.linalg.det(given) > 0).any()
    given = given[torch.linalg.svdvals(given) @ torch.tensor([0.0, 1, -1], dtype=given.dtype) > 0.02]
    found = rotation_from_covariance(given)
    assert orthonormality_error(found).max() < ORTHONORMAL[torch.float64]
    torch.testing.assert_close(found, kabsch(with_prior(given)), atol=1e-11, rtol=0)


def test_maximises_the_inner_product():
    """No rotation nearby scores higher: the defining property, without SVD."""
    given = with_prior(randn(50, 3, 3, seed=4))
    found = rotation_from_covariance(randn(50, 3, 3, seed=4))
    best = (found * given).sum((-1, -2))
    for seed in range(20):
        other = axis_angle_to_matrix(randn(50, 3, seed=10 + seed)) @ found
        assert (best >= (other * given).sum((-1, -2)) - 1e-12).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_recovers_the_rotation_of_a_cloud(count, dtype):
    """Exact data: H = R S with S positive semi-definite; the prior may pull by its own strength."""
    cloud = randn(count + 1, 3, seed=5)
    turn = frames(6, 6)
    given = ((turn @ (cloud.T @ cloud)).to(dtype)).contiguous()
    found = rotation_from_covariance(given).double()
    singular = torch.linalg.svdvals(cloud.T @ cloud)
    slack = 3 * PRIOR_STRENGTH * float(torch.linalg.vector_norm(singular) / (singular[1] + singular[2]))
    torch.testing.assert_close(found, turn, atol=slack, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_no_cloud_gives_the_reference(dtype):
    zero, reference = torch.zeros(5, 3, 3, dtype=dtype), frames(5, 8).to(dtype)
    eye = torch.eye(3, dtype=dtype).expand(5, 3, 3)
    torch.testing.assert_close(rotation_from_covariance(zero), eye, atol=ORTHONORMAL[dtype], rtol=0)
    found = rotation_from_covariance(zero, reference=reference)
    torch.testing.assert_close(found, reference, atol=4 * ORTHONORMAL[dtype], rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_rank_one_maps_the_direction_and_follows_the_reference_about_it(dtype):
    direction = torch.nn.functional.normalize(randn(30, 3, seed=9), dim=-1)
    target = torch.nn.functional.normalize(direction + 0.5 * randn(30, 3, seed=10), dim=-1)
    given = (target[:, :, None] * direction[:, None, :]).to(dtype)
    found = rotation_from_covariance(given).double()
    assert orthonormality_error(found).max() < 10 * ORTHONORMAL[dtype]
    turned = (found @ direction[..., None]).squeeze(-1)
    rounding = 1e-8 / PRIOR_STRENGTH if dtype == torch.float32 else 0  # of H, against the pull that decides
    torch.testing.assert_close(turned, target, atol=3 * PRIOR_STRENGTH + rounding, rtol=0)
    if dtype == torch.float64:
        torch.testing.assert_close(found, kabsch(with_prior(given)), atol=1e-9, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "singular", [[1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.5, 0.5], [1.0, 1e-5, 1e-5], [0.0, 0.0, 0.0]]
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_degenerate_spectra_stay_finite_and_orthonormal(singular, sign, dtype):
    given = covariance(singular, sign).to(dtype).requires_grad_()
    found = rotation_from_covariance(given)
    assert orthonormality_error(found).max() < 1e-4  # the maximiser itself is not unique here
    (grad,) = torch.autograd.grad((found * randn(3, 3, seed=11, dtype=dtype)).sum(), given)
    assert grad.isfinite().all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("exponent", [-8, -4, 4, 8])
def test_scale_does_not_matter(exponent, dtype):
    given = randn(100, 3, 3, seed=12).to(dtype)
    scaled = rotation_from_covariance(given * 10.0**exponent)
    torch.testing.assert_close(scaled, rotation_from_covariance(given), atol=300 * ORTHONORMAL[dtype], rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "diagonal", [[-1, -1, -1], [-1, 0, 0], [0, -1, 0], [1, 1, -1], [-1, -1, 1], [1, -1, 0]]
)
def test_exact_ties_along_the_axes_still_give_a_rotation(diagonal, dtype):
    """Round numbers meet s2 + s s3 = 0 exactly, where generic frames only come near."""
    given = torch.diag(torch.tensor(diagonal, dtype=dtype)).requires_grad_()
    found = rotation_from_covariance(given)
    assert orthonormality_error(found) < 10 * ORTHONORMAL[dtype]
    (grad,) = torch.autograd.grad(found.sum(), given)
    assert grad.isfinite().all()


def test_equivariant():
    given, left, right = randn(50, 3, 3, seed=13), frames(50, 14), frames(50, 15)
    found = rotation_from_covariance(left @ given @ right, reference=left @ right)
    torch.testing.assert_close(found, left @ rotation_from_covariance(given) @ right, atol=1e-10, rtol=0)


def test_any_leading_shape():
    given = randn(2, 3, 4, 3, 3, seed=16)
    torch.testing.assert_close(
        rotation_from_covariance(given)[1, 2, 3], rotation_from_covariance(given[1, 2, 3])
    )
    assert rotation_from_covariance(given[:0]).shape == (0, 3, 4, 3, 3)


GRADIENT_SPECTRA = [
    ([1.0, 0.6, 0.3], 1),
    ([1.0, 0.6, 0.3], -1),
    ([1.0, 1.0, 1.0], 1),
    ([1.0, 0.5, 0.0], 1),
    ([1.0, 0.02, 0.01], 1),
    ([1.0, 1e-3, 1e-4], 1),
]


@pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated:DeprecationWarning")
@pytest.mark.parametrize(("singular", "sign"), GRADIENT_SPECTRA)
def test_gradcheck(singular, sign, fast_mode):
    given = covariance(singular, sign, count=3, seed=20).requires_grad_()
    # The smallest gap bounds the curvature, so it sets the step of the finite differences.
    gap = singular[1] + sign * singular[2]
    assert torch.autograd.gradcheck(
        rotation_from_covariance,
        given,
        eps=1e-6 * gap,
        atol=1e-5 / gap,
        rtol=1e-4,
        check_forward_ad=True,
        fast_mode=fast_mode,
    )
    each = torch.func.vmap(torch.func.jacfwd(rotation_from_covariance))(given.detach())
    whole = torch.func.jacrev(rotation_from_covariance)(given.detach())
    own = torch.stack([whole[k, :, :, k] for k in range(3)])
    torch.testing.assert_close(each, own, atol=1e-9 / gap, rtol=0)


def test_gradcheck_on_the_scale_of_a_finger():
    given = (1e-5 * covariance([1.0, 0.3, 0.1], count=3, seed=21)).requires_grad_()
    assert torch.autograd.gradcheck(rotation_from_covariance, given, eps=1e-11, atol=1.0, rtol=1e-4)


def test_cofactor_of_a_regular_matrix():
    given = randn(20, 3, 3, seed=22)
    expected = torch.linalg.det(given)[:, None, None] * torch.linalg.inv(given).transpose(-1, -2)
    torch.testing.assert_close(cofactor(given), expected)
