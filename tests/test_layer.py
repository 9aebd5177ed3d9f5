"""SomaLayer: batches, purity, gradients, compilation, dtypes and every refusal."""

import copy
import dataclasses
import functools
import pickle
import threading

import numpy as np
import pytest
import torch

from soma_core._inputs import _ROTATION_TOLERANCE, _surely_rotations
from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.layer import SomaLayer
from soma_core.plugin.errors import UnknownBackendError
from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import Parameter
from soma_core.topology.frames import METRES
from tests.bodies import TinyPlugin, randn, tiny_canonical, tiny_registry, tiny_spec, write_pair
from tests.plugin.fakes import FakeEntryPoint

SAME = {torch.float32: 2e-6, torch.float64: 1e-12}
"""Metres: the same sums in another order, on bodies of two metres."""
PARITY_M = {torch.float32: 1e-5, torch.float64: 1e-9}
"""The bound promised between torch and Warp."""
PARITY_GRADIENT = {torch.float32: 1e-4, torch.float64: 1e-7}
"""The bound promised between torch and Warp, relative to the largest gradient."""
COMPOSED_MM = 0.01
DTYPES = [torch.float32, torch.float64]
KERNELS = ["torch", "warp", "auto"]
JOINTS = tiny_canonical()[1].joint_count - 1
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")),
]


@pytest.fixture(scope="module")
def registry(tmp_path_factory):
    return tiny_registry(tmp_path_factory.mktemp("pair"))


@pytest.fixture(scope="module")
def tiny(registry):
    """Layers of the small body, each built once."""

    @functools.cache
    def build(dtype=torch.float64, kernels="torch", **options):
        return SomaLayer(
            "tiny", dtype=dtype, kernels=kernels, canonical=tiny_canonical(), registry=registry, **options
        )

    return build


@functools.cache
def real(backend="soma", dtype=torch.float32, kernels="auto", lod="low", exact=False):
    if backend == "anny":
        pytest.importorskip("soma_backend_anny")
    return SomaLayer(backend, dtype=dtype, kernels=kernels, lod=lod, exact=exact)


def params(batch, dtype=torch.float64, seed=0):
    return {
        "shape": randn(batch, 4, seed=seed, dtype=dtype),
        "size": 1 + 0.1 * randn(batch, seed=seed + 1, dtype=dtype),
    }


def poses(batch, dtype=torch.float64, joints=JOINTS, seed=2):
    return 0.4 * randn(batch, joints, 3, seed=seed, dtype=dtype), randn(batch, 3, seed=seed + 1, dtype=dtype)


def bone_scales(batch, dtype=torch.float64, seed=4):
    return (0.2 * randn(batch, JOINTS, seed=seed, dtype=dtype)).exp()


def outputs(posed):
    return posed.vertices, posed.joints, posed.transforms


def assert_posed(one, other, atol):
    for name, a, b in zip(("vertices", "joints", "transforms"), outputs(one), outputs(other), strict=True):
        torch.testing.assert_close(a, b, atol=atol, rtol=0, msg=lambda text, name=name: f"{name}: {text}")


# --- what comes out -------------------------------------------------------------------------------------


def test_shapes_and_provenance(tiny):
    layer = tiny()
    identity = layer.identity(params(3))
    count = layer.mesh.vertex_count
    assert identity.rest.shape == identity.fitted_rest.shape == (3, count, 3)
    assert identity.bind_world.shape == identity.fitted_world.shape == (3, JOINTS + 1, 4, 4)
    assert (identity.backend, identity.rig_revision, identity.batch_size) == ("tiny", layer.rig.revision, 3)
    assert set(identity.params) == {"shape", "size"}
    posed = layer.pose(identity, *poses(3))
    assert [tuple(part.shape) for part in outputs(posed)] == [
        (3, count, 3),
        (3, JOINTS, 3),
        (3, JOINTS + 1, 4, 4),
    ]
    assert layer.joint_names == layer.rig.joint_names[1:]


@pytest.mark.parametrize("scales", [0, 1, 2])
def test_equals_the_dense_definition(tiny, scales):
    """Naive forward kinematics and skinning of the identity the layer prepared."""
    layer = tiny()
    identity, (turns, place) = layer.identity(params(2)), poses(2)
    posed = layer.pose(identity, turns, place, bone_scale=bone_scales(scales) if scales else None)
    factor = bone_scales(scales).expand(2, -1).numpy() if scales else np.ones((2, JOINTS))
    rig, orient = layer.rig, layer.rig.t_pose_world[:, :3, :3]
    for index in range(2):
        bind = identity.bind_world[index].numpy()
        world = np.tile(np.eye(4), (rig.joint_count, 1, 1))
        for joint in range(1, rig.joint_count):
            parent = rig.parents[joint]
            local = np.linalg.inv(bind[parent]) @ bind[joint]
            turn = axis_angle_to_matrix(turns[index, joint - 1]).numpy()
            local[:3, :3] = orient[parent].T @ turn @ orient[joint]
            local[:3, 3] = place[index] if joint == 1 else factor[index, joint - 1] * local[:3, 3]
            world[joint] = world[parent] @ local
        np.testing.assert_allclose(posed.transforms[index], world, atol=1e-10)
        blended = np.einsum("vj,jab->vab", rig.weights.toarray(), world @ np.linalg.inv(bind))
        rest = np.c_[identity.rest[index].numpy(), np.ones(layer.mesh.vertex_count)]
        np.testing.assert_allclose(
            posed.vertices[index], np.einsum("vab,vb->va", blended, rest)[:, :3], atol=1e-10
        )
    assert torch.equal(posed.joints, posed.transforms[:, 1:, :3, 3])


