"""Gradients through a fit, against the known inverse and differences of fits."""

from dataclasses import replace

import pytest
import torch

from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion, PosePriors
from soma_core.inversion.implicit import _System
from soma_core.inversion.problem import Pose
from soma_core.inversion.refine import Refinement
from soma_core.layer import SomaLayer
from tests.bodies import randn
from tests.native.small_model import make_fit, make_model, make_rig

FRAMES = 2
DIFFERENCE = 1e-5
AGREES = 1e-4
"""Relative: central differences of float64 fits, whose last step is below a nanometre; and float32 targets,
whose rounding turns the ends of fingers."""
SECOND = 1e-5
"""Relative: second differences in float64."""


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", dtype=torch.float64, procedural=False)


@pytest.fixture(scope="module")
def full():
    return SomaLayer("soma", lod="low", dtype=torch.float64)


@pytest.fixture(scope="module")
def identity(layer):
    return layer.identity({"shape": [1.0, -1.0]})


@pytest.fixture(scope="module")
def targets(layer, identity):
    turns = 0.25 * randn(FRAMES, 77, 3, seed=1)
    return layer.pose(identity, turns, 0.3 * randn(FRAMES, 3, seed=2)).vertices


def exact(layer, **options):
    return PoseInversion(layer, iterations=20, tolerance=1e-12, **options)


def loss(result):
    """A number that knows every determined rotation and the translation."""
    turns = randn(FRAMES, 77, 3, 3, seed=3) * result.determined[..., None, None]
    return (turns * result.rotations).sum() + (randn(FRAMES, 3, seed=4) * result.translation).sum()


def moved(layer, pose, turns, shift):
    """The layer's vertices at a pose that is turned and shifted, and the pose."""
    rotations, place = axis_angle_to_matrix(turns) @ pose[0], pose[1] + shift
    identity = layer.identity({"shape": [1.0, -1.0]})
    fitted = PoseInversion(layer)(layer.pose(identity, rotations, place).vertices, identity)
    return (fitted.rotations, fitted.translation), (rotations, place)


def moved_by_two(layer, pose, turns, shift):
    """The same of a frame of the full model and one of plain skinning."""
    rotations, place = axis_angle_to_matrix(turns) @ pose[0], pose[1] + shift
    identity = layer.identity({"shape": [1.0, -1.0]})
    full, plain = (by(identity, rotations, place).vertices for by in (layer.pose, layer.pose_plain))
    fitted = PoseInversion(layer)(torch.cat((full[:1], plain[1:])), identity)
    assert fitted.plain.tolist() == [False, True]
    return (fitted.rotations, fitted.translation), (rotations, place)


def moved_native(layer, pose, turns, shift):
    """The same of a native model with pose blend shapes."""
    from soma_core.inversion.implicit import attach_gradient

    rotations, place = axis_angle_to_matrix(turns) @ pose[0], pose[1] + shift
    rig = layer.rig
    target = rig.posed(layer.body.identity, rotations, place)
    found, still = layer(target.detach()), target.detach()
    fitted = attach_gradient(
        target, found.relative[:, 1:], found.translation, model=rig,
        problem=lambda rows: layer.problem(still[rows]), valid=torch.ones(FRAMES, dtype=torch.bool),
    )  # fmt: skip
    return fitted, (rotations, place)


@pytest.fixture(params=["plain", "default", "default float32", "two skinnings", "native"])
def instance(request):
    """A forward model, how it is posed and fitted, and its number of joints."""
    if request.param == "native":
        model = make_model()
        return make_fit(make_rig(model), model), moved_native, 6
    dtype = torch.float32 if request.param.endswith("float32") else torch.float64
    plain = request.param == "plain"
    through = moved_by_two if request.param == "two skinnings" else moved
    return SomaLayer("soma", lod="low", dtype=dtype, procedural=not plain), through, 77


def test_fitting_undoes_posing_to_first_order(instance):
    layer, through, joints = instance
    dtype = layer.weights.dtype if joints == 6 else layer.dtype
    pose = (
        axis_angle_to_matrix(0.25 * randn(FRAMES, joints, 3, seed=1)).to(dtype),
        randn(FRAMES, 3, seed=2).to(dtype),
    )
    turns, shift = (torch.zeros(FRAMES, *size, dtype=dtype).requires_grad_() for size in ((joints, 3), (3,)))
    fitted, known = through(layer, pose, turns, shift)
    moves = fitted[0].detach() - pose[0]
    seen = (moves.abs().amax((0, 2, 3)) < 0.01)[:, None, None]  # joints without skin keep the T-pose
    told = seen * randn(FRAMES, joints, 3, 3, seed=3).to(dtype), randn(FRAMES, 3, seed=4).to(dtype)
    slopes = [
        torch.autograd.grad(list(one), (turns, shift), list(told), retain_graph=True)
        for one in (fitted, known)
    ]
    found, expected = (torch.cat([one.flatten(1) for one in pair], 1) for pair in slopes)
    assert float(((found - expected).norm(dim=1) / expected.norm(dim=1)).max()) < AGREES


