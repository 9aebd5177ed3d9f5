"""Adam through the forward model: never worse than its start, whatever the loss, the rates or the caller."""

from dataclasses import replace

import pytest
import torch

from soma_core import SomaLayer
from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.inversion import PoseInversion
from soma_core.inversion import autograd as module
from soma_core.inversion.autograd import Autograd, AutogradOptions, from_six
from soma_core.inversion.problem import Problem
from soma_core.inversion.regions import body_regions
from tests.bodies import randn
from tests.inversion.small_problem import part, pose_about, real, synthetic

FRAMES = 3
ORTHONORMAL = {torch.float64: 1e-14, torch.float32: 2e-6}
"""A few roundings."""
RECOVERED_MM = {100: 1.0, 300: 0.1}
"""Mean vertex error after so many steps from 0.03 rad an axis, 62 mm at the start."""
SAME_STEPS = 1e-7
"""Two losses of equal gradient, after ten steps in float64: Adam divides rounding by gradients near zero."""


class Case:
    """Targets of one pose, and a start some way off."""

    def __init__(self, body, *, noise=0.0, off=0.1, dtype=torch.float64, own=False):
        self.body, self.options = body, {}
        count = FRAMES if own else 1
        identity = body.identities(count, dtype=dtype)
        weights = body.vertex_weights(count, dtype=dtype) if own else body.plain_weights(dtype)
        rotations, hips = body.poses(FRAMES, dtype=dtype)
        vertices = body.posed(identity, rotations, hips)
        vertices = vertices + noise * randn(*vertices.shape, seed=30, dtype=dtype)
        self.problem = self.pose_problem(identity, weights, vertices)
        wrong = axis_angle_to_matrix(off * randn(*rotations.shape[:2], 3, seed=31, dtype=dtype)) @ rotations
        shift = 0.1 * off * randn(FRAMES, 3, seed=32, dtype=dtype)
        self.start = pose_about(wrong, hips + shift, self.problem.origin)

    def pose_problem(self, identity, weights, vertices):
        rest = self.body.rest(identity, weights)
        target, origin = self.body.moments(vertices.dtype).target(vertices, rest)
        return Problem(
            vertices=vertices, weights=weights, identity=identity, rest=rest, target=target, origin=origin
        )

    def fit(self, start=None, **options):
        dtype, body = self.problem.vertices.dtype, self.body
        stage = Autograd(
            body.solver(dtype), body.animation(dtype), regions=body_regions(body.mesh, body.rig),
            options=AutogradOptions(**options),
        )  # fmt: skip
        return stage(self.problem, start or self.start)

    def energy(self, pose):
        problem = self.problem
        return self.body.energy(problem.identity, problem.weights, problem.vertices, pose, problem.origin)

    def errors(self, pose):
        """(F, v) [m]."""
        problem = self.problem
        shift = pose.translation + problem.origin
        reached = self.body.posed(problem.identity, pose.relative[:, 1:], shift)
        return (reached - problem.vertices).norm(dim=-1)


def same(first, second, tolerance=0.0):
    for name in ("relative", "translation"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), atol=tolerance, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_two_columns_make_a_rotation(dtype):
    turns = from_six(randn(50, 3, 2, dtype=dtype))
    assert orthonormality_error(turns).max() < ORTHONORMAL[dtype]
    torch.testing.assert_close(from_six(turns[..., :2]), turns)
    assert torch.autograd.gradcheck(from_six, randn(2, 3, 2).requires_grad_())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_pose_is_found_again(dtype):
    case = Case(real(), off=0.03, dtype=dtype)
    fitted = torch.tensor(case.body.structure.fitted)
    for iterations, bound in RECOVERED_MM.items():
        found = case.fit(iterations=iterations)
        assert 1e3 * case.errors(found)[:, fitted].mean() < bound
    assert orthonormality_error(found.relative).max() < 10 * ORTHONORMAL[dtype]
    assert (found.accepted > 30).all()