def test_hips_go_where_the_translation_says(tiny):
    posed = tiny()(params(2), *poses(2))
    torch.testing.assert_close(posed.joints[:, 0], poses(2)[1])
    assert torch.equal(tiny()(params(2), poses(2)[0]).joints[:, 0], torch.zeros(2, 3, dtype=torch.float64))


def test_identity_is_reposed_to_the_rigs_bind_rotations(tiny):
    layer = tiny()
    identity = layer.identity(params(3))
    expected = torch.as_tensor(layer.rig.bind_world[:, :3, :3]).expand(3, -1, 3, 3)
    torch.testing.assert_close(identity.bind_world[..., :3, :3], expected, atol=1e-12, rtol=0)
    torch.testing.assert_close(identity.bind_world[:, 1, :3, 3], identity.fitted_world[:, 1, :3, 3])
    moved = identity.bind_world @ torch.linalg.inv(identity.fitted_world)
    blended = torch.einsum("vj,bjac->bvac", torch.as_tensor(layer.rig.weights.toarray()), moved)
    rest = torch.cat((identity.fitted_rest, torch.ones_like(identity.fitted_rest[..., :1])), -1)
    torch.testing.assert_close(identity.rest, (blended @ rest[..., None])[..., :3, 0], atol=1e-10, rtol=0)


def test_reposing_keeps_bone_lengths(tiny):
    identity = tiny().identity(params(3))
    parents = tiny().rig.parents
    for joint in range(2, JOINTS + 1):
        lengths = [
            (world[:, joint] - world[:, parents[joint]])[:, :3, 3].norm(dim=-1)
            for world in (identity.bind_world, identity.fitted_world)
        ]
        torch.testing.assert_close(*lengths)


def test_repose_can_be_turned_off(tiny):
    identity = tiny(repose=False).identity(params(2))
    assert torch.equal(identity.rest, identity.fitted_rest)
    assert torch.equal(identity.bind_world, identity.fitted_world)
    torch.testing.assert_close(identity.fitted_rest, tiny().identity(params(2)).fitted_rest)


def test_bind_rotations_give_the_rest_shape_back(tiny):
    """Absolute local bind rotations undo nothing: the posed body is the reposed identity itself."""
    layer = tiny()
    identity, bind = layer.identity(params(2)), layer.rig.bind_world[:, :3, :3]
    local = np.einsum("jba,jbc->jac", bind[np.maximum(layer.rig.parents, 0)], bind)[1:]
    rotations = torch.as_tensor(local).expand(2, -1, 3, 3)
    posed = layer.pose(identity, rotations, identity.bind_world[:, 1, :3, 3], absolute=True)
    torch.testing.assert_close(posed.vertices, identity.rest, atol=1e-10, rtol=0)
    torch.testing.assert_close(posed.transforms, identity.bind_world, atol=1e-10, rtol=0)


def test_absolute_poses_bypass_the_joint_orient(tiny):
    layer, (turns, place) = tiny(), poses(3)
    identity, orient = layer.identity(params(3)), torch.as_tensor(layer.rig.t_pose_world[:, :3, :3])
    above = orient[torch.as_tensor(np.maximum(layer.rig.parents, 0))]
    absolute = above[1:].mT @ axis_angle_to_matrix(turns) @ orient[1:]
    assert_posed(
        layer.pose(identity, absolute, place, absolute=True), layer.pose(identity, turns, place), 1e-12
    )


def test_matrices_and_axis_angles_are_two_spellings(tiny):
    layer, (turns, place) = tiny(), poses(3)
    assert_posed(layer(params(3), axis_angle_to_matrix(turns), place), layer(params(3), turns, place), 1e-14)


@pytest.mark.parametrize("backend", ["soma", "anny"])
def test_zero_pose_is_the_t_pose(backend):
    """The default body's bones point as in the rig's T-pose, with its orientations."""
    layer = real(backend, torch.float64)
    posed = layer({}, torch.zeros(1, 77, 3, dtype=torch.float64))
    t_pose = torch.from_numpy(np.array(layer.rig.t_pose_world))
    torch.testing.assert_close(posed.transforms[0, 1:, :3, :3], t_pose[1:, :3, :3], atol=1e-9, rtol=0)


@pytest.mark.parametrize("lod", ["low", "mid"])
def test_native_rest_shape_is_the_generators(lod):
    """No transfer, no rounding: the native backend arrives untouched, bar the unit."""
    shape = torch.linspace(-2, 2, 8)[None]
    layer = real("soma", torch.float32, lod=lod, exact=True)
    count = layer.spec.params[0].shape[0]
    padded = torch.nn.functional.pad(shape, (0, count - 8))
    generator = default_registry().generator("soma", device=torch.device("cpu"), dtype=torch.float32)
    native = generator.rest({"shape": padded})[:, torch.from_numpy(layer.mesh.mid_ids.astype(np.int64))]
    expected = METRES["cm"] * native
    found = layer.identity({"shape": shape}).fitted_rest
    assert float((found - expected).abs().max()) == 0
    composed = real("soma", torch.float32, lod=lod).identity({"shape": shape}).fitted_rest
    torch.testing.assert_close(composed, expected, atol=SAME[torch.float32], rtol=0)


