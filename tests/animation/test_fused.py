"""The forward pose in two kernels against the layer that it stands in for, and what it reads on the way."""

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core.animation import fused as fused_module
from soma_core.animation.engine import ProceduralAnimation
from soma_core.animation.fused import FusedPose
from soma_core.animation.posed import Posed
from soma_core.kernels.patches import Patches, side_by_side
from soma_core.layer import SomaLayer
from soma_core.rig import load_canonical
from tests.animation.test_twist import ALIGNED, EULER, SWING, with_modes
from tests.bodies import CPU, randn
from tests.kernels.parity import DTYPES, GRADIENTS, VALUES_M, quick

PARTS = ("vertices", "joints", "transforms")
GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
WAYS = [("cpu", False), ("cpu", True), pytest.param("cuda", True, marks=GPU)]
"""Device, and whether by patches: in SIMD lanes, as a GPU does it, on a GPU."""


def assert_same(got: Posed, expected: Posed):
    for name in PARTS:
        one, other = getattr(got, name), getattr(expected, name)
        assert one.dtype == other.dtype
        torch.testing.assert_close(one.cpu(), other.cpu(), atol=VALUES_M[one.dtype], rtol=0)


def poses(layer, batch, seed=0):
    kind = {"dtype": layer.dtype}
    rotations = 0.7 * randn(batch, 77, 3, seed=seed, **kind)
    return rotations.to(layer.device), randn(batch, 3, seed=seed + 1, **kind).to(layer.device)


def shapes(layer, count, seed=5):
    return {"shape": randn(count, 128, seed=seed, dtype=layer.dtype).to(layer.device)}


def fast_twin(layer, device=CPU, *, by_patches=True, **options):
    """The same layer with kernels for what needs no gradient, those of a GPU on the CPU as well."""
    lod = layer.mesh.lod
    twin = SomaLayer(layer.backend, lod=lod, dtype=layer.dtype, device=device, **options)
    if by_patches:
        twin.fuse()
    assert twin.fused is not None
    return twin


def moved(parts, device):
    return [None if part is None else part.to(device) for part in parts]


@pytest.fixture(scope="module", params=DTYPES, ids=str)
def layer(request):
    return SomaLayer("soma", lod="low", dtype=request.param, kernels="torch")


@pytest.mark.parametrize(("device", "by_patches"), WAYS)
@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize(
    ("batch", "own", "scaled"), quick((1, 0, 1), (9, 0, 1), (21, 1, 1), slow=[(3, 0, 0), (21, 1, 0)])
)
@torch.no_grad()
def test_equals_the_layer(layer, batch, own, scaled, absolute, device, by_patches):
    twin = fast_twin(layer, device, by_patches=by_patches)
    rotations, translation = poses(layer, batch)
    scale = 0.8 + 0.4 * torch.rand(batch, 77, dtype=layer.dtype) if scaled else None
    params = shapes(layer, batch if own else 1)
    expected = layer.pose(layer.identity(params), rotations, translation, absolute=absolute, bone_scale=scale)
    there, rotations, translation, scale = moved((params["shape"], rotations, translation, scale), device)
    identity = twin.identity({"shape": there})
    assert_same(twin.pose(identity, rotations, translation, absolute=absolute, bone_scale=scale), expected)
    got = twin({"shape": there}, rotations, translation, absolute=absolute, bone_scale=scale)
    assert_same(got, expected)


@pytest.mark.parametrize(("device", "by_patches"), WAYS)
@pytest.mark.parametrize(
    "options",
    [{"correctives": None}, {"procedural": False}, {"repose": False}, {"exact": True}],
    ids=str,
)
@torch.no_grad()
def test_equals_other_layers(options, device, by_patches):
    plain = SomaLayer("soma", lod="low", kernels="torch", **options)
    twin = fast_twin(plain, device, by_patches=by_patches, **options)
    rotations, translation = poses(plain, 11)
    shape = shapes(plain, 11)["shape"]
    got = twin({"shape": shape.to(device)}, rotations.to(device), translation.to(device))
    assert_same(got, plain({"shape": shape}, rotations, translation))


