"""The native pose solver takes the steps of its torch twins, frame by frame, in any layout."""

import functools
import weakref

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.model import PoseModel
from soma_core.inversion.priors import HINGES, PosePriors, joint_terms, twist_doubt
from soma_core.inversion.problem import Pose
from soma_core.kernels import (
    _lanes,
    frame_moments_wp,
    model_residual_wp,
    nearest_rotation_wp,
    pose_solver_wp,
    skin_moments_wp,
    twist_share_wp,
)
from soma_core.layer import SomaLayer
from tests.bodies import randn
from tests.inversion.driven_layers import as_pose, layer_of
from tests.inversion.small_problem import pose_about, real
from tests.kernels.parity import DEVICES, DTYPES, quick

BATCHES = quick(1, 17, slow=[15, 16, 33])
"""Below, at and above the lanes of one group in float32, and of two and four in float64."""
AWAY = {torch.float32: 0.03, torch.float64: 0.2}
"""How far starts are from the targets [rad]; float32 steps carry a hundredth of their length as rounding."""
VERTICES_M = {torch.float32: 1e-3, torch.float64: 1e-9}
"""Where both twins are under way: rounding times the condition of fingers, not that of the fit's minimum."""
TREE = 1e-12
"""[m] and entries of rotations, float64: the same products in another order."""
SLOPES = 1e-10
"""Relative to the largest slope, float64."""
STEPS = 1e-6
"""Relative to the largest step, float64: rounding times the condition of the undamped matrix."""
LEFT_OUT = 0.02
"""Relative to the largest step: small products of modes are no part of the native matrix."""
FRAMES = 17
DAMPINGS = (0.0, 1e-4)
PLAIN = {"procedural": False, "correctives": None}


def targets(count, *, who=1, dtype=torch.float64, device="cpu"):
    """`R`, moments, origin and identity of noisy bodies, and poses to start from; plain skinning."""
    body = real()
    identity, weights = body.identities(who), body.vertex_weights(1)
    rotations, hips = body.poses(count)
    vertices = body.posed(identity, rotations, hips)
    vertices = vertices + 0.005 * randn(*vertices.shape, seed=30)
    rest = body.rest(identity, weights)
    target, origin = body.moments().target(vertices, rest)
    away, _ = body.poses(count, spread=AWAY[dtype], seed=60)
    start = pose_about(away @ rotations, hips + AWAY[dtype], origin)

    def cast(value):
        moved = {
            name: part.to(device, dtype if part.is_floating_point() else None)
            for name, part in vars(value).items()
            if isinstance(part, torch.Tensor)
        }
        return type(value)(**moved)

    return target.to(device, dtype), cast(rest), cast(start), (identity, origin)


def both(given, count, *, device="cpu", **options):
    """Poses after `count` steps, by the reference and by the twin."""
    target, rest, start, _ = given
    kind = {"dtype": target.dtype, "device": device}
    solvers = (GaussNewton(real().structure, warp=warp, **kind) for warp in (False, True))
    return [solver(target, rest, start, iterations=count, **options) for solver in solvers]


def reached(given, pose):
    identity, origin = given[3]
    rotations = pose.relative[:, 1:].double().cpu()
    return real().posed(identity, rotations, pose.translation.double().cpu() + origin)


def assert_same(given, expected, found):
    dtype = given[0].dtype
    assert found.relative.dtype == found.translation.dtype == dtype
    assert found.relative.shape == expected.relative.shape
    off = reached(given, found) - reached(given, expected)
    assert off.abs().max() < VERTICES_M[dtype]
    # In float32 a step at the limit of the numbers may look better to one and worse to the other.
    assert (found.accepted - expected.accepted).abs().max() <= (dtype == torch.float32)
    bound = {torch.float32: 1e-3, torch.float64: 1e-8}[dtype]
    torch.testing.assert_close(found.last_change, expected.last_change, rtol=bound, atol=bound * 1e-2)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shared", [True, False], ids=["one identity", "one a frame"])