def test_low_is_a_subset_of_mid():
    pytest.importorskip("soma_backend_anny")
    low, mid = (real("anny", torch.float32, lod=lod) for lod in ("low", "mid"))
    given = {"age": [0.1, 0.9], "weight": 0.8}
    ids = torch.from_numpy(low.mesh.mid_ids.astype(np.int64))
    found, full = low.identity(given).fitted_rest, mid.identity(given).fitted_rest
    torch.testing.assert_close(found, full[:, ids], atol=SAME[torch.float32], rtol=0)


def test_from_newborn_to_old_age():
    layer = real("anny")
    ages = torch.tensor([-1 / 3, 0.0, 1 / 3, 2 / 3, 1.0])
    posed = layer({"age": ages}, poses(5, torch.float32, 77)[0])
    for part in outputs(posed):
        assert part.isfinite().all()
    assert orthonormality_error(posed.transforms[..., :3, :3]).max() < 1e-5
    identity = layer.identity({"age": ages})
    stature = np.ptp(identity.rest[..., 1].numpy(), axis=1)
    assert (np.diff(stature[:4]) > 0.1).all()
    assert 0.4 < stature[0] < 0.6
    assert identity.bind_world.isfinite().all()


@pytest.mark.parametrize("backend", ["soma", "anny"])
def test_composed_equals_exact(backend):
    """Real backends, float64: the composed operator is the exact path to a hundredth of a millimetre."""
    if backend == "anny":
        random = torch.rand(4, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        given = dict(zip(("gender", "weight", "height", "muscle"), random, strict=True))
        given["age"] = torch.linspace(-0.3, 1, 6, dtype=torch.float64)
    else:
        given = {"shape": 2 * randn(6, 20)}
    composed, exact = (real(backend, torch.float64, exact=choice).identity(given) for choice in (False, True))
    assert composed.batch_size == 6
    for name in ("fitted_rest", "rest"):
        miss = (getattr(composed, name) - getattr(exact, name)).norm(dim=-1)
        assert 1e3 * float(miss.max()) < COMPOSED_MM
    torch.testing.assert_close(composed.fitted_world, exact.fitted_world, atol=1e-4, rtol=0)


# --- batches --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_one_identity_for_all_poses(tiny, dtype, kernels):
    layer, (turns, place) = tiny(dtype, kernels), poses(5, dtype)
    one = params(1, dtype)
    shared = layer.pose(layer.identity(one), turns, place)
    repeated = {name: value.repeat(5, *[1] * (value.ndim - 1)) for name, value in one.items()}
    assert_posed(shared, layer.pose(layer.identity(repeated), turns, place), 4 * SAME[dtype])
    assert_posed(layer(one, turns, place), shared, 4 * SAME[dtype])


@pytest.mark.parametrize("dtype", DTYPES)
def test_one_pose_for_all_identities(tiny, dtype):
    layer, (turns, place) = tiny(dtype), poses(1, dtype)
    identity = layer.identity(params(4, dtype))
    one = layer.pose(identity, turns, place)
    assert_posed(one, layer.pose(identity, turns.expand(4, -1, 3), place.expand(4, 3)), SAME[dtype])
    assert_posed(one, layer.pose(identity, turns, place[0]), SAME[dtype])


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_two_identities_together_are_each_alone(tiny, dtype, kernels):
    layer, given, (turns, place) = tiny(dtype, kernels), params(2, dtype), poses(2, dtype)
    together = layer(given, turns, place)
    for index in range(2):
        part = slice(index, index + 1)
        alone = layer({name: value[part] for name, value in given.items()}, turns[part], place[part])
        for whole, single in zip(outputs(together), outputs(alone), strict=True):
            torch.testing.assert_close(whole[part], single, atol=4 * SAME[dtype], rtol=0)


def test_permuting_the_batch_permutes_the_result(tiny):
    given, (turns, place) = params(5), poses(5)
    order = torch.tensor([4, 2, 0, 1, 3])
    first = tiny()(given, turns, place)
    second = tiny()({name: value[order] for name, value in given.items()}, turns[order], place[order])
    for a, b in zip(outputs(first), outputs(second), strict=True):
        torch.testing.assert_close(a[order], b, atol=1e-13, rtol=0)


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("batch", [7, 33, 130])
def test_large_batches_are_small_ones(tiny, batch, kernels):
    """With and without gradients: batches are cut into parts only without."""
    layer, given, (turns, place) = (
        tiny(torch.float32, kernels),
        params(batch, torch.float32),
        poses(batch, torch.float32),
    )
    scale = bone_scales(batch, torch.float32)
    with torch.no_grad():
        plain = layer(given, turns, place, bone_scale=scale)
    tracked = layer(given, turns.clone().requires_grad_(), place, bone_scale=scale)
    assert_posed(plain, tracked, 4 * SAME[torch.float32])
    for index in (0, batch // 2, batch - 1):
        part = slice(index, index + 1)
        one = {name: value[part] for name, value in given.items()}
        alone = layer(one, turns[part], place[part], bone_scale=scale[part])
        for whole, single in zip(outputs(plain), outputs(alone), strict=True):
            torch.testing.assert_close(whole[part], single, atol=4 * SAME[torch.float32], rtol=0)


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("empty", ["poses", "both"])
def test_an_empty_batch_gives_empty_bodies(tiny, kernels, empty):
    layer = tiny(torch.float32, kernels)
    given = params(0 if empty == "both" else 1, torch.float32)
    for turns in (torch.zeros(0, JOINTS, 3), torch.zeros(0, JOINTS, 3, 3)):
        posed = layer(given, turns)
        assert [tuple(part.shape) for part in outputs(posed)] == [
            (0, layer.mesh.vertex_count, 3), (0, JOINTS, 3), (0, JOINTS + 1, 4, 4),
        ]  # fmt: skip


def test_a_backend_without_parameters(tmp_path):
    """Nothing to take a batch size from: one body for any number of poses."""

    spec = tiny_spec(write_pair(tmp_path), params=(Parameter(name="extra", group="rare"),))
    registry = Registry([FakeEntryPoint("tiny", _OneBody(spec))])
    layer = SomaLayer("tiny", dtype=torch.float64, canonical=tiny_canonical(), registry=registry)
    for batch in (1, 3, 70):
        turns, place = poses(batch)
        with torch.no_grad():
            whole = layer({}, turns, place)
        assert_posed(whole, layer.pose(layer.identity({}), turns, place), SAME[torch.float64] * 4)


class _OneBody(TinyPlugin):
    """Ignores parameters; its coefficients are those of one neutral body."""

    @hookimpl
    def soma_generator(self, device, dtype):
        body = super().soma_generator(device, dtype)
        body.coefficients = lambda params: torch.zeros(1, 5, device=device, dtype=dtype)
        return body


# --- purity ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernels", KERNELS)
def test_no_hidden_state(tiny, kernels):
    layer, (turns, place) = tiny(torch.float32, kernels), poses(3, torch.float32)
    first = layer(params(3, torch.float32), turns, place)
    layer(params(5, torch.float32, seed=9), *poses(5, torch.float32, seed=8))
    layer.pose(layer.identity({"size": 0.5}), turns)
    again = layer(params(3, torch.float32), turns, place)
    for a, b in zip(outputs(first), outputs(again), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("kernels", KERNELS)
def test_inputs_are_not_changed(tiny, kernels):
    layer, given, (turns, place) = tiny(torch.float64, kernels), params(3), poses(3)
    copies = {name: value.clone() for name, value in given.items()}, turns.clone(), place.clone()
    identity = layer.identity(given)
    before = {
        name: getattr(identity, name).clone()
        for name in ("rest", "bind_world", "fitted_rest", "fitted_world")
    }
    for matrices in (turns, axis_angle_to_matrix(turns)):
        layer.pose(identity, matrices, place)
    for name, value in copies[0].items():
        assert torch.equal(given[name], value)
    assert torch.equal(turns, copies[1])
    assert torch.equal(place, copies[2])
    for name, value in before.items():
        assert torch.equal(getattr(identity, name), value)


def test_writing_into_results_changes_nothing(tiny):
    """Outputs are the caller's: not views of constants, of inputs or of each other's batch rows."""
    layer, (turns, place) = tiny(), poses(1)
    first = layer(params(1), turns, place)
    expected = [part.clone() for part in outputs(first)]
    kept = place.clone()
    for part in outputs(first):
        part.zero_()
    assert torch.equal(place, kept)
    for part, value in zip(outputs(layer(params(1), turns, place)), expected, strict=True):
        assert torch.equal(part, value)


def test_identities_cannot_be_rebound(tiny):
    identity = tiny().identity({})
    with pytest.raises(dataclasses.FrozenInstanceError):
        identity.rest = identity.fitted_rest


@pytest.mark.parametrize("kernels", KERNELS)
def test_two_threads_share_a_layer(tiny, kernels):
    layer = tiny(torch.float32, kernels)
    jobs = [(params(3, torch.float32, seed=k), *poses(3, torch.float32, seed=k)) for k in range(8)]
    expected = [layer(*job) for job in jobs]
    found, failures = {}, []

    def work(mine):
        try:
            for _ in range(3):
                for index in mine:
                    found[index] = layer(*jobs[index])
        except Exception as error:  # a thread must hand its failure over
            failures.append(error)

    threads = [threading.Thread(target=work, args=(mine,)) for mine in (range(8), range(7, -1, -1))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
    for index, one in enumerate(expected):
        for a, b in zip(outputs(one), outputs(found[index]), strict=True):
            assert torch.equal(a, b)


def test_results_do_not_depend_on_grad_mode_or_global_defaults(tiny):
    layer, given, (turns, place) = tiny(), params(3), poses(3)
    expected = layer(given, turns, place)
    with torch.no_grad():
        assert_posed(layer(given, turns, place), expected, SAME[torch.float64])
    with torch.inference_mode():
        inside = [part.clone() for part in outputs(layer(given, turns, place))]
    for a, b in zip(inside, outputs(expected), strict=True):
        torch.testing.assert_close(a, b, atol=SAME[torch.float64], rtol=0)
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float16)
    try:
        assert_posed(layer(given, turns, place), expected, SAME[torch.float64])
    finally:
        torch.set_default_dtype(default)


def test_constants_are_no_parameters(tiny):
    assert not list(tiny().parameters())
    assert not tiny().state_dict()


# --- gradients ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernels", ["torch", "warp"])
@pytest.mark.parametrize("form", ["axis-angle", "matrices"])
def test_gradcheck_through_everything(tiny, form, kernels):
    layer, given, (turns, place) = tiny(torch.float64, kernels), params(2), poses(2)
    turns = turns if form == "axis-angle" else axis_angle_to_matrix(turns)
    layer = layer if form == "axis-angle" else tiny(torch.float64, kernels, validate=False)
    parts = given["shape"], given["size"], turns, place, bone_scales(2)
    leaves = [part.requires_grad_() for part in parts]

    def run(shape, size, rotations, translation, scale):
        return outputs(layer({"shape": shape, "size": size}, rotations, translation, bone_scale=scale))

    assert torch.autograd.gradcheck(run, leaves, fast_mode=True, atol=1e-6)


@pytest.mark.parametrize("form", ["axis-angle", "matrices"])
@pytest.mark.parametrize("backend", ["soma", "anny"])
def test_gradcheck_on_real_bodies(backend, form):
    if backend == "anny":
        pytest.importorskip("soma_backend_anny")
    layer = SomaLayer(backend, lod="low", dtype=torch.float64, kernels="torch", validate=False)
    name, value = {
        "soma": ("shape", randn(1, 6, seed=4)), "anny": ("age", torch.tensor([0.43], dtype=torch.float64)),
    }[backend]  # fmt: skip
    turns, place = poses(1, joints=77)
    turns = turns if form == "axis-angle" else axis_angle_to_matrix(turns)
    leaves = [part.requires_grad_() for part in (value, turns, place)]
    assert torch.autograd.gradcheck(
        lambda v, r, t: outputs(layer({name: v}, r, t)), leaves, fast_mode=True, atol=1e-5
    )


def test_gradient_at_zero_pose_is_finite(tiny):
    turns = torch.zeros(2, JOINTS, 3, dtype=torch.float64, requires_grad=True)
    (grad,) = torch.autograd.grad(tiny()(params(2), turns).vertices.square().sum(), turns)
    assert grad.isfinite().all()
    assert grad.abs().max() > 0


def test_shared_identity_collects_the_gradients_of_all_poses(tiny):
    layer, (turns, place) = tiny(), poses(4)
    shape = randn(1, 4, seed=5).requires_grad_()
    pull = randn(layer.mesh.vertex_count, 3, seed=6)
    (together,) = torch.autograd.grad((layer({"shape": shape}, turns, place).vertices * pull).sum(), shape)
    single = [
        torch.autograd.grad((layer({"shape": shape}, turns[[k]], place[[k]]).vertices * pull).sum(), shape)[0]
        for k in range(4)
    ]
    torch.testing.assert_close(together, sum(single))


# --- twins ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("twin", ["warp", "auto"])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", [1, 2, 7, 33])
def test_torch_and_warp_agree(tiny, batch, dtype, twin, device):
    results = []
    for kernels in ("torch", twin):
        layer = tiny(dtype, kernels, device=device)
        given = {name: value.to(device).requires_grad_() for name, value in params(batch, dtype).items()}
        turns, place = (part.to(device).requires_grad_() for part in poses(batch, dtype))
        posed = layer(given, turns, place)
        pull = randn(*posed.vertices.shape, seed=7, dtype=dtype).to(device)
        loss = (posed.vertices * pull).sum() + posed.transforms.square().sum()
        results.append((outputs(posed), torch.autograd.grad(loss, (*given.values(), turns, place))))
    (values, grads), (twin_values, twin_grads) = results
    for expected, got in zip(values, twin_values, strict=True):
        torch.testing.assert_close(got, expected, atol=PARITY_M[dtype], rtol=0)
    for expected, got in zip(grads, twin_grads, strict=True):
        torch.testing.assert_close(
            got, expected, atol=PARITY_GRADIENT[dtype] * float(expected.abs().max()), rtol=0
        )


@pytest.mark.parametrize("backend", ["soma", "anny"])
@pytest.mark.parametrize("batch", [1, 33])
def test_torch_and_warp_agree_on_real_bodies(backend, batch):
    name, given = {
        "soma": ("shape", randn(batch, 10, seed=1)), "anny": ("age", torch.linspace(-0.2, 0.9, batch)),
    }[backend]  # fmt: skip
    results = []
    for kernels in ("torch", "warp", "auto"):
        value = given.float().clone().requires_grad_()
        turns, place = (part.requires_grad_() for part in poses(batch, torch.float32, 77))
        posed = real(backend, torch.float32, kernels)({name: value}, turns, place)
        results.append(
            (outputs(posed), torch.autograd.grad(posed.vertices.square().sum(), (value, turns, place)))
        )
    for values, grads in results[1:]:
        for expected, got in zip(results[0][0], values, strict=True):
            torch.testing.assert_close(got, expected, atol=PARITY_M[torch.float32], rtol=0)
        for expected, got in zip(results[0][1], grads, strict=True):
            bound = PARITY_GRADIENT[torch.float32] * float(expected.abs().max())
            torch.testing.assert_close(got, expected, atol=bound, rtol=0)


# --- compilation ----------------------------------------------------------------------------------------


SLOW_TORCH = pytest.param("torch", marks=pytest.mark.slow)  # its graph has some thousand operations


@pytest.fixture
def fresh_compiler():
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.parametrize("kernels", ["torch", "warp"])
def test_compiles_without_graph_breaks(tiny, fresh_compiler, kernels):
    """Of matrices; the gradients below are of axis-angles."""
    layer, given, (turns, place) = tiny(torch.float64, kernels), params(2), poses(2)
    turns = axis_angle_to_matrix(turns)

    def run(shape, size, rotations, translation):
        return outputs(layer.pose(layer.identity({"shape": shape, "size": size}), rotations, translation))

    compiled = torch.compile(run, fullgraph=True, backend="aot_eager")
    args = (given["shape"], given["size"], turns, place)
    for eager, fast in zip(run(*args), compiled(*args), strict=True):
        torch.testing.assert_close(fast, eager, atol=1e-10, rtol=0)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.parametrize("kernels", [SLOW_TORCH, "warp"])
def test_compiled_gradients(tiny, fresh_compiler, kernels):
    layer, given, (turns, place) = tiny(torch.float64, kernels), params(2), poses(2)

    def loss(shape, rotations):
        return layer({"shape": shape, "size": given["size"]}, rotations, place).vertices.square().sum()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    leaves = [given["shape"].requires_grad_(), turns.requires_grad_()]
    expected, found = (torch.autograd.grad(function(*leaves), leaves) for function in (loss, compiled))
    for one, other in zip(expected, found, strict=True):
        torch.testing.assert_close(other, one, atol=1e-8, rtol=1e-8)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.parametrize("kernels", [SLOW_TORCH, "auto"])
def test_compiles_for_batches_that_eager_cuts_into_parts(tiny, fresh_compiler, kernels):
    layer, given, (turns, place) = (
        tiny(torch.float32, kernels),
        params(70, torch.float32),
        poses(70, torch.float32),
    )
    compiled = torch.compile(lambda r: layer(given, r, place).vertices, fullgraph=True, backend="aot_eager")
    with torch.no_grad():
        torch.testing.assert_close(compiled(turns), layer(given, turns, place).vertices, atol=1e-5, rtol=0)


# --- dtypes and devices ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kernels", KERNELS)
def test_converting_rebuilds_from_float64(registry, tiny, kernels):
    """Single precision and back is the double layer itself, not its rounded constants."""
    layer = SomaLayer(
        "tiny", dtype=torch.float32, kernels=kernels, canonical=tiny_canonical(), registry=registry
    )
    assert layer.to(torch.float64) is layer
    assert layer.dtype == torch.float64
    assert_posed(layer(params(2), *poses(2)), tiny(torch.float64, kernels)(params(2), *poses(2)), 1e-15)
    for tensor in layer.buffers():
        assert tensor.dtype in (torch.float64, torch.int64, torch.int32)
    assert layer.float()({}, torch.zeros(1, JOINTS, 3)).vertices.dtype == torch.float32
    assert layer.double().dtype == torch.float64


@pytest.mark.parametrize("dtype", DTYPES)
def test_results_have_the_layers_dtype(tiny, dtype):
    posed = tiny(dtype)({"size": 1}, *poses(1, dtype))
    assert {part.dtype for part in outputs(posed)} == {dtype}


def test_float32_is_close_to_float64(tiny):
    single = tiny(torch.float32)(params(4, torch.float32), *poses(4, torch.float32))
    double = tiny(torch.float64)(params(4), *poses(4))
    for a, b in zip(outputs(single), outputs(double), strict=True):
        torch.testing.assert_close(a.double(), b, atol=2e-5, rtol=0)


def test_moving_to_where_it_is_keeps_the_constants(tiny):
    layer = tiny()
    before = layer.animation
    assert layer.to("cpu").animation is before
    assert layer.double().animation is before


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("kernels", KERNELS)
def test_cuda_equals_cpu(registry, tiny, kernels):
    layer = SomaLayer(
        "tiny",
        dtype=torch.float64,
        kernels=kernels,
        device="cuda",
        canonical=tiny_canonical(),
        registry=registry,
    )
    given = {name: value.cuda() for name, value in params(7).items()}
    posed = layer(given, *(part.cuda() for part in poses(7)))
    for a, b in zip(outputs(posed), outputs(tiny()(params(7), *poses(7))), strict=True):
        torch.testing.assert_close(a.cpu(), b, atol=1e-9, rtol=0)


# --- refusals -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argument", "value", "text"),
    [
        ("lod", "high", r"lod: got 'high', expected one of 'mid', 'low', 'xlo'. Pass lod='mid'"),
        (
            "kernels",
            "triton",
            r"kernels: got 'triton', expected one of 'auto', 'torch', 'warp'. Pass kernels='auto'",
        ),
        ("dtype", torch.float16, r"dtype: got torch.float16, expected one of torch.float32, torch.float64"),
        ("dtype", torch.int64, r"dtype: got torch.int64"),
    ],
)
def test_wrong_choices(argument, value, text):
    with pytest.raises(InputError, match=text):
        SomaLayer("soma", **{argument: value})


def test_unknown_backend():
    with pytest.raises(UnknownBackendError, match="sooma"):
        SomaLayer("sooma")


def test_unknown_option(registry):
    with pytest.raises(InputError, match=r"backend.options.speed: got 9"):
        SomaLayer("tiny", options={"speed": 9}, canonical=tiny_canonical(), registry=registry)


def test_half_precision_conversion_is_refused_and_harmless(registry):
    layer = SomaLayer("tiny", canonical=tiny_canonical(), registry=registry)
    with pytest.raises(InputError, match="dtype: got torch.float16"):
        layer.half()
    assert layer.dtype == torch.float32
    assert layer({}, torch.zeros(1, JOINTS, 3)).vertices.isfinite().all()


def rotations_of(*shape):
    return torch.zeros(*shape, dtype=torch.float64)


SHAPES = [
    ((JOINTS, 3), r"Add the batch axis: rotations\[None\]"),
    ((JOINTS, 3, 3), r"Add the batch axis: rotations\[None\]"),
    ((2, JOINTS + 1, 3), r"Leave out the virtual Root: rotations\[:, 1:\]"),
    ((2, JOINTS + 1, 3, 3), r"Leave out the virtual Root: rotations\[:, 1:\]"),
    ((2, JOINTS - 1, 3), "Order the joints as in layer.joint_names"),
    ((2, JOINTS, 6), "Order the joints as in layer.joint_names"),
    ((2, JOINTS, 4, 4), "Order the joints as in layer.joint_names"),
    ((2, 3 * JOINTS), "Order the joints as in layer.joint_names"),
    ((2, 5, JOINTS, 3), "Order the joints as in layer.joint_names"),
]


@pytest.mark.parametrize(("shape", "hint"), SHAPES)
def test_wrong_shape_of_rotations(tiny, shape, hint):
    expected = rf"expected \(batch, {JOINTS}, 3\) axis-angle or \(batch, {JOINTS}, 3, 3\) matrices. {hint}"
    with pytest.raises(InputError, match=expected) as caught:
        tiny()({}, rotations_of(*shape))
    assert f"rotations: got {shape}" in str(caught.value)


def test_wrong_type_of_rotations(tiny):
    with pytest.raises(
        InputError, match=r"rotations: got ndarray, expected a torch.Tensor. .*torch.as_tensor\(rotations\)"
    ):
        tiny()({}, np.zeros((1, JOINTS, 3)))
    with pytest.raises(InputError, match=r"rotations: got list"):
        tiny()({}, [[0.0] * 3] * JOINTS)


@pytest.mark.parametrize("dtype", [torch.float32, torch.int64, torch.complex128])
def test_wrong_dtype_of_rotations(tiny, dtype):
    text = rf"rotations: got {dtype}, expected torch.float64. Call rotations.to\(torch.float64\)"
    with pytest.raises(InputError, match=text):
        tiny()({}, torch.zeros(1, JOINTS, 3, dtype=dtype))


def test_wrong_device(tiny):
    with pytest.raises(InputError, match=r"rotations: got meta, expected cpu. Call rotations.to\('cpu'\)"):
        tiny()({}, torch.zeros(1, JOINTS, 3, dtype=torch.float64, device="meta"))
    with pytest.raises(InputError, match=r"translation: got meta, expected cpu"):
        tiny()({}, rotations_of(1, JOINTS, 3), torch.zeros(1, 3, dtype=torch.float64, device="meta"))


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("tail", [(3,), (3, 3)])
def test_rotations_that_are_not_finite(tiny, tail, value):
    turns = (
        torch.eye(3, dtype=torch.float64).repeat(2, JOINTS, 1, 1)
        if len(tail) == 2
        else rotations_of(2, JOINTS, 3)
    )
    where = (1, 4, 2) if len(tail) == 1 else (1, 4, 2, 0)
    turns[where] = value
    with pytest.raises(InputError, match="rotations: got .*, expected finite numbers") as caught:
        tiny()({}, turns)
    assert f"{float(value)} at index {where}" in str(caught.value)


def test_opposite_infinities_do_not_hide_each_other(tiny):
    turns = rotations_of(1, JOINTS, 3)
    turns[0, 0, 0], turns[0, 1, 0] = torch.inf, -torch.inf
    with pytest.raises(InputError, match=r"inf at index \(0, 0, 0\)"):
        tiny()({}, turns)


def test_huge_but_finite_numbers_pass(tiny):
    """Sums of them overflow, which must not be mistaken for a NaN."""
    turns = torch.full((1, JOINTS, 3), 3e38)
    assert tiny(torch.float32)({}, turns).vertices.shape[0] == 1


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([1.0, 1, -1]),
        1.1 * np.eye(3),
        np.eye(3) + 0.1 * np.eye(3)[[1, 2, 0]],
        np.zeros((3, 3)),
        -np.eye(3),
    ],
    ids=["reflection", "scale", "shear", "zero", "inversion"],
)
def test_matrices_that_are_no_rotations(tiny, matrix):
    turns = torch.eye(3, dtype=torch.float64).repeat(2, JOINTS, 1, 1)
    turns[1, 6] = torch.as_tensor(matrix)
    text = (
        r"rotations\[1, 6\]: got a matrix .* away from a rotation, expected R\^T R = I and det R = 1 within"
    )
    with pytest.raises(InputError, match=text):
        tiny()({}, turns)
    assert tiny(validate=False)({}, turns).vertices.isfinite().all()


