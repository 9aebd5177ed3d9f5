"""Skinning against the dense definition with every influence; the shared path against the general one."""

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core.animation.skinning import Skinning, skinning_transforms
from soma_core.rig import load_canonical
from tests.animation.test_kinematics import bodies, turns
from tests.bodies import CPU, randn, tiny_canonical
from tests.kernels.parity import quick

ROUNDING = {torch.float32: 3e-6, torch.float64: 1e-13}
"""Metres, on bodies of two metres and transforms of order one."""
GRADIENT = {torch.float32: 1e-4, torch.float64: 1e-11}
"""Sums over hundreds of vertices."""
MESH, RIG = tiny_canonical()
DTYPES = [torch.float32, torch.float64]
BATCHES = quick(1, 33, slow=[2, 31, 32, 70])
"""Around the sizes at which batches are cut into parts."""


def build(dtype=torch.float64, weights=RIG.weights):
    return Skinning(weights, dtype=dtype, device=CPU)


def case(batch, dtype, seed=0, shared=False):
    rest = torch.as_tensor(MESH.vertices) + 0.02 * randn(
        1 if shared else batch, MESH.vertex_count, 3, seed=seed
    )
    transforms = randn(batch, RIG.joint_count, 3, 4, seed=seed + 1)
    return rest.to(dtype).requires_grad_(), transforms.to(dtype).requires_grad_()


def general(skinning, rest, transforms):
    return skinning(rest.permute(2, 1, 0), transforms, rows=True)


def dense(rest, transforms, weights=RIG.weights):
    """The definition: weigh every joint's transform, zero weights included."""
    blended = torch.einsum("vj,bjac->bvac", torch.as_tensor(weights.toarray(), dtype=rest.dtype), transforms)
    homogeneous = torch.cat((rest, torch.ones_like(rest[..., :1])), -1)
    return (blended @ homogeneous[..., None]).squeeze(-1)