def test_every_step_is_that_of_the_reference(shared, dtype, device):
    given = targets(3, who=1 if shared else 3, dtype=dtype, device=device)
    for count in range(7):
        assert_same(given, *both(given, count, device=device))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("shared", [True, False], ids=["one identity", "one a frame"])
def test_every_batch_size(shared, batch, dtype, device):
    given = targets(batch, who=1 if shared else batch, dtype=dtype, device=device)
    assert_same(given, *both(given, 2, device=device))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_tolerance_stops_the_same_frames_at_the_same_steps(dtype):
    given = targets(9, dtype=dtype)
    expected, found = both(given, 12, tolerance=1e-4)
    assert len(expected.accepted.unique()) > 1
    assert_same(given, expected, found)


@pytest.mark.parametrize(("shared", "batch"), [(True, 5), (False, 3)], ids=["one identity", "one a frame"])
def test_the_layout_of_a_gpu_takes_the_same_steps(shared, batch, monkeypatch):
    """One frame a group, as on CUDA, here on the CPU."""
    given = targets(batch, who=1 if shared else batch)
    _, expected = both(given, 5)
    monkeypatch.setattr(pose_solver_wp, "lane_count", lambda tensor: 1)
    _, found = both(given, 5)
    assert_same(given, expected, found)


def test_no_frame_at_all():
    given = targets(2)
    target, rest, start, _ = given
    none = Pose(**{name: part[:0] for name, part in vars(start).items()})
    solver = GaussNewton(real().structure, dtype=torch.float64, device="cpu", warp=True)
    found = solver(target[:0], rest, none, iterations=3)
    assert found.relative.shape == (0, *start.relative.shape[1:])
    assert found.accepted.shape == (0,)


def test_what_is_given_stays_as_it_was():
    given = targets(3)
    before = [part.clone() for part in (given[0], given[2].relative, given[2].translation)]
    both(given, 3)
    after = given[0], given[2].relative, given[2].translation
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))


def test_the_same_call_twice_gives_the_same_bits():
    """Working memory is fresh for every call."""
    given = targets(17)
    _, first = both(given, 4)
    _, second = both(given, 4)
    assert torch.equal(first.relative, second.relative)
    assert torch.equal(first.last_change, second.last_change)


KINDS = ("plain", "driven", "whole")
"""Public joints alone, with twist joints, and with correctives as well."""


@functools.cache
def model_of(kind, *, warp):
    return PoseModel(layer_of(correct=kind == "whole"), plain=kind == "plain", warp=warp)


@functools.cache
def problem(kind, *, who=1, held=False, count=FRAMES):
    """A problem of random poses with 5 mm of noise, and poses beside the targets; for either twin."""
    layer, model = layer_of(correct=kind == "whole"), model_of(kind, warp=False)
    identity = layer.identity({"shape": randn(who, 16, seed=1)})
    rotations, hips = real().poses(count, spread=0.25)
    vertices = layer.pose(identity, rotations, hips).vertices
    vertices = vertices + 0.005 * randn(*vertices.shape, seed=31)
    weights = torch.as_tensor(model.fitted, dtype=torch.float64)[None]
    away, _ = real().poses(count, spread=0.05, seed=60)
    if held:  # a hinge is kept to its axis from the start
        joints = [layer.joint_names.index(name) for name in HINGES]
        rotations, away = rotations.clone(), away.clone()
        rotations[:, joints] = away[:, joints] = torch.eye(3, dtype=torch.float64)
    terms = None
    if held:
        priors = PosePriors(limits={"LeftArm": 0.1}, hinges=HINGES, rest_strength=0.01)
        names = [layer.rig.joint_names[j] for j in model.solver.variables.tolist()]
        terms = joint_terms(priors, names, dtype=torch.float64, device="cpu")
    one = model.problem(vertices, identity, weights, None, terms, None)
    return one, as_pose(away @ rotations, hips + 0.02 - one.origin)


def relative_error(found, expected):
    """Largest error over the largest entry, frame by frame."""
    return float(((found - expected).flatten(1).norm(dim=1) / expected.flatten(1).norm(dim=1)).max())