def test_rounded_matrices_are_rotations(tiny):
    turns = axis_angle_to_matrix(poses(2)[0])
    assert tiny()({}, (turns * 1e3).round() / 1e3).vertices.isfinite().all()


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-4, 1e-3, 3e-3, 1e-2, 0.1, 1.0])
def test_a_quick_look_at_matrices_lets_no_wrong_one_pass(scale):
    turns = axis_angle_to_matrix(poses(20)[0])
    turns = turns + scale * randn(*turns.shape, seed=3).to(turns)
    passed = [_surely_rotations(one.numpy()) for one in turns.flatten(0, 1)]
    assert (orthonormality_error(turns).flatten()[passed] < _ROTATION_TOLERANCE).all()
    assert all(passed) or scale > 1e-4
    assert not all(passed) or scale < 1e-2
    for wrong in (torch.nan, torch.inf):
        turns[3, 4, 1, 2] = wrong
        assert not _surely_rotations(turns.numpy())


@pytest.mark.parametrize(("identities", "count"), [(2, 3), (3, 2)])
def test_batches_that_disagree(tiny, identities, count):
    text = rf"rotations: got a batch of {count} for {identities} identities, expected .* {identities} or 1"
    for call in (
        lambda: tiny()(params(identities), rotations_of(count, JOINTS, 3)),
        lambda: tiny().pose(tiny().identity(params(identities)), rotations_of(count, JOINTS, 3)),
    ):
        with pytest.raises(InputError, match=text):
            call()


