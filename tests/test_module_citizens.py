"""Layers and fits among PyTorch's own modules: copied, sent to workers, converted, cast, transformed."""

import copy
import pickle
from dataclasses import fields, is_dataclass

import pytest
import torch
from torch.autograd import forward_ad
from torch.utils.data import DataLoader, Dataset

from soma_core import InputError, PoseInversion, SomaLayer
from tests.bodies import randn

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*rest in a fold of the model:RuntimeWarning"),
    pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
]
KINDS = {"default": {}, "plain": {"procedural": False, "correctives": None}}
FRAMES, JOINTS, BETAS = 2, 77, torch.tensor([[0.5, -1.0, 0.3]])
STEP = 1e-6
"""Of central differences [rad]."""
SLOPE = 1e-6
"""Relative to the largest derivative: the square of the step, and rounding over it."""
SAME = 1e-12
"""Metres and more: the same sums in another order, in float64."""


class Bodies(torch.nn.Module):
    """What a person would write: a network that poses bodies and fits them."""

    def __init__(self, kind, dtype=torch.float32, kernels="auto"):
        super().__init__()
        self.head = torch.nn.Linear(2, 3 * JOINTS)
        self.layer = SomaLayer("soma", lod="low", dtype=dtype, kernels=kernels, **KINDS[kind])
        self.fit = PoseInversion(self.layer)

    def forward(self, seed):
        return self.layer({"shape": BETAS.to(seed)}, self.head(seed).unflatten(1, (JOINTS, 3)))


def turns(dtype=torch.float32):
    return 0.3 * randn(FRAMES, JOINTS, 3, seed=5, dtype=dtype)


def targets(layer):
    """Posed vertices, and whose they are."""
    identity = layer.identity({"shape": BETAS.to(layer.dtype)})
    return layer.pose(identity, turns(layer.dtype)).vertices, identity


def computed(layer, fit):
    """What both give, forward and backward."""
    vertices, identity = targets(layer)
    tracked = turns(layer.dtype).requires_grad_(), vertices.detach().requires_grad_()
    posed, found = layer({"shape": BETAS.to(layer.dtype)}, tracked[0]), fit(tracked[1], identity)
    loss = posed.vertices.square().sum() + found.rotations[..., 0].sum()
    return posed, layer.pose(identity, turns(layer.dtype)), found, loss, tracked


def everything(layer, fit):
    *results, loss, tracked = computed(layer, fit)
    return *results, *torch.autograd.grad(loss, tracked)


def assert_same(one, other):
    """Equal to the bit."""
    if is_dataclass(one):
        one, other = ([getattr(part, field.name) for field in fields(one)] for part in (one, other))
    if not isinstance(one, torch.Tensor):
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
        return
    torch.testing.assert_close(other, one, atol=0, rtol=0, equal_nan=True)


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def bodies(kind):
    return Bodies(kind)


@pytest.fixture(scope="module")
def single(bodies):
    """What a layer and a fit in float32 give."""
    return everything(bodies.layer, bodies.fit)


@pytest.fixture(scope="module")
def double(kind):
    """A layer that was made in float64 and what it gives, with its fit."""
    made = Bodies(kind, torch.float64)
    return made.layer, everything(made.layer, made.fit)


# --- copies and workers ---------------------------------------------------------------------------------


@pytest.mark.parametrize("through", [copy.deepcopy, lambda module: pickle.loads(pickle.dumps(module))])
def test_copies_give_the_same_bits(bodies, single, through):
    other = through(bodies.eval())
    assert not other.layer.training
    assert not other.fit.training
    assert other.fit.layer is other.layer is not bodies.layer
    assert_same(everything(other.layer, other.fit), single)
    assert everything(other.layer.double(), other.fit)[0].vertices.dtype == torch.float64
    assert bodies.layer.dtype == bodies.fit.dtype == torch.float32


class Clips(Dataset):
    """A data set whose workers pose and fit."""

    def __init__(self):
        self.bodies = [Bodies(kind) for kind in KINDS]

    def __len__(self):
        return len(self.bodies)

    def __getitem__(self, index):
        with torch.no_grad():
            vertices, identity = targets(self.bodies[index].layer)
            return vertices, self.bodies[index].fit(vertices, identity).rotations


@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_give_the_same_bits(start):
    clips, threads = Clips(), torch.get_num_threads()
    torch.set_num_threads(1)  # as in a worker
    try:
        expected = [clips[0], clips[1]]
    finally:
        torch.set_num_threads(threads)
    found = list(DataLoader(clips, None, num_workers=1, multiprocessing_context=start))
    assert_same(expected, [tuple(one) for one in found])