@pytest.mark.parametrize("loss", ["moments", "vertices"])
@pytest.mark.parametrize("rate", [0.02, 0.3, 5.0])
def test_never_worse_than_the_start(loss, rate):
    case = Case(synthetic(), noise=0.01, off=0.02)
    found = case.fit(loss=loss, rate=rate, shift_rate=rate / 10, iterations=12)
    assert (case.energy(found) <= case.energy(case.start)).all()
    again = case.fit(found, loss=loss, rate=rate, shift_rate=rate / 10, iterations=12)
    assert (case.energy(again) <= case.energy(found) * (1 + 1e-12)).all()


@pytest.mark.parametrize("loss", ["moments", "vertices"])
def test_a_start_that_cannot_be_improved_is_returned_bit_for_bit(loss):
    case = Case(synthetic(), off=0.0)
    found = case.fit(loss=loss, rate=1.0, shift_rate=1.0, final=1.0, iterations=5)
    same(found, case.start)
    assert torch.equal(found.accepted, torch.zeros(FRAMES, dtype=torch.int64))
    same(case.fit(loss=loss, iterations=0), case.start)


@pytest.mark.parametrize("own", [False, True])
def test_both_losses_take_the_same_steps(own):
    case = Case(real(), noise=0.005, own=own)
    by_moments, by_vertices = (case.fit(loss=loss, iterations=10) for loss in ("moments", "vertices"))
    same(by_moments, by_vertices, SAME_STEPS)
    mass = case.problem.weights.sum(1)
    previous, last = (case.energy(case.fit(iterations=n, final=1.0)) for n in (9, 10))
    change = ((previous - last) / mass).sqrt()
    torch.testing.assert_close(case.fit(iterations=10, final=1.0).last_change, change, rtol=1e-6, atol=0)


def test_bone_scales_pass_through_skinning():
    case = Case(real())
    scale = 1 + 0.1 * randn(1, real().rig.joint_count - 1, seed=3)
    problem = case.problem
    offsets = real().animation().bone_vectors(problem.identity, scale)
    case.problem = replace(problem, bone_scale=scale, rest=replace(problem.rest, offsets=offsets))
    same(*(case.fit(loss=loss, iterations=5) for loss in ("moments", "vertices")), SAME_STEPS)


def test_a_penalty_leaves_outliers_aside():
    case = Case(synthetic())
    outlier = torch.arange(case.body.mesh.vertex_count) % 10 == 0
    vertices = case.problem.vertices.clone()
    vertices[:, outlier] += torch.tensor([0.0, 0.3, 0.0])
    clean = case.problem.vertices
    case.problem = case.pose_problem(case.problem.identity, case.problem.weights, vertices)
    squared = case.fit(loss="vertices")
    robust = case.fit(loss="vertices", penalty=lambda d2: (d2 + 0.01**2).sqrt())
    case.problem = replace(case.problem, vertices=clean)
    inside = torch.tensor(case.body.structure.fitted) & ~outlier
    plain, kept = (1e3 * case.errors(found)[:, inside].mean() for found in (squared, robust))
    assert plain > 20
    assert kept < 5


def test_a_fit_may_be_made_in_inference_mode(layer):
    identity = layer.identity()
    vertices = layer.pose(identity, *real().poses(1, dtype=torch.float32)).vertices
    with torch.inference_mode():
        found = PoseInversion(layer, stages=("transfer", "autograd"))(vertices, identity)
    expected = PoseInversion(layer, stages=("transfer", "autograd"))(vertices, identity)
    torch.testing.assert_close(found.rotations, expected.rotations)


def test_a_region_that_counts_more_is_met_better():
    case = Case(real())
    # A larger body, which no pose explains: regions compete.
    larger = 1.05 * case.problem.vertices
    case.problem = case.pose_problem(case.problem.identity, case.problem.weights, larger)
    errors = {}
    for factor in (1.0, 50.0):
        body, regions = case.body, body_regions(case.body.mesh, case.body.rig)
        options = AutogradOptions(regions={"hands": factor, "body": 1.0})
        stage = Autograd(body.solver(), body.animation(), regions=regions, options=options)
        weights = stage.weighted(case.problem.weights)
        expected = case.problem.weights.clone()
        expected[:, regions["hands"]] *= factor
        assert torch.equal(weights, expected)
        problem = case.pose_problem(case.problem.identity, weights, case.problem.vertices)
        errors[factor] = case.errors(stage(problem, case.start))[:, regions["hands"]].mean()
    assert errors[50.0] < 0.6 * errors[1.0]