@pytest.mark.parametrize("who", [1, FRAMES], ids=["one identity", "one a frame"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_tree_is_walked_like_the_reference(kind, who):
    one, pose = problem(kind, who=who)
    expected, found = (model_of(kind, warp=warp).walk(pose, one.rest) for warp in (False, True))
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, atol=TREE, rtol=0)


@pytest.mark.parametrize("who", [1, FRAMES], ids=["one identity", "one a frame"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_view_is_that_of_the_reference(kind, who):
    """Error, slope, moments of what is left, and activations."""
    given = problem(kind, who=who)
    expected, found = (model_of(kind, warp=warp).view(*given) for warp in (False, True))
    for name in ("energy", "slope", "residual"):
        mine, theirs = getattr(found, name), getattr(expected, name)
        assert relative_error(mine[:, None], theirs[:, None]) < SLOPES, name
    if kind != "whole":
        return
    assert relative_error(found.pull, expected.pull) < SLOPES
    for name in ("value", "before", "slope"):
        mine, theirs = getattr(found.activity, name), getattr(expected.activity, name)
        torch.testing.assert_close(mine, theirs, atol=TREE, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_steps_lead_to_the_same_poses(kind):
    one, pose = problem(kind)
    step = 0.3 * randn(FRAMES, len(model_of(kind, warp=False).solver.variables) + 1, 3, seed=9)
    poses = []
    for warp in (False, True):
        model = model_of(kind, warp=warp)
        turns, _ = model.walk(pose, one.rest)
        short = model.solver.shortened(step, turns, None)
        poses.append(model.moved(one, pose, turns, short))
    for name in ("relative", "translation"):
        torch.testing.assert_close(getattr(poses[1], name), getattr(poses[0], name), atol=TREE, rtol=0)


@pytest.mark.parametrize("kind", ["driven", "whole"])
@pytest.mark.parametrize("own", [False, True], ids=["one doubt", "one a frame"])
def test_doubt_is_that_of_the_reference(kind, own):
    one, pose = problem(kind)
    found = []
    for warp in (False, True):
        model = model_of(kind, warp=warp)
        names = [layer_of(correct=False).rig.joint_names[j] for j in model.solver.variables.tolist()]
        doubt = twist_doubt(PosePriors(), names, dtype=torch.float64, device="cpu")
        if own:
            doubt = doubt.weighed(torch.linspace(0, 2, FRAMES, dtype=torch.float64))
        found.append(model.doubted(doubt, pose.relative, model.walk(pose, one.rest)[0]))
    assert (found[0][1] != 0).any()
    for mine, theirs in zip(found[1], found[0], strict=True):
        torch.testing.assert_close(mine, theirs, atol=TREE, rtol=SLOPES)


@pytest.mark.parametrize("dtype", DTYPES)
def test_activations_squash_like_the_reference(dtype):
    """Through the whole range, and relative to what is next to nothing."""
    layer = layer_of(correct=True)
    model = PoseModel(SomaLayer(layer.backend, lod=layer.mesh.lod, dtype=dtype), plain=False, warp=True)
    identity = model.seen(SomaLayer(layer.backend, lod=layer.mesh.lod, dtype=dtype).identity())
    rest = model.rest(identity, torch.ones(1, len(model.fitted), dtype=dtype))
    relative = axis_angle_to_matrix(1.2 * randn(64, len(layer.rig.parents), 3, seed=4).to(dtype))
    _, _, _, value, before, slope = model.steps.posed(model.constants(rest), relative, relative[:, 0, 0])
    expected = torch.tanh(torch.relu(before.double()))
    assert before.max() > 2
    rounding = 4 * torch.finfo(dtype).eps
    torch.testing.assert_close(value.double(), expected, rtol=rounding, atol=0)
    rising = (before > 0) * (1 - expected.square())
    torch.testing.assert_close(slope.double(), rising, rtol=0, atol=rounding)


@pytest.mark.parametrize("held", [False, True], ids=["free", "terms and hinges"])
@pytest.mark.parametrize("who", [1, FRAMES], ids=["one identity", "one a frame"])
@pytest.mark.parametrize("kind", ["plain", "driven"])
def test_a_driven_rig_is_fitted_in_the_same_steps(kind, who, held):
    one, pose = problem(kind, who=who, held=held)
    ends = [
        model_of(kind, warp=warp).solver(one.target, one.rest, pose, iterations=6, terms=one.terms)
        for warp in (False, True)
    ]
    model = model_of(kind, warp=False)
    places = [model.walk(end, one.rest)[1] for end in ends]
    assert (ends[0].relative - pose.relative).abs().max() > 0.03
    torch.testing.assert_close(places[1], places[0], atol=VERTICES_M[torch.float64], rtol=0)
    torch.testing.assert_close(ends[1].relative, ends[0].relative, atol=STEPS, rtol=0)
    assert torch.equal(ends[1].accepted, ends[0].accepted)


def steps(kind, given, damping, slope, *, warp):
    """Solutions with the whole model's matrix."""
    one, pose = given
    model = model_of(kind, warp=warp)
    mass = one.weights.sum(1).expand(len(slope))
    size = torch.full_like(mass, damping)
    return model.inverse(one, pose, model.view(one, pose), size, mass)(slope)


@pytest.mark.parametrize("held", [False, True], ids=["free", "terms and hinges"])
@pytest.mark.parametrize("who", [1, FRAMES], ids=["one identity", "one a frame"])
@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("kind", ["plain", "driven"])
def test_a_factorised_matrix_solves_like_the_reference(kind, damping, who, held):
    given = problem(kind, who=who, held=held)
    slope = randn(FRAMES, len(model_of(kind, warp=False).solver.variables) + 1, 3, seed=9)
    expected, found = (steps(kind, given, damping, slope, warp=warp) for warp in (False, True))
    assert relative_error(found, expected) < STEPS


@pytest.mark.parametrize("damping", DAMPINGS)
def test_the_matrix_of_the_whole_model_leaves_little_out(damping):
    given = problem("whole")
    model = model_of("whole", warp=False)
    slope = model.view(*given).slope
    expected, found = (steps("whole", given, damping, slope, warp=warp) for warp in (False, True))
    assert relative_error(found, expected) < LEFT_OUT


@pytest.mark.parametrize("kind", KINDS)
def test_frames_do_not_depend_on_their_neighbours(kind):
    """Bit for bit, whatever lane a frame lies in and what fills the others."""
    model, (one, pose) = model_of(kind, warp=True), problem(kind)
    slope = randn(FRAMES, len(model.solver.variables) + 1, 3, seed=9)
    whole = steps(kind, (one, pose), 1e-4, slope, warp=True)
    fitted = model.solver(one.target, one.rest, pose, iterations=4)
    rows = torch.tensor([12, 3])
    few = steps(kind, (one.part(rows), pose.part(rows)), 1e-4, slope[rows], warp=True)
    again = model.solver(one.target[rows], one.rest, pose.part(rows), iterations=4)
    assert torch.equal(few, whole[rows])
    assert torch.equal(again.relative, fitted.relative[rows])
    assert torch.equal(again.translation, fitted.translation[rows])


def factor_of(kind, given):
    one, pose = given
    model = model_of(kind, warp=True)
    mass = one.weights.sum(1).expand(len(pose.translation))
    activity = None if model.offsets is None else model.offsets.activity(pose.relative)
    factor = model._factor(one, pose, activity, torch.zeros_like(mass), mass)
    return model.steps, factor


@pytest.mark.parametrize("held", [False, True], ids=["free", "terms and hinges"])
@pytest.mark.parametrize("who", [1, FRAMES], ids=["one identity", "one a frame"])
@pytest.mark.parametrize("kind", KINDS)
def test_variances_are_those_of_the_inverse(kind, who, held):
    """Against the same factor, solved for one unit vector after the other; it can be used again."""
    solver, factor = factor_of(kind, problem(kind, who=who, held=held))
    found = solver.variances(factor)
    count = found.shape[1]
    expected = torch.zeros_like(found)
    for joint in range(count):
        for axis in range(3):
            unit = found.new_zeros(FRAMES, count + 1, 3)
            unit[:, joint, axis] = 1
            expected[:, joint] += solver.solve(factor, unit)[:, joint, axis]
    torch.testing.assert_close(found, expected, rtol=STEPS, atol=0)
    assert torch.equal(solver.variances(factor), found)


def test_variances_in_the_layout_of_a_gpu(monkeypatch):
    """One frame a group, as on CUDA, here on the CPU."""
    found = []
    for lanes in (8, 1):
        monkeypatch.setattr(pose_solver_wp, "lane_count", lambda tensor, lanes=lanes: lanes)
        solver, factor = factor_of("whole", problem("whole"))
        found.append(solver.variances(factor))
    torch.testing.assert_close(*found, rtol=STEPS, atol=0)


@pytest.mark.parametrize("held", [False, True], ids=["free", "terms and hinges"])
@pytest.mark.parametrize("kind", KINDS)
def test_variances_are_those_of_the_reference(kind, held):
    given = problem(kind, held=held)
    expected, found = (model_of(kind, warp=warp).angle_variance(*given) for warp in (False, True))
    bound = LEFT_OUT if kind == "whole" else STEPS
    torch.testing.assert_close(found, expected, rtol=bound, atol=0)


@pytest.mark.parametrize("options", [{}, PLAIN], ids=["default", "plain"])
def test_frames_abreast_are_fitted_as_frames_in_lanes(options, monkeypatch):
    """The layout of a GPU, one frame a group and groups abreast, here in code of the CPU."""
    layer = SomaLayer("soma", lod="low", **options)
    identity, count = layer.identity(), 33
    rotations = 0.3 * randn(count, 77, 3, seed=5, dtype=torch.float32)
    vertices = layer.pose(identity, rotations, 0.1 * randn(count, 3, seed=6, dtype=torch.float32)).vertices
    weights = torch.ones(count, vertices.shape[1])
    weights[1:, :200] = 0
    fit = PoseInversion(layer, kernels="warp")
    found = [fit(vertices, identity, weights=given) for given in (None, weights)]
    for module in (
        frame_moments_wp, model_residual_wp, nearest_rotation_wp, pose_solver_wp, skin_moments_wp,
        twist_share_wp,
    ):  # fmt: skip
        monkeypatch.setattr(module, "lane_count", lambda _tensor: 1)
    monkeypatch.setattr("soma_core.inversion.refine.knows_descent", lambda *_: False)  # as on a GPU
    again = [fit(vertices, identity, weights=given) for given in (None, weights)]
    for wide, narrow in zip(found, again, strict=True):
        assert narrow.converged.all()
        assert (narrow.rotations - wide.rotations).abs().max() < 1e-3
        assert (narrow.vertex_error - wide.vertex_error).abs().nan_to_num().max() < 5e-6


def test_a_frame_takes_no_more_memory_than_is_planned(monkeypatch):
    """What kernels hold at once in the layout of a GPU, by which its chunks of frames are planned."""
    fit, count = PoseInversion(SomaLayer("soma", lod="low"), kernels="warp"), 33
    identity = fit.layer.identity()
    vertices = fit.layer.pose(identity, 0.3 * randn(count, 77, 3, seed=5, dtype=torch.float32)).vertices
    held, most = [], 0

    def rows(*given):
        nonlocal most
        made = _lanes.working_rows(*given)
        held.append(weakref.ref(made.untyped_storage()))
        alive = {id(one): one.nbytes() for one in (ref() for ref in held) if one is not None}
        most = max(most, sum(alive.values()))
        return made

    for module in (model_residual_wp, nearest_rotation_wp, pose_solver_wp, skin_moments_wp):
        monkeypatch.setattr(module, "lane_count", lambda _tensor: 1)
        monkeypatch.setattr(module, "working_rows", rows)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    assert fit(vertices, identity).converged.all()
    abreast = -(-count // _lanes.ABREAST) * _lanes.ABREAST
    assert 0.3 * fit.model.frame_bytes < most / abreast < fit.model.frame_bytes


def test_a_card_of_eighty_gigabytes_fits_thirty_thousand_frames():
    assert 0.4 * 80e9 / PoseInversion(SomaLayer("soma")).model.frame_bytes > 30e3