@pytest.mark.parametrize("shape", [(2,), (4,), (3, 3), (2, 2), (2, 1, 3), (2, 4), ()])
def test_wrong_shape_of_translation(tiny, shape):
    with pytest.raises(
        InputError, match=r"translation: got .*, expected \(2, 3\), \(1, 3\) or \(3,\)"
    ) as caught:
        tiny()(params(2), rotations_of(2, JOINTS, 3), torch.zeros(shape, dtype=torch.float64))
    assert f"got {shape}" in str(caught.value)


def test_wrong_kind_of_translation(tiny):
    turns = rotations_of(1, JOINTS, 3)
    with pytest.raises(InputError, match=r"translation: got torch.float32, expected torch.float64"):
        tiny()({}, turns, torch.zeros(1, 3))
    with pytest.raises(InputError, match=r"translation: got list, expected a torch.Tensor"):
        tiny()({}, turns, [0, 0, 0])


@pytest.mark.parametrize("validate", [True, False])
def test_translation_that_is_not_finite(tiny, validate):
    """Finiteness is always checked; `validate` is about rotation matrices."""
    place = torch.zeros(2, 3, dtype=torch.float64)
    place[1, 2] = torch.nan
    with pytest.raises(InputError, match=r"translation: got nan at index \(1, 2\), expected finite"):
        tiny(validate=validate)(params(2), rotations_of(2, JOINTS, 3), place)


