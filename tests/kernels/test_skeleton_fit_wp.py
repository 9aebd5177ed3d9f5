"""The Warp rotation fit against the torch reference, degenerate joints included."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.geometry.rotations import orthonormality_error
from soma_core.kernels.skeleton_fit_wp import fit_displacements
from soma_core.rig import load_canonical
from soma_core.skeleton.fit import SkeletonFit
from soma_core.skeleton.rotations import RotationFit
from tests.bodies import CPU, randn, tiny_canonical
from tests.kernels.parity import BATCHES, DEVICES, DTYPES, assert_twins
from tests.skeleton.test_fit import lumps

MESH, RIG = tiny_canonical()
ORTHONORMAL = {torch.float32: 2e-6, torch.float64: 1e-13}


def twins(rig, dtype, device=CPU):
    return [RotationFit(rig, dtype=dtype, device=device, warp=warp) for warp in (False, True)]


def moments(mesh, rig, batch, seed=0):
    """Joints and covariances of lumpy bodies, float64."""
    fit = SkeletonFit(mesh, rig, dtype=torch.float64, device=CPU)
    flat = lumps(mesh.vertices, batch, size=0.03, seed=seed).permute(1, 2, 0).reshape(mesh.vertex_count, -1)
    found = fit.moments(flat).view(rig.joint_count, 4, 3, batch).permute(3, 0, 1, 2)
    return found[:, :, 0].contiguous(), found[:, :, 1:].mT.contiguous()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
def test_parity(batch, dtype, device):
    inputs = [part.to(device, dtype) for part in moments(MESH, RIG, batch)]
    assert_twins(*twins(RIG, dtype, device), inputs, dtype=dtype)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_parity_on_the_real_rig(dtype, device):
    mesh, rig = load_canonical("low")
    inputs = [part.to(device, dtype) for part in moments(mesh, rig, 3)]
    assert_twins(*twins(rig, dtype, device), inputs, dtype=dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_parity_of_strided_inputs(dtype):
    joints, covariances = moments(MESH, RIG, 3)
    joints, covariances = joints.mT.contiguous().mT.to(dtype), covariances.mT.contiguous().mT.to(dtype)
    assert not covariances.is_contiguous()
    torch_fit, warp_fit = twins(RIG, dtype)
    torch.testing.assert_close(
        warp_fit(joints, covariances), torch_fit(joints, covariances), atol=1e-5, rtol=0
    )


DEGENERATE = {
    "no cloud": torch.zeros(3, 3, dtype=torch.float64),
    "a line": torch.outer(torch.tensor([0.3, 1.0, -0.2]), torch.tensor([1.0, 0.1, 0.4])).double(),
    "a reflected line": -torch.outer(torch.tensor([1.0, 0, 0]), torch.tensor([1.0, 0, 0])).double(),
    "a sheet": torch.diag(torch.tensor([1.0, 0.4, 0.0], dtype=torch.float64)),
    "a reflection": torch.diag(torch.tensor([1.0, 0.5, -0.2], dtype=torch.float64)),
    "inside out": -torch.eye(3, dtype=torch.float64),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", DEGENERATE)
@pytest.mark.parametrize("twin", ["torch", "warp"])
def test_degenerate_clouds_stay_finite_and_orthonormal(twin, kind, dtype):
    joints, covariances = moments(MESH, RIG, 2)
    covariances = DEGENERATE[kind].expand_as(covariances).contiguous().to(dtype).requires_grad_()
    joints = joints.to(dtype).requires_grad_()
    rotations = twins(RIG, dtype)[twin == "warp"](joints, covariances)
    assert orthonormality_error(rotations).max() < 1e-4
    for grad in torch.autograd.grad(rotations.square().sum() + rotations.sum(), (joints, covariances)):
        assert grad.isfinite().all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["no cloud", "a sheet", "a reflection"])
def test_degenerate_clouds_with_one_answer_agree(kind, dtype):
    joints, _ = moments(MESH, RIG, 2)
    covariances = DEGENERATE[kind].expand(2, RIG.joint_count, 3, 3).contiguous()
    torch_fit, warp_fit = twins(RIG, dtype)
    inputs = joints.to(dtype), covariances.to(dtype)
    torch.testing.assert_close(warp_fit(*inputs), torch_fit(*inputs), atol=2e-5, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["opposite", "vanished", "flat"])
def test_degenerate_bones_stay_finite_and_agree(kind, dtype):
    joints = torch.as_tensor(np.array(RIG.bind_world[:, :3, 3]))[None]
    change = {"opposite": [-1.0, -1, -1], "vanished": [0.0, 0, 0], "flat": [1.0, 1, 0]}[kind]
    joints = (joints * torch.tensor(change, dtype=torch.float64)).to(dtype).requires_grad_()
    covariances = torch.eye(3, dtype=dtype).expand(1, RIG.joint_count, 3, 3).contiguous().requires_grad_()
    results = [fit(joints, covariances) for fit in twins(RIG, dtype)]
    for rotations in results:
        assert orthonormality_error(rotations).max() < 1e-4
        for grad in torch.autograd.grad(rotations.sum(), (joints, covariances)):
            assert grad.isfinite().all()
    if kind != "opposite":  # any axis will do there, and rounding picks it
        torch.testing.assert_close(*results, atol=2e-5, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_orthonormal_on_random_covariances(dtype):
    joints = randn(8, RIG.joint_count, 3, seed=4, dtype=dtype)
    rotations = twins(RIG, dtype)[1](joints, randn(8, RIG.joint_count, 3, 3, seed=5, dtype=dtype))
    assert orthonormality_error(rotations).max() < ORTHONORMAL[dtype]


def arguments(batch=2, dtype=torch.float64):
    fit = RotationFit(RIG, dtype=dtype, device=CPU, warp=True)
    joints, covariances = (part.to(dtype) for part in moments(MESH, RIG, batch))
    return joints, covariances, fit.bind, fit.pivots, fit.child_table


def test_gradcheck():
    joints, covariances, *constants = arguments()
    inputs = joints.requires_grad_(), covariances.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda j, c: fit_displacements(j, c, *constants), inputs, atol=1e-5, fast_mode=True
    )


def test_turned_bodies_turn_with_the_rotation():
    """Rigid motion of the whole cloud, up to the weak pull: catches a transposed convention."""
    joints, covariances, *constants = arguments()
    turn = torch.from_numpy(Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix())
    still = fit_displacements(joints, covariances, *constants)
    turned = fit_displacements((joints @ turn.T).contiguous(), (turn @ covariances).contiguous(), *constants)
    torch.testing.assert_close(turned, turn @ still, atol=1e-3, rtol=0)


def test_half_precision_is_refused_by_name():
    joints, covariances, bind, *constants = arguments()
    with pytest.raises(
        InputError, match=r"dtype: got torch.float16, expected torch.float32 or torch.float64"
    ):
        fit_displacements(joints.half(), covariances.half(), bind.half(), *constants)


def test_operator_is_registered_soundly():
    joints, covariances, *constants = arguments()
    args = (joints.requires_grad_(), covariances.requires_grad_(), *constants)
    torch.library.opcheck(torch.ops.soma_core.fit_displacements.default, args)


def test_empty_batch():
    joints, covariances, bind, pivots, table = arguments()
    assert fit_displacements(joints[:0], covariances[:0], bind, pivots, table).shape == (0, len(pivots), 3, 3)