@pytest.mark.parametrize(("device", "by_patches"), WAYS)
@torch.no_grad()
def test_plain_poses_have_the_same_joints(layer, device, by_patches):
    twin = fast_twin(layer, device, by_patches=by_patches)
    (rotations, translation), shape = poses(layer, 9), shapes(layer, 9)["shape"]
    expected = layer.pose_plain(layer.identity({"shape": shape}), rotations, translation)
    identity, given = twin.identity({"shape": shape.to(device)}), moved((rotations, translation), device)
    plain, posed = twin.pose_plain(identity, *given), twin.pose(identity, *given)
    assert_same(plain, expected)
    assert torch.equal(plain.joints, posed.joints)
    assert torch.equal(plain.transforms, posed.transforms)
    assert (plain.vertices - posed.vertices).abs().max() > 1e-3


@pytest.mark.parametrize("by_patches", [False, True])
@pytest.mark.parametrize("lod", ["mid", "xlo"])
@torch.no_grad()
def test_equals_at_every_lod(lod, by_patches):
    plain = SomaLayer("soma", lod=lod, kernels="torch")
    twin = fast_twin(plain, by_patches=by_patches)
    rotations, translation = poses(plain, 10)
    assert_same(
        twin(shapes(plain, 10), rotations, translation), plain(shapes(plain, 10), rotations, translation)
    )


@pytest.mark.parametrize("by_patches", [False, True])
@torch.no_grad()
def test_matrices_shared_poses_and_turns_of_any_size(layer, by_patches):
    twin = fast_twin(layer, by_patches=by_patches)
    identity = layer.identity(shapes(layer, 4))
    for size in (0.0, 1e-5, 3.1, 6.0):
        rotations = size * torch.nn.functional.normalize(randn(1, 77, 3, dtype=layer.dtype), dim=-1)
        expected = layer.pose(identity, rotations)
        assert_same(twin.pose(identity, rotations), expected)
        matrices = torch.linalg.matrix_exp(_skewed(rotations))
        assert_same(twin.pose(identity, matrices), layer.pose(identity, matrices))


def _skewed(vectors):
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))


@pytest.mark.parametrize("modes", [SWING, EULER, lambda index: (ALIGNED, SWING, EULER)[index % 3]])
@torch.no_grad()
def test_every_twist_mode(modes):
    rig = with_modes(load_canonical("low")[1], modes)
    kind = {"dtype": torch.float64, "device": CPU}
    posing = ProceduralAnimation(rig, kernels="torch", **kind)
    layer = SomaLayer("soma", lod="low", dtype=torch.float64, correctives=None)
    identity = layer.identity(shapes(layer, 1))
    rotations, translation = poses(layer, 5)
    matrices = torch.linalg.matrix_exp(_skewed(rotations))
    expected = posing.pose(identity, matrices, translation, absolute=False)
    fused = FusedPose(posing, None, by_patches=True, **kind)
    assert_same(fused(identity, matrices, translation, absolute=False), expected)


def test_gradients_take_the_other_way(layer):
    twin = fast_twin(layer)
    twin.fused.forward = None  # would not be callable
    rotations, translation = poses(layer, 2)
    grads = []
    for one in (layer, twin):
        asking = rotations.clone().requires_grad_()
        vertices = one.pose(one.identity(shapes(layer, 1)), asking, translation).vertices
        grads.append(torch.autograd.grad(vertices.square().sum(), asking)[0])
    bound = GRADIENTS[layer.dtype] * float(grads[0].abs().max())
    torch.testing.assert_close(*grads, atol=bound, rtol=0)
    turned = torch.func.vmap(lambda r: twin.pose_plain(twin.identity(), r[None]).vertices)(rotations)
    assert turned.shape[0] == 2


@torch.no_grad()
def test_empty_batch_and_plain_pose(layer):
    twin = fast_twin(layer)
    rotations, translation = poses(layer, 3)
    identity = layer.identity()
    assert twin.pose(identity, rotations[:0]).vertices.shape == (0, layer.mesh.vertex_count, 3)
    assert_same(
        twin.pose_plain(identity, rotations, translation), layer.pose_plain(identity, rotations, translation)
    )