@pytest.mark.parametrize("loss", ["moments", "vertices"])
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, torch.enable_grad])
def test_the_callers_grad_mode_does_not_matter(loss, mode):
    expected = Case(synthetic()).fit(loss=loss, iterations=3)
    with mode():
        case = Case(synthetic())
        found = case.fit(loss=loss, iterations=3)
    same(found, expected)
    assert not found.relative.requires_grad
    assert not found.translation.requires_grad
    assert not found.last_change.requires_grad


@pytest.mark.parametrize("loss", ["moments", "vertices"])
def test_frames_do_not_influence_each_other(loss):
    case = Case(real(), noise=0.005, own=True)
    whole, problem = case.fit(loss=loss, iterations=5), case.problem
    for frame in range(FRAMES):
        one = slice(frame, frame + 1)
        who = replace(
            problem.identity, rest=problem.identity.rest[one], bind_world=problem.identity.bind_world[one]
        )
        case.problem = case.pose_problem(who, problem.weights[one], problem.vertices[one])
        same(case.fit(part(case.start, one), loss=loss, iterations=5), part(whole, one), SAME_STEPS)


@pytest.mark.parametrize("own", [False, True])
def test_chunks_of_vertices_are_the_whole(own, monkeypatch):
    case = Case(synthetic(), own=own)
    whole = case.fit(loss="vertices", iterations=3)
    monkeypatch.setattr(module, "_POSED_AT_A_TIME", 2)
    same(case.fit(loss="vertices", iterations=3), whole, SAME_STEPS)


def test_a_frame_that_is_no_number_harms_no_other():
    case = Case(synthetic())
    expected = case.fit(iterations=3)
    target = case.problem.target.clone()
    target[1] = torch.nan
    case.problem = replace(case.problem, target=target)
    found = case.fit(iterations=3)
    others = torch.tensor([0, 2])
    same(part(found, others), part(expected, others), SAME_STEPS)
    same(part(found, slice(1, 2)), part(case.start, slice(1, 2)))


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", procedural=False)


@pytest.mark.parametrize(
    "options",
    [{}, {"loss": "vertices", "iterations": 40}, {"regions": {"hands": 5.0}}],
    ids=["moments", "vertices", "regions"],
)
def test_the_ladder_ends_in_millimetres_on_its_own_poses(layer, options):
    identity = layer.identity()
    rotations, hips = real().poses(FRAMES, dtype=torch.float32)
    vertices = layer.pose(identity, rotations, hips).vertices
    stages = ("transfer", "analytical")
    before = PoseInversion(layer, stages=stages)(vertices, identity)
    after = PoseInversion(layer, stages=(*stages, "autograd"), autograd=AutogradOptions(**options))
    result = after(vertices, identity)
    assert result.valid.all()
    fitted = torch.tensor(real().structure.fitted)
    error = 1e3 * result.vertex_error[:, fitted].mean()
    assert error < 1e3 * before.vertex_error[:, fitted].mean()
    assert error < (4.0 if "loss" in options else 1.0)


@pytest.mark.parametrize("name", ["iterations", "rate", "shift_rate", "final"])
def test_negative_numbers_are_refused(name):
    with pytest.raises(InputError, match=rf"autograd\.{name}: got -1, expected at least 0. Pass {name}="):
        AutogradOptions(**{name: -1})


def test_a_negative_factor_is_refused():
    with pytest.raises(InputError, match=r"autograd\.regions\['hands'\]: got -0.5, expected at least 0"):
        AutogradOptions(regions={"hands": -0.5})


def test_an_unknown_loss_is_refused():
    with pytest.raises(InputError, match=r"autograd\.loss: got 'l1', expected 'moments' or 'vertices'"):
        AutogradOptions(loss="l1")


def test_a_penalty_needs_vertices():
    with pytest.raises(InputError, match=r"autograd\.penalty: got one with loss='moments'.*loss='vertices'"):
        AutogradOptions(penalty=torch.sqrt)


def test_an_unknown_region_is_refused():
    with pytest.raises(InputError, match=r"autograd\.regions: got 'hair', expected among body, hands"):
        Case(real()).fit(regions={"hair": 2.0})