def compare(functions, inputs, dtype, pull):
    """Values and gradients of two functions of the same inputs."""
    results = [function(*inputs) for function in functions]
    torch.testing.assert_close(
        *results, atol=10 * ROUNDING[dtype], rtol=1e-5 if dtype == torch.float32 else 1e-12
    )
    wanted = [part for part in inputs if part.requires_grad]
    grads = [torch.autograd.grad((result * pull).sum(), wanted) for result in results]
    for one, other in zip(*grads, strict=True):
        torch.testing.assert_close(one, other, atol=GRADIENT[dtype] * float(other.abs().max()), rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
def test_equals_the_dense_definition(batch, dtype):
    skinning = build(dtype)
    pull = randn(batch, MESH.vertex_count, 3, seed=5, dtype=dtype)
    compare((lambda *x: general(skinning, *x), dense), case(batch, dtype), dtype, pull)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
def test_one_body_in_many_poses(batch, dtype):
    skinning = build(dtype)
    pull = randn(batch, MESH.vertex_count, 3, seed=6, dtype=dtype)
    compare((lambda *x: general(skinning, *x), dense), case(batch, dtype, shared=True), dtype, pull)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
def test_shared_path_is_the_general_path(batch, dtype):
    skinning = build(dtype)
    rest, transforms = case(batch, dtype, shared=True)
    rest = rest.detach()
    pull = randn(batch, MESH.vertex_count, 3, seed=7, dtype=dtype)
    functions = (lambda x: skinning.shared(rest[0], x), lambda x: general(skinning, rest, x))
    compare(functions, (transforms,), dtype, pull)


def test_planes_and_rows_are_two_layouts_of_one_result():
    skinning = build()
    rest, transforms = case(40, torch.float64)
    planes = skinning(rest.permute(2, 1, 0), transforms, rows=False)
    assert planes.shape == (3, MESH.vertex_count, 40)
    rows = general(skinning, rest, transforms)
    assert rows.is_contiguous()
    assert torch.equal(planes.permute(2, 1, 0), rows)
    pull = randn(40, MESH.vertex_count, 3, seed=8)
    grads = [
        torch.autograd.grad((result * pull).sum(), (rest, transforms))
        for result in (planes.permute(2, 1, 0), rows)
    ]
    for one, other in zip(*grads, strict=True):
        torch.testing.assert_close(one, other)


def test_every_influence_counts():
    """The rig has vertices with more influences than any usual cap; leaving the least out would show."""
    counts = np.diff(RIG.weights.indptr)
    assert counts.max() > 8
    rest, transforms = case(2, torch.float64)
    full = general(build(), rest, transforms)
    capped = RIG.weights.toarray()
    capped[capped < np.sort(capped, 1)[:, [-8]]] = 0
    capped = scipy.sparse.csr_array(capped / capped.sum(1, keepdims=True))
    torch.testing.assert_close(full, dense(rest, transforms))
    assert (general(build(weights=capped), rest, transforms) - full).abs().max() > 1e-4


def test_real_rig():
    mesh, rig = load_canonical("low")
    skinning = build(weights=rig.weights)
    rest = torch.from_numpy(np.array(mesh.vertices))[None]
    transforms = randn(3, rig.joint_count, 3, 4, seed=9)
    expected = dense(rest.expand(3, -1, 3), transforms, rig.weights)
    torch.testing.assert_close(general(skinning, rest, transforms), expected)
    torch.testing.assert_close(skinning.shared(rest[0], transforms), expected)


@pytest.mark.parametrize("batch", [1, 3])
def test_gradcheck(batch, fast_mode):
    few = RIG.weights[np.arange(0, MESH.vertex_count, 60)]
    skinning = build(weights=scipy.sparse.csr_array(few))
    rest = randn(batch, few.shape[0], 3, seed=10).requires_grad_()
    transforms = randn(batch, RIG.joint_count, 3, 4, seed=11).requires_grad_()
    assert torch.autograd.gradcheck(lambda *x: general(skinning, *x), (rest, transforms), fast_mode=fast_mode)
    shared = rest[0].detach()
    assert torch.autograd.gradcheck(lambda x: skinning.shared(shared, x), transforms, fast_mode=fast_mode)


def test_gradients_only_for_inputs_that_ask():
    rest, transforms = case(3, torch.float64)
    for part, other in ((rest, transforms.detach()), (transforms, rest.detach())):
        inputs = (part, other) if part is rest else (other, part)
        (grad,) = torch.autograd.grad(general(build(), *inputs).sum(), part)
        assert grad.isfinite().all()


def test_joints_without_weight_and_vertices_without_influence():
    dense_weights = RIG.weights.toarray()
    dense_weights[7] = 0
    rest, transforms = case(2, torch.float64)
    out = general(build(weights=scipy.sparse.csr_array(dense_weights)), rest, transforms)
    assert torch.equal(out[:, 7], torch.zeros(2, 3, dtype=torch.float64))
    (grad,) = torch.autograd.grad(out.sum(), transforms)
    assert torch.equal(grad[:, 0], torch.zeros(2, 3, 4, dtype=torch.float64))  # Root carries nothing


@pytest.mark.parametrize("batch", [5, 40])
def test_permuting_the_batch_permutes_the_result(batch):
    rest, transforms = case(batch, torch.float64)
    order = torch.randperm(batch, generator=torch.Generator().manual_seed(0))
    result = general(build(), rest[order], transforms[order])
    assert torch.equal(result, general(build(), rest, transforms)[order])


def test_a_pose_does_not_depend_on_the_size_of_its_batch():
    rest, transforms = case(40, torch.float32)
    together = general(build(torch.float32), rest, transforms)
    for index in (0, 35):
        alone = general(build(torch.float32), rest[index : index + 1], transforms[index : index + 1])
        torch.testing.assert_close(alone[0], together[index], atol=ROUNDING[torch.float32], rtol=0)


def test_inputs_are_not_changed():
    rest, transforms = case(3, torch.float64)
    before = rest.detach().clone(), transforms.detach().clone()
    out = general(build(), rest, transforms)
    out.sum().backward()
    build().shared(rest[0].detach(), transforms).sum().backward()
    assert torch.equal(rest, before[0])
    assert torch.equal(transforms, before[1])


def test_partition_of_unity():
    """One transform for all joints moves the body rigidly, whatever the weights."""
    transform = randn(1, 1, 3, 4, seed=12).expand(1, RIG.joint_count, 3, 4).contiguous()
    rest, _ = case(1, torch.float64)
    expected = rest @ transform[0, 0, :, :3].T + transform[0, 0, :, 3]
    torch.testing.assert_close(general(build(), rest, transform), expected)


def test_transforms_take_the_bind_pose_to_the_posed_one():
    bind, posed = bodies(RIG, 2), bodies(RIG, 2, seed=1)
    posed[:, :, :3, :3] = turns(RIG, 2, seed=2)[:, [0, *range(RIG.joint_count - 1)]] @ posed[:, :, :3, :3]
    found = skinning_transforms(posed[..., :3, :3], posed[..., :3, 3], bind)
    torch.testing.assert_close(found, (posed @ torch.linalg.inv(bind))[..., :3, :])
    one = skinning_transforms(posed[..., :3, :3], posed[..., :3, 3], bind[:1])
    torch.testing.assert_close(one[1], (posed[1] @ torch.linalg.inv(bind[0]))[..., :3, :])


@pytest.mark.parametrize("rows", [True, False])
@pytest.mark.parametrize("shared", [True, False])
def test_operator_is_registered_soundly(rows, shared):
    """Schema, shapes without data, autograd and tracing, by torch's own checker."""
    weights = build().weights
    rest, transforms = case(3, torch.float64, shared=shared)
    leaves = (
        part.detach().requires_grad_() for part in (rest.permute(2, 1, 0), transforms.permute(2, 3, 1, 0))
    )
    args = (*leaves, rows, [*weights.csr, *weights.transpose])
    torch.library.opcheck(torch.ops.soma_core.blend.default, args)
