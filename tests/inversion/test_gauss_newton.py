"""Levenberg-Marquardt on moments: its derivatives, and that it only ever goes down."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.inversion.gauss_newton import GaussNewton
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.problem import Pose
from soma_core.skeleton.identity import Identity
from tests.bodies import randn
from tests.inversion.small_problem import Body, part, pose_about, real, synthetic

EXACT = 1e-9
"""Relative, float64: sums of thousands of products in another order."""
REACHED_M = {torch.float64: 1e-9, torch.float32: 1e-5}
"""How near an exact solution is met; float32 rounds at 1e-7 of two metres, and fingertips add up."""
ORTHONORMAL = {torch.float64: 1e-14, torch.float32: 5e-6}
"""A few roundings."""
SEPARATE_M = {torch.float64: 1e-8, torch.float32: 3e-3}
"""By how much a batch may move vertices of the torch reference on the way to targets with 5 mm of noise.

Its products round by the size of the batch, and a float32 step carries a hundredth of its length on."""
FRAMES = 5
KINDS = [
    pytest.param(torch.float64, False, id="torch64"),
    pytest.param(torch.float32, False, id="torch32"),
    pytest.param(torch.float64, True, id="warp64"),
    pytest.param(torch.float32, True, id="warp32"),
]


@dataclass(kw_only=True)
class Case:
    """Targets, and what the solver is given of them."""

    body: Body
    identity: Identity
    weights: Tensor
    vertices: Tensor
    rest: RestMoments
    target: Tensor
    origin: Tensor

    @classmethod
    def make(cls, body: Body, identity: Identity, weights: Tensor, vertices: Tensor) -> "Case":
        rest = body.rest(identity, weights)
        target, origin = body.moments(vertices.dtype).target(vertices, rest)
        return cls(
            body=body, identity=identity, weights=weights, vertices=vertices, rest=rest, target=target,
            origin=origin,
        )  # fmt: skip

    def solve(self, start: Pose, *, warp: bool, **options) -> Pose:
        return self.body.solver(self.target.dtype, warp=warp)(self.target, self.rest, start, **options)

    def reached(self, pose: Pose) -> Tensor:
        return self.body.posed(self.identity, pose.relative[:, 1:], pose.translation + self.origin)

    def energy(self, pose: Pose) -> Tensor:
        """By the definition, in float64."""
        step = self.reached(pose).double() - self.vertices.double()
        return (self.weights.double() * step.square().sum(-1)).sum(1)

    @property
    def bind(self) -> Pose:
        return self.body.start(len(self.target), self.target.dtype)

    def about(self, rotations: Tensor, hips: Tensor) -> Pose:
        return pose_about(rotations, hips, self.origin)


def case(
    frames: int = FRAMES,
    *,
    who: int = 1,
    weighted: int = 1,
    noise: float = 0.0,
    dtype: torch.dtype = torch.float64,
    spread: float = 0.3,
    body: Body | None = None,
) -> Case:
    """Bodies in random poses, `noise` [m] off them; plain weights where `weighted` is zero."""
    body = body or real()
    identity = body.identities(who, dtype=dtype)
    weights = body.vertex_weights(weighted, dtype=dtype) if weighted else body.plain_weights(dtype)
    vertices = body.posed(identity, *body.poses(frames, spread=spread, dtype=dtype))
    return Case.make(body, identity, weights, vertices + noise * randn(*vertices.shape, seed=30, dtype=dtype))


def dense_model(case: Case, rotations: Tensor, hips: Tensor) -> Tensor:
    """Vertices (v, 3) of one pose by the textbook, open to every transform of torch."""
    body, rest, bind = case.body, case.identity.rest[0], case.identity.bind_world[0]
    turns, places = [torch.eye(3, dtype=rotations.dtype)], [torch.zeros(3, dtype=rotations.dtype)]
    for joint in range(1, body.rig.joint_count):
        above = int(body.rig.parents[joint])
        turns.append(turns[above] @ rotations[joint - 1])
        step = turns[above] @ case.rest.offsets[0, joint]
        places.append(hips if above == 0 else places[above] + step)
    total = torch.zeros_like(rest)
    for joint in body.structure.joints:
        turn = turns[joint] @ torch.tensor(body.rig.t_pose_world[joint, :3, :3]) @ bind[joint, :3, :3].T
        moved = (rest - bind[joint, :3, 3]) @ turn.T + places[joint]
        total = total + torch.tensor(body.skin_weights[:, joint : joint + 1]) * moved
    return total


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")
def test_normal_equations_are_those_of_automatic_differentiation():
    """Jacobian of the model itself under world turns of the subtrees, and a shift of everything."""
    given = case(1, noise=0.05, body=synthetic())
    rotations, hips = given.body.poses(1, seed=40)
    fitted = torch.tensor(given.body.structure.fitted)
    expected = given.body.posed(given.identity, rotations, hips)[0, fitted]
    found = dense_model(given, rotations[0], hips[0])[fitted]
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)
    solver, rest = given.body.solver(), given.rest
    turns, places = solver.walk(given.about(rotations, hips), rest)
    n = solver.variables
    above = turns[0, solver.parents[n]]

    def residual(step: Tensor) -> Tensor:
        local = (above.transpose(-1, -2) @ step[:-1, :, None]).squeeze(-1)
        moved = rotations[0].index_copy(0, n - 1, axis_angle_to_matrix(local) @ rotations[0, n - 1])
        off = dense_model(given, moved, hips[0] + step[-1]) - given.vertices[0]
        return given.weights[0, :, None].sqrt() * off

    zero = torch.zeros(len(n) + 1, 3, dtype=torch.float64)
    jacobian = torch.func.jacfwd(residual)(zero).flatten(0, 1).flatten(1)
    expected = jacobian.T @ jacobian, jacobian.T @ residual(zero).flatten()
    half_gradient = solver.gradient(turns, places, solver.dense(rest.second), given.target)
    matrix, slope = solver.normal_equations(turns, places, rest, half_gradient)
    found = matrix.reshape(expected[0].shape), slope.flatten()
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, atol=EXACT * float(theirs.abs().max()), rtol=0)


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
@pytest.mark.parametrize(("who", "weighted"), [(1, 1), (FRAMES, 1), (1, FRAMES)])
def test_the_change_of_energy_is_that_of_every_vertex(who, weighted, warp):
    given = case(who=who, weighted=weighted, noise=0.02)
    step = given.solve(given.bind, warp=warp, iterations=1)
    assert step.accepted.all()
    change = step.last_change.square() * given.weights.sum(1)
    torch.testing.assert_close(change, given.energy(given.bind) - given.energy(step), rtol=EXACT, atol=0)


@pytest.mark.parametrize(("dtype", "warp"), KINDS)
def test_the_energy_never_rises(dtype, warp):
    """From nowhere near the target, where steps are refused now and then."""
    given = case(dtype=dtype, noise=0.02)
    start = given.about(*given.body.poses(FRAMES, spread=2.0, seed=50, dtype=dtype))
    found = [given.solve(start, warp=warp, iterations=count) for count in range(10)]
    energies = torch.stack([given.energy(pose) for pose in found])
    assert (energies[1:] <= energies[:-1] * (1 + 1e-5)).all()
    accepted = torch.stack([pose.accepted for pose in found]).diff(dim=0)
    assert set(accepted.unique().tolist()) == {0, 1}, "no step was refused: this shows nothing"
    kept = accepted == 0
    assert torch.equal(energies[1:][kept], energies[:-1][kept])


@pytest.mark.parametrize(("dtype", "warp"), KINDS)
@pytest.mark.parametrize(("who", "weighted"), [(1, 0), (FRAMES, 0), (1, FRAMES)])
def test_reachable_targets_are_reached_from_the_bind_pose(who, weighted, dtype, warp):
    given = case(who=who, weighted=weighted, dtype=dtype)
    found = given.solve(given.bind, warp=warp, iterations=30)
    off = (given.reached(found) - given.vertices)[:, given.body.structure.fitted]
    assert off.abs().max() < REACHED_M[dtype]
    assert orthonormality_error(found.relative).max() < ORTHONORMAL[dtype]


@pytest.mark.parametrize(("dtype", "warp"), KINDS)
def test_the_optimum_is_a_fixed_point(dtype, warp):
    """A hundred steps at the limit of the numbers: refused ones must not blow the damping up."""
    given = case(dtype=dtype)
    start = given.about(*given.body.poses(FRAMES, dtype=dtype))
    found = given.solve(start, warp=warp, iterations=100)
    torch.testing.assert_close(given.reached(found), given.vertices, atol=REACHED_M[dtype], rtol=0)
    assert (found.last_change < REACHED_M[dtype]).all()


@pytest.mark.parametrize(("dtype", "warp"), KINDS)
def test_with_noise_the_result_is_stationary(dtype, warp):
    """The gradient in float64 at what was found, as what one variable alone could still gain [m]."""
    given, exact = case(dtype=dtype, noise=0.005), case(noise=0.005)
    found = given.solve(given.about(*given.body.poses(FRAMES, dtype=dtype)), warp=warp, iterations=40)
    rotations, hips = found.relative[:, 1:].double(), found.translation.double() + given.origin.double()
    solver = exact.body.solver()
    turns, places = solver.walk(exact.about(rotations, hips), exact.rest)
    half_gradient = solver.gradient(turns, places, solver.dense(exact.rest.second), exact.target)
    matrix, slope = solver.normal_equations(turns, places, exact.rest, half_gradient)
    diagonal = matrix.flatten(3).flatten(1, 2).diagonal(dim1=1, dim2=2)
    gain = (slope.flatten(1).square() / diagonal / exact.weights.sum(1)).sqrt()
    assert gain.max() < REACHED_M[dtype]


@pytest.mark.parametrize(("dtype", "warp"), KINDS)
def test_frames_do_not_depend_on_their_neighbours(dtype, warp):
    """In another order, alone, and beside a frame of NaN; easy frames rest early."""
    given = case(7, dtype=dtype, noise=0.005)

    def solve(frames, target=given.target):
        few = replace(given, target=target[frames], origin=given.origin[frames])
        return few.solve(part(given.bind, frames), warp=warp, iterations=15, tolerance=1e-4)

    def check(found, frames):
        """Bit for bit in Warp."""
        expected = part(whole, frames)
        if warp:
            assert torch.equal(found.relative, expected.relative)
            assert torch.equal(found.translation, expected.translation)
        few = replace(given, origin=given.origin[frames])
        # One that was cut off on its way is where rounding took it.
        rested = torch.maximum(found.last_change, expected.last_change) < 1e-4
        assert warp or rested.any() or len(frames) < 7
        reached = (few.reached(one)[rested | warp] for one in (found, expected))
        torch.testing.assert_close(*reached, atol=SEPARATE_M[dtype], rtol=0)
        assert not warp or torch.equal(found.accepted, expected.accepted)

    everyone = torch.arange(7)
    whole = solve(everyone)
    assert len(whole.accepted.unique()) > 1
    order = torch.tensor([3, 0, 6, 5, 1, 4, 2])
    check(solve(order), order)
    for frame in range(7):
        check(solve(everyone[frame : frame + 1]), everyone[frame : frame + 1])
    broken = given.target.clone()
    broken[2] = float("nan")
    beside, others = solve(everyone, broken), everyone[everyone != 2]
    check(part(beside, others), others)
    assert not beside.last_change[2] < 1e-4


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_two_identities_give_what_each_alone_gives(warp):
    given = case(2, who=2, noise=0.01)
    both = given.reached(given.solve(given.bind, warp=warp, iterations=10))
    for frame in (slice(0, 1), slice(1, 2)):
        who = replace(
            given.identity, rest=given.identity.rest[frame], bind_world=given.identity.bind_world[frame]
        )
        alone = Case.make(given.body, who, given.weights, given.vertices[frame])
        found = alone.reached(alone.solve(alone.bind, warp=warp, iterations=10))
        torch.testing.assert_close(found, both[frame], atol=1e-9, rtol=0)


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_without_steps_nothing_has_changed_and_nothing_has_converged(warp):
    given = case()
    start = given.about(*given.body.poses(FRAMES))
    found = given.solve(start, warp=warp, iterations=0)
    assert torch.equal(found.relative, start.relative)
    assert torch.equal(found.translation, start.translation)
    assert not found.accepted.any()
    assert torch.isinf(found.last_change).all()


DEGENERATE = ["no right arm", "one point", "a plane", "two vertices", "no weight", "mirrored"]


@pytest.mark.parametrize(("dtype", "warp"), KINDS)
@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_targets_stay_finite_and_are_never_made_worse(kind, dtype, warp):
    given = case(dtype=dtype, weighted=0)
    weights, vertices = given.weights, given.vertices
    if kind == "no right arm":
        weights = weights * torch.tensor(given.body.mesh.vertices[:, 0] > -0.2)
    elif kind == "two vertices":
        weights = torch.zeros_like(weights).index_fill(1, torch.tensor([100, 200]), 1)
    elif kind == "no weight":
        weights = torch.zeros_like(weights)
    else:
        scale = {"one point": (0, 0, 0), "a plane": (1, 0, 1), "mirrored": (-1, 1, 1)}[kind]
        vertices = vertices * torch.tensor(scale, dtype=dtype)
    given = Case.make(given.body, given.identity, weights, vertices)
    found = given.solve(given.bind, warp=warp, iterations=12)
    assert found.relative.isfinite().all()
    assert found.translation.isfinite().all()
    assert orthonormality_error(found.relative).max() < ORTHONORMAL[dtype]
    assert (given.energy(found) <= given.energy(given.bind)).all()


@pytest.mark.parametrize("warp", [False, True], ids=["torch", "warp"])
def test_joints_that_move_nothing_stay_where_they_start(warp):
    """The right arm has no weight; all else is met as if it were not there."""
    given, body = case(weighted=0), real()
    arm = body.structure.ancestors[body.rig.joint_names.index("RightArm")]
    weights = given.weights * torch.tensor(body.skin_weights[:, arm].sum(1) == 0)
    given = Case.make(body, given.identity, weights, given.vertices)
    found = given.solve(given.bind, warp=warp, iterations=30)
    still = [joint for joint in range(body.rig.joint_count) if arm[joint]]
    assert len(still) > 20
    torch.testing.assert_close(found.relative[:, still], given.bind.relative[:, still], atol=1e-12, rtol=0)
    off = weights[..., None] * (given.reached(found) - given.vertices)
    assert off.abs().max() < REACHED_M[torch.float64]


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    yield lambda count: torch.set_num_threads(count)
    torch.set_num_threads(before)


@pytest.mark.parametrize(("dtype", "warp"), KINDS)
def test_two_threads_find_what_one_finds(dtype, warp, two_threads):
    """Other batched factorisations of this size have gone wrong with several threads."""
    given = case(33 if warp else 6, dtype=dtype)
    found = []
    for count in (1, 2):
        two_threads(count)
        found.append(given.reached(given.solve(given.bind, warp=warp, iterations=2)))
    # Far from the minimum a step carries rounding on; a wrong factor would be off by decimetres.
    torch.testing.assert_close(found[1], found[0], atol=0.0 if warp else SEPARATE_M[dtype], rtol=0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_steps_are_recorded_as_a_cuda_graph_and_replayed_on_other_targets():
    body, device = real(), torch.device("cuda")
    given, other = case(dtype=torch.float32), case(dtype=torch.float32, spread=0.2)
    solver = GaussNewton(body.structure, dtype=torch.float32, device=device)
    rest = RestMoments(
        **{name: one.to(device) for name, one in vars(given.rest).items() if isinstance(one, torch.Tensor)}
    )
    start = Pose(**{name: value.to(device) for name, value in vars(given.bind).items()})
    target = given.target.to(device)
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        solver(target, rest, start, iterations=3)  # libraries set themselves up
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = solver(target, rest, start, iterations=3)
    target.copy_(other.target.to(device))
    graph.replay()
    expected = solver(target, rest, start, iterations=3)
    torch.testing.assert_close(found.relative, expected.relative)