def test_wrong_bone_scales(tiny):
    layer, turns = tiny(), rotations_of(2, JOINTS, 3)
    identity = layer.identity(params(2))
    for scale, text in (
        (torch.ones(JOINTS, dtype=torch.float64), rf"got \({JOINTS},\), expected \(2, {JOINTS}\) or \(1, "),
        (torch.ones(3, JOINTS, dtype=torch.float64), rf"got \(3, {JOINTS}\), expected \(2, {JOINTS}\)"),
        (torch.ones(2, JOINTS), "got torch.float32, expected torch.float64"),
        (torch.full((1, JOINTS), torch.inf, dtype=torch.float64), r"got inf at index \(0, 0\), expected fin"),
    ):
        for call in (functools.partial(layer.pose, identity), functools.partial(layer, params(2))):
            with pytest.raises(InputError, match=f"bone_scale: {text}"):
                call(turns, bone_scale=scale)
    scale = torch.ones(2, JOINTS, dtype=torch.float64)
    scale[1, 3] = -0.5
    with pytest.raises(InputError, match=r"bone_scale\[1, 3\]: got -0.5, expected a number above zero"):
        layer.pose(identity, turns, bone_scale=scale)


def test_wrong_parameters(tiny):
    with pytest.raises(
        InputError, match=r"params\['shpae'\]: got unknown name 'shpae'.*Did you mean 'shape'"
    ):
        tiny().identity({"shpae": [0.0]})
    with pytest.raises(InputError, match=r"params\['shape'\]: got shape \(1, 5\)"):
        tiny().identity({"shape": torch.zeros(1, 5, dtype=torch.float64)})
    with pytest.raises(InputError, match=r"params\['shape'\]: got nan at index"):
        tiny().identity({"shape": [0.0, float("nan")]})
    with pytest.raises(InputError, match=r"params\['size'\]: got batch size 3"):
        tiny().identity({"shape": [[0.0], [1.0]], "size": [1.0, 1.0, 1.0]})