def test_rows_side_by_side():
    matrix = scipy.sparse.random_array((64, 20), density=0.2, rng=np.random.default_rng(0)).tocsr()
    rows = np.random.default_rng(1).permutation(64)
    rows[5] = -1
    start, ids, values = side_by_side(matrix.indptr.astype(np.int64), matrix.indices, matrix.data, rows)
    dense = matrix.toarray()
    for place, row in enumerate(rows):
        part = slice(start[place // 32] + place % 32, start[place // 32 + 1], 32)
        found = np.bincount(ids[part], values[part], minlength=20)
        np.testing.assert_array_equal(found, dense[row] if row >= 0 else 0)


def test_patches_are_cut_smaller_where_they_hold_too_much():
    crowded = scipy.sparse.csr_array(np.kron(np.eye(20), np.ones((16, 8))))
    patches = Patches(crowded, None, dtype=torch.float64, device=CPU)
    assert patches.fits
    assert patches.count > 3
    assert not Patches(scipy.sparse.csr_array(np.ones((3, 100))), None, dtype=torch.float64, device=CPU).fits


def test_a_layer_without_room_poses_as_before(layer, monkeypatch):
    monkeypatch.setattr(fused_module, "JOINT_LIMIT", 10)
    twin = SomaLayer("soma", lod="low", dtype=layer.dtype)
    twin.fuse()
    assert twin.fused is None
    rotations, translation = poses(layer, 2)
    assert_same(
        twin.pose(twin.identity(), rotations, translation),
        layer.pose(layer.identity(), rotations, translation),
    )


class Watch(torch.utils._python_dispatch.TorchDispatchMode):
    """Notes each operator that brings numbers from the device to the host or the other way."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        parts = torch.utils._pytree.tree_leaves((args, kwargs, out))
        if not all(part.is_meta for part in parts if isinstance(part, torch.Tensor)):
            self.seen.append(function.name())
        return out


def test_nothing_is_read_from_the_host(monkeypatch):
    """On a device of shapes alone every value that is asked for raises, and what passes the host is noted.

    Fake CUDA tensors would say more, but a build of torch without CUDA refuses to take slices of them. A list
    as index is not seen here; on a GPU, torch.cuda.set_sync_debug_mode("error") raises where the host waits.
    """
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda _kind: False)  # it knows no such device
    layer = SomaLayer("soma", lod="low")
    layer.fuse()
    for module in layer.modules():
        for name, buffer in list(module._buffers.items()):
            module._buffers[name] = torch.empty_like(buffer, device="meta")
    layer.device = torch.device("meta")
    rotations, shape = torch.empty(3, 77, 3, device="meta"), torch.empty(3, 128, device="meta")
    with torch.no_grad(), Watch() as watch:
        posed = layer({"shape": shape}, rotations, torch.empty(3, 3, device="meta"))
        again = layer.pose(layer.identity({"shape": shape[:1]}), rotations, absolute=True)
    assert posed.vertices.is_meta
    assert posed.vertices.shape == again.vertices.shape == (3, layer.mesh.vertex_count, 3)
    assert watch.seen == []
    with Watch() as watch:
        _ = torch.tensor([1.0, 2.0]).to("meta")
    assert watch.seen != []


def test_operators_are_registered_soundly(layer):
    twin = fast_twin(layer)
    fused, identity = twin.fused, twin.identity(shapes(layer, 2))
    rotations, translation = poses(layer, 2)
    given = (rotations, translation, identity.bind_world, None, fused.ints, fused.reals, 2)
    whole = (*given, fused.helper_count, fused.active_count, False, True)
    bare = (*whole[:-1], False)
    for given in (whole, bare):
        torch.library.opcheck(torch.ops.soma_core.pose_bodies.default, given)
    world, joints, none, _ = torch.ops.soma_core.pose_bodies(*bare)
    same_world, same_joints, skin, active = torch.ops.soma_core.pose_bodies(*whole)
    assert torch.equal(world, same_world)
    assert torch.equal(joints, same_joints)
    assert none.numel() == 0
    tables = fused.patches
    given = (identity.rest, skin, active, tables.ints, tables.shorts, tables.reals, tables.count)
    torch.library.opcheck(torch.ops.soma_core.skin_patches.default, given)


def test_the_tables_keep_the_weights(layer):
    """Every weight is there once: numbers of all patches add up to those of the matrices."""
    fused = FusedPose(layer.posing, layer.correctives, dtype=torch.float64, device=CPU, by_patches=True)
    numbers = float(fused.patches.reals.sum())
    second, weights = layer.correctives.second.scipy(), layer.posing.posed_skinning.weights.scipy()
    assert numbers == pytest.approx(second.sum() + weights.sum(), abs=1e-6)