# --- conversion and casts -------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["network", "fit", "layer"])
def test_converting_is_constructing(bodies, single, double, what):
    """To the bit, there and back: constants come from the options, not from those of before."""
    made = copy.deepcopy(bodies)
    converted = made if what == "network" else getattr(made, what)
    assert converted.double() is converted
    assert_same(everything(made.layer, made.fit), double[1])
    assert {tensor.dtype for tensor in made.fit.buffers() if tensor.is_floating_point()} == {torch.float64}
    converted.to(torch.float32)
    assert_same(computed(made.layer, made.fit)[:3], single[:3])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_moving_is_constructing(kind, bodies):
    moved = copy.deepcopy(bodies).to("cuda")
    layer = SomaLayer("soma", lod="low", device="cuda", **KINDS[kind])
    vertices, identity = (part.cuda() if isinstance(part, torch.Tensor) else part for part in targets(layer))
    assert_same(moved.fit(vertices, identity), PoseInversion(layer)(vertices, identity))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_a_cast_network_casts_neither(bodies, single, dtype):
    network = copy.deepcopy(bodies).to(dtype)
    assert network.head.weight.dtype == dtype
    assert_same(everything(network.layer, network.fit), single)
    posed = network(randn(FRAMES, 2, seed=7).to(dtype))
    assert posed.vertices.dtype == torch.float32
    posed.vertices.square().sum().backward()
    assert network.head.weight.grad.isfinite().all()
    wide, (vertices, identity) = turns().to(dtype), targets(network.layer)
    assert_same(network.layer.pose(identity, wide), network.layer.pose(identity, wide.float()))
    assert network.fit(vertices.to(dtype), identity).rotations.dtype == torch.float32
    state = network.state_dict()
    assert set(state) == {"head.weight", "head.bias"}
    bodies.load_state_dict(state)
    assert_same(everything(network.to("meta").layer, network.fit)[0], single[0])


@pytest.mark.parametrize("name", ["layer", "fit"])
def test_half_precision_of_their_own_is_refused(bodies, name):
    module = getattr(bodies, name)
    for convert in (module.half, lambda: module.to(dtype=torch.half), lambda: module.to("cpu", torch.half)):
        with pytest.raises(InputError, match="dtype: got torch.float16, expected one of torch.float32"):
            convert()
    with pytest.raises(InputError, match="dtype: got torch.bfloat16"):
        module.bfloat16()


def test_autocast_changes_nothing(bodies, single):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == torch.bfloat16
        *results, loss, tracked = computed(bodies.layer, bodies.fit)
        assert bodies(randn(FRAMES, 2, seed=7, dtype=torch.float32)).vertices.dtype == torch.float32
    assert_same((*results, *torch.autograd.grad(loss, tracked)), single)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
def test_compiles_in_one_graph_under_autocast(bodies):
    torch._dynamo.reset()
    compiled = torch.compile(bodies, fullgraph=True, backend="aot_eager")
    seed = randn(FRAMES, 2, seed=7, dtype=torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(compiled(seed).vertices, bodies(seed).vertices, atol=1e-5, rtol=0)
    torch._dynamo.reset()


# --- torch.func -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernels", ["torch", "auto", "warp"])
def test_every_transform_of_torch_func(kind, double, kernels):
    """Derivatives against differences, batches against loops; the other kernels against the reference."""
    layer = SomaLayer("soma", lod="low", dtype=torch.float64, kernels=kernels, **KINDS[kind])
    given, along = (BETAS.double(), turns(torch.float64)), (randn(1, 3, seed=8), randn(2, JOINTS, 3, seed=9))

    def posed(shape, rotations):
        return layer({"shape": shape}, rotations).vertices

    value, slope = torch.func.jvp(posed, given, along)
    torch.testing.assert_close(value, posed(*given), atol=SAME, rtol=0)
    near = [posed(*(a + s * STEP * b for a, b in zip(given, along, strict=True))) for s in (1, -1)]
    measured, size = (near[0] - near[1]) / (2 * STEP), slope.abs().max()
    torch.testing.assert_close(slope, measured, atol=float(SLOPE * size), rtol=0)
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(a, b) for a, b in zip(given, along, strict=True)]
        torch.testing.assert_close(forward_ad.unpack_dual(posed(*duals)).tangent, slope, atol=SAME, rtol=0)

    def loss(shape, rotations):
        return (posed(shape, rotations) * slope[: len(rotations)]).sum()

    tracked = [one.clone().requires_grad_() for one in given]
    expected, found = torch.autograd.grad(loss(*tracked), tracked), torch.func.grad(loss, (0, 1))(*given)
    for one, other in zip(expected, found, strict=True):
        torch.testing.assert_close(other, one, atol=SAME * float(one.abs().max()) + SAME, rtol=1e-9)
    identity = layer.identity({"shape": given[0]})
    one_by_one = torch.func.vmap(lambda rotation: layer.pose(identity, rotation[None]).vertices[0])
    torch.testing.assert_close(one_by_one(given[1]), value, atol=SAME, rtol=0)
    each = torch.func.vmap(torch.func.grad(lambda turn: posed(given[0], turn[None]).square().sum()))
    whole = torch.func.grad(lambda turn: posed(given[0], turn).square().sum())(given[1])
    torch.testing.assert_close(each(given[1]), whole, atol=SAME, rtol=1e-9)


def test_a_fit_refuses_transforms(bodies):
    vertices, identity = targets(bodies.layer)
    for transform in (torch.func.grad, torch.func.vmap):
        with pytest.raises(InputError, match="vertices: got tensors under a transform of torch.func"):
            transform(lambda given: bodies.fit(given, identity).rotations.sum())(vertices)