def test_an_identity_from_a_rest_shape_is_the_backends_own(tiny):
    layer = tiny()
    of_backend = layer.identity(params(2))
    of_vertices = layer.identity_from_rest(of_backend.fitted_rest)
    for name in ("rest", "bind_world", "fitted_rest", "fitted_world"):
        found, expected = getattr(of_vertices, name), getattr(of_backend, name)
        torch.testing.assert_close(found, expected, atol=SAME[torch.float64], rtol=0)
    assert not of_vertices.params


def test_wrong_rest_shapes(tiny):
    layer, count = tiny(), tiny().mesh.vertex_count
    with pytest.raises(InputError, match=rf"rest: got \(2, 5, 3\), expected \(batch, {count}, 3\)"):
        layer.identity_from_rest(torch.zeros(2, 5, 3, dtype=torch.float64))
    with pytest.raises(InputError, match="rest: got torch.float32, expected torch.float64"):
        layer.identity_from_rest(torch.zeros(1, count, 3))
    with pytest.raises(InputError, match=r"rest: got nan at index \(0, 0, 0\)"):
        layer.identity_from_rest(torch.full((1, count, 3), torch.nan, dtype=torch.float64))


def test_identities_of_another_layer_are_refused(tiny):
    """Of another rig, LOD, dtype or batch layout: the error says so, not a kernel far below."""
    turns = torch.zeros(1, 77, 3)
    with pytest.raises(InputError, match="identity: got"):
        real("soma").pose(tiny(torch.float32).identity({}), turns)
    with pytest.raises(InputError, match="identity: got"):
        tiny(torch.float64).pose(tiny(torch.float32).identity({}), rotations_of(1, JOINTS, 3))
    with pytest.raises(InputError, match="identity: got"):
        real("soma", lod="mid").pose(real("soma").identity({}), turns)


@pytest.mark.parametrize("through", [copy.deepcopy, lambda layer: pickle.loads(pickle.dumps(layer))])
def test_copies_and_pickles_by_building_again(through):
    """A worker process or an averaged model gets the same bodies."""
    layer = real("soma")
    other = through(layer)
    given, turns = {"shape": torch.ones(1, 4)}, 0.1 * torch.ones(1, 77, 3)
    torch.testing.assert_close(other(given, turns).vertices, layer(given, turns).vertices, atol=0, rtol=0)
