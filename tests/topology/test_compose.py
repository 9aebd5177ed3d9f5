"""Composed linear backends against the exact transfer, vertex by vertex."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from soma_core.backends.rest_shape import make_rest_shape
from soma_core.errors import InputError
from soma_core.topology.compose import compose
from soma_core.topology.correspondence import build_correspondence
from soma_core.topology.transfer import make_transfer
from tests.bodies import CPU, LinearBody, native_body, randn, tiny_canonical, tiny_spec, wrap_vertices

COMPOSED_MM = 0.01
"""The bound of the linearised offsets below 0.01 mm; measured at most 0.0003 mm on these bodies."""
SAME_MM = 1e-8
"""float64 rounding."""
MESH, RIG = tiny_canonical()


@pytest.fixture(scope="module")
def transfer():
    made = build_correspondence(*native_body(), wrap_vertices())
    return make_transfer(tiny_spec(None), MESH, made, dtype=torch.float64, device=CPU)


@pytest.fixture(scope="module")
def body():
    return LinearBody()


AT = torch.tanh(torch.tensor([0.0, 0.3, 0.3, 0.3, 0.3], dtype=torch.float64))


@pytest.fixture(scope="module")
def composed(body, transfer):
    return compose(body.linear_basis(), transfer, AT)


def evaluate(composed, coefficients):
    """Vertices (B, v, 3) of a composed basis."""
    flat = composed.template + coefficients @ composed.basis.T
    vertices = flat.view(len(coefficients), -1, 3)
    if composed.exact is None:
        return vertices
    return vertices.index_add(1, composed.exact.rows, composed.exact.evaluate(coefficients).permute(2, 0, 1))


def exact(body, transfer, coefficients):
    native = body.template + torch.einsum("bk,knc->bnc", coefficients, body.fields)
    return transfer(native)


def miss_mm(a, b):
    return 1e3 * float((a - b).norm(dim=-1).max())


def test_the_pair_has_offsets_of_every_kind(composed):
    covered = np.setdiff1d(np.arange(MESH.vertex_count), MESH.face_interior)
    assert 0.1 < len(composed.exact.height) / len(covered) < 0.6


def test_exact_where_it_was_linearised(body, transfer, composed):
    assert miss_mm(evaluate(composed, AT[None]), exact(body, transfer, AT[None])) < SAME_MM


@pytest.mark.parametrize("spread", [0.1, 0.5, 1.0])
def test_close_on_random_bodies(body, transfer, composed, spread):
    coefficients = spread * torch.tanh(randn(20, 5, seed=1))
    assert miss_mm(evaluate(composed, coefficients), exact(body, transfer, coefficients)) < COMPOSED_MM


@pytest.mark.parametrize("scale", [0.3, 0.6, 1.5])
def test_growth_is_not_mistaken_for_a_change_of_direction(body, transfer, composed, scale):
    """Uniform scaling is linear and scales offsets too, so even linearised ones are exact."""
    at_scale = torch.zeros(1, 5, dtype=torch.float64)
    at_scale[0, 0] = scale - 1
    plain = compose(body.linear_basis(), transfer, torch.zeros(5, dtype=torch.float64))
    assert miss_mm(evaluate(plain, at_scale), exact(body, transfer, at_scale)) < SAME_MM


def test_gradients_are_close_too(body, transfer, composed):
    coefficients = 0.5 * torch.tanh(randn(3, 5, seed=2)).requires_grad_()
    pull = randn(MESH.vertex_count, 3, seed=3)
    grads = [
        torch.autograd.grad((made(coefficients) * pull).sum(), coefficients)[0]
        for made in (lambda c: evaluate(composed, c), lambda c: exact(body, transfer, c))
    ]
    torch.testing.assert_close(*grads, rtol=1e-4, atol=1e-4)


def test_without_coefficients(transfer, body):
    """A backend with one body and no parameters composes, too."""
    linear = body.linear_basis()
    empty = type(linear)(template=linear.template, basis=linear.basis[:0], coefficients=lambda params: None)
    composed = compose(empty, transfer, torch.zeros(0, dtype=torch.float64))
    got = evaluate(composed, torch.zeros(1, 0, dtype=torch.float64))
    assert miss_mm(got, transfer(linear.template[None])) < SAME_MM


def test_many_columns_are_composed_in_parts(transfer, body):
    """More columns than one part holds: columns must not move."""
    linear = body.linear_basis()
    repeated = type(linear)(
        template=linear.template, basis=linear.basis.repeat(15, 1, 1), coefficients=lambda params: None
    )
    wide = compose(repeated, transfer, torch.zeros(75, dtype=torch.float64))
    narrow = compose(linear, transfer, torch.zeros(5, dtype=torch.float64))
    torch.testing.assert_close(wide.basis, narrow.basis.repeat(1, 15))


def test_pass_through_is_the_basis_itself():
    mesh_native = torch.as_tensor(MESH.vertices) * 100
    basis = randn(40, MESH.vertex_count, 3, seed=4)
    spec = tiny_spec(None, up="+y", forward="+z")
    transfer = make_transfer(spec, MESH, None, dtype=torch.float64, device=CPU)
    linear = LinearBody().linear_basis()
    linear = type(linear)(template=mesh_native, basis=basis, coefficients=lambda params: None)
    composed = compose(linear, transfer, torch.zeros(40, dtype=torch.float64))
    coefficients = randn(3, 40, seed=5)
    expected = transfer(mesh_native + torch.einsum("bk,knc->bnc", coefficients, basis))
    torch.testing.assert_close(evaluate(composed, coefficients), expected)
    assert composed.exact is None


@pytest.mark.parametrize("wrapped", [True, False])
def test_a_template_of_another_mesh_is_refused(transfer, wrapped):
    linear = LinearBody().linear_basis()
    wrong = type(linear)(
        template=linear.template[:-1] if wrapped else linear.template.repeat(2, 1),
        basis=linear.basis[:, :-1] if wrapped else linear.basis.repeat(1, 2, 1),
        coefficients=lambda params: None,
    )
    plain = make_transfer(tiny_spec(None), MESH, None, dtype=torch.float64, device=CPU)
    with pytest.raises(InputError, match=rf"native vertices: got \(1, {len(wrong.template)}, 3\), expected"):
        compose(wrong, transfer if wrapped else plain, torch.zeros(5, dtype=torch.float64))


# --- the rest shape, skeleton included ------------------------------------------------------------------


def rest_shape(pair, *, exact, dtype=torch.float64, **changes):
    spec = tiny_spec(pair, **changes)
    return make_rest_shape(
        spec,
        LinearBody(dtype=dtype),
        MESH,
        RIG,
        dtype=dtype,
        device=CPU,
        exact=exact,
        warp=False,
        wrap_mesh=MESH,
        isolated=lambda stage: nullcontext(),
    )


BODIES = {"shape": 1.5 * randn(6, 4, seed=6), "size": torch.tensor([0.6, 1.0, 1.0, 1.3, 1.0, 0.9]).double()}


@pytest.mark.parametrize("segments", [(), ("eye_bags", "mouth_bag")])
def test_composed_rest_shape_equals_the_exact_one(pair, segments):
    made = [rest_shape(pair, exact=choice, fill_segments=segments)(BODIES) for choice in (False, True)]
    (vertices, fitted), (exact_vertices, exact_fitted) = made
    assert vertices.shape == exact_vertices.shape
    assert 1e3 * float((vertices - exact_vertices).abs().max()) < COMPOSED_MM
    torch.testing.assert_close(fitted, exact_fitted, atol=1e-5, rtol=0)  # 0.01 mm; radians on centimetre arms


def test_composed_rest_shape_in_float32(pair):
    single = {name: value.float() for name, value in BODIES.items()}
    vertices, fitted = rest_shape(pair, exact=False, dtype=torch.float32)(single)
    exact_vertices, exact_fitted = rest_shape(pair, exact=True)(BODIES)
    assert 1e3 * float((vertices - exact_vertices).abs().max()) < COMPOSED_MM
    torch.testing.assert_close(fitted.double(), exact_fitted, atol=1e-4, rtol=0)