@pytest.mark.parametrize("noise", [0.0, 0.005])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("who", [1, FRAMES])
def test_the_gradient_is_that_of_differences(layer, identity, targets, weighted, who, noise):
    inversion = PoseInversion(layer, iterations=60, tolerance=1e-13)
    if who > 1:
        identity = layer.identity({"shape": [[1.0, -1.0]] * FRAMES})
    weights = None
    if weighted:
        weights = inversion.default_weights * (1 + torch.arange(layer.mesh.vertex_count) % 3)
    targets = targets + noise * randn(*targets.shape, seed=6)
    vertices = targets.clone().requires_grad_()
    loss(inversion(vertices, identity, weights=weights)).backward()
    step = DIFFERENCE * randn(*targets.shape, seed=5)
    ahead, behind = (loss(inversion(targets + sign * step, identity, weights=weights)) for sign in (1, -1))
    torch.testing.assert_close((vertices.grad * step).sum(), (ahead - behind) / 2, atol=0, rtol=AGREES)


PRIORS = PosePriors(limits={"LeftArm": 0.1}, rest_strength=0.003)


def test_priors_are_part_of_it(layer, identity, targets):
    inversion = PoseInversion(layer, iterations=200, tolerance=1e-13, priors=PRIORS)
    vertices = targets.clone().requires_grad_()
    loss(inversion(vertices, identity)).backward()
    step = DIFFERENCE * randn(*targets.shape, seed=5)
    ahead, behind = (loss(inversion(targets + sign * step, identity)) for sign in (1, -1))
    torch.testing.assert_close((vertices.grad * step).sum(), (ahead - behind) / 2, atol=0, rtol=AGREES)


@pytest.mark.parametrize("priors", [PosePriors(), PRIORS], ids=["default", "terms"])
def test_the_matrix_is_the_second_derivative_of_what_is_fitted(full, identity, targets, priors):
    inversion = PoseInversion(full, priors=priors)
    model, weights = inversion.model, inversion.default_weights[None]
    problem = model.problem(
        targets, full.identity({"shape": [1.0, -1.0]}), weights, None, inversion.terms, None
    )
    problem = replace(problem, doubt=inversion.doubt)
    eye = torch.eye(3).double().expand(FRAMES, 1, 3, 3)
    turns = axis_angle_to_matrix(0.25 * randn(FRAMES, 77, 3, seed=1))
    pose = Pose.begin(torch.cat((eye, turns), 1), 0.3 * randn(FRAMES, 3, seed=2) - problem.origin)
    refinement = Refinement(model, problem)
    refinement._first_view(pose)  # settles how much the doubt weighs
    problem = replace(problem, doubt=refinement.doubt)
    system = _System.at(model, problem, pose)
    step = randn(*system.slope.shape, seed=7)

    def energy(length):
        return refinement._view(model.solver.retract(pose, system.turns, length * step)).energy

    more = 1.0 if problem.doubt is None else 1 + problem.doubt.share(pose.relative[:, model.solver.variables])
    told = 4e-6 * more * (step * system.slope).sum((1, 2))
    torch.testing.assert_close(told, energy(1e-6) - energy(-1e-6), atol=0, rtol=SECOND)
    told = more * (step * system.times(step)).sum((1, 2))
    second = (energy(1e-4) + energy(-1e-4) - 2 * energy(0)) / 2e-8
    torch.testing.assert_close(told, second, atol=0, rtol=SECOND)


def test_frames_in_a_fold_of_the_correctives_are_named(full):
    identity = full.identity({"shape": [1.0, -1.0]})
    with torch.no_grad():
        vertices = full.pose(identity, 0.25 * randn(FRAMES, 77, 3, seed=1), randn(FRAMES, 3, seed=2)).vertices
    vertices = (vertices + 0.005 * randn(*vertices.shape, seed=6)).requires_grad_()
    result = PoseInversion(full)(vertices, identity)
    with pytest.warns(RuntimeWarning, match=r"of 2 frames \(.*\) got the gradient of one side"):
        loss(result).backward()
    assert bool(vertices.grad.isfinite().all())


def test_native_vertices_carry_gradients_too(layer, identity, targets):
    native = (100 * layer_mid(targets, layer)).requires_grad_()
    result = exact(layer)(native, identity, topology="native")
    loss(result).backward()
    vertices = targets.clone().requires_grad_()
    loss(exact(layer)(vertices, identity)).backward()
    # Of the mid mesh the low one is a part: the others have no say.
    torch.testing.assert_close(native.grad[:, : layer.mesh.vertex_count], vertices.grad / 100)
    assert not native.grad[:, layer.mesh.vertex_count :].any()


def layer_mid(low, layer):
    """Vertices in the number of the mid mesh, of which the low one is the beginning."""
    mid = SomaLayer("soma", dtype=torch.float64).mesh.vertex_count
    return torch.cat((low, low[:, :1].expand(-1, mid - layer.mesh.vertex_count, 3)), 1)


def test_frames_that_are_not_valid_get_no_gradient(layer, identity, targets):
    broken = targets.clone()
    broken[0] = broken[0, 0]
    vertices = broken.requires_grad_()
    result = exact(layer)(vertices, identity)
    (result.rotations.sum() + result.translation.sum()).backward()
    assert not vertices.grad[0].any()
    assert vertices.grad[1].any()


def test_vertices_without_weight_get_no_gradient(layer, identity, targets):
    inversion = exact(layer)
    weights = inversion.default_weights.clone()
    weights[::7] = 0
    vertices = targets.clone().requires_grad_()
    loss(inversion(vertices, identity, weights=weights)).backward()
    assert not vertices.grad[:, weights == 0].any()


@pytest.mark.parametrize("options", [{"robust": 0.01}, {"priors": PosePriors(temporal_strength=0.01)}])
def test_what_has_no_derivative_here_says_so(layer, identity, targets, options):
    vertices = targets.clone().requires_grad_()
    with pytest.raises(InputError, match="a tensor that requires a gradient"):
        PoseInversion(layer, **options)(vertices, identity)
