"""Inverse skinning level by level: each step is the best for its joints, and the energy never rises."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.inversion.analytical import Analytical, AnalyticalOptions, Level
from soma_core.inversion.problem import Pose
from soma_core.inversion.start import ProcrustesStart, best_translation
from tests.bodies import CPU, randn
from tests.inversion.small_problem import part, pose_about, real, synthetic

FRAMES = 4
EXACT = 1e-9
"""Relative, float64: sums of thousands of products in another order."""
PRIOR = 1e-5
"""Relative to the energy a joint can gain: the weak pull towards the present rotation."""
ORTHONORMAL = {torch.float64: 1e-13, torch.float32: 5e-6}
RECOVERED_MM = {1: 9.0, 3: 6.5, 40: 4.0}
"""Mean vertex error after so many full sweeps at 0.3 rad an axis, 16 mm at the start: the rate is linear."""
AGAIN = 0.02
"""Of a step, when it is repeated: what the pull towards the present rotation had held back."""
AGREE_M = 1e-4
"""Between float32 and float64, after three sweeps."""


def analytical(which, dtype=torch.float64, **options):
    return Analytical(which.structure, which.rig, which.solver(dtype), options=AnalyticalOptions(**options))


class Case:
    """Targets of one pose, and a start some way off."""

    def __init__(
        self, body, *, noise=0.0, spread=0.3, off=0.2, count=FRAMES, dtype=torch.float64, weights=None
    ):
        self.body, self.identity = body, body.identities(1, dtype=dtype)
        self.weights = body.plain_weights(dtype) if weights is None else weights
        rotations, hips = body.poses(count, spread=spread, dtype=dtype)
        self.vertices = body.posed(self.identity, rotations, hips)
        self.vertices = self.vertices + noise * randn(*self.vertices.shape, seed=30, dtype=dtype)
        self.rest = body.rest(self.identity, self.weights)
        self.target, self.origin = body.moments(dtype).target(self.vertices, self.rest)
        self.truth = pose_about(rotations, hips, self.origin)
        wrong = axis_angle_to_matrix(off * randn(*rotations.shape[:2], 3, seed=31, dtype=dtype)) @ rotations
        self.start = pose_about(wrong, hips + off * 0.1 * randn(count, 3, seed=32, dtype=dtype), self.origin)

    def energy(self, pose):
        return self.body.energy(self.identity, self.weights, self.vertices, pose, self.origin)

    def error_mm(self, pose):
        reached = self.body.posed(self.identity, pose.relative[:, 1:], pose.translation + self.origin)
        fitted = torch.tensor(self.body.structure.fitted)
        return 1e3 * (reached - self.vertices)[:, fitted].norm(dim=-1).mean()

    def fit(self, **options):
        return analytical(self.body, self.target.dtype, **options)(self.target, self.rest, self.start)


def procrustes(case):
    """Where the ladder starts without vertices."""
    body = case.body
    relative = ProcrustesStart(body.structure, dtype=case.target.dtype, device=CPU)(case.target, case.rest)
    pose = replace(case.start, relative=relative, translation=torch.zeros_like(case.origin))
    turns, places = body.solver().walk(pose, case.rest)
    joints = body.structure.joints
    shift = best_translation(case.target, case.rest, turns[:, joints], places[:, joints])
    return replace(pose, translation=shift)


def joint(body, name):
    return body.rig.joint_names.index(name)


def alone(case, name, start=None):
    """The step of one joint."""
    body, stage = case.body, analytical(case.body)
    level = Level(body.structure, np.array([joint(body, name)]), device=CPU)
    second = stage.solver.dense(case.rest.second)
    return stage.sweep(start or case.start, [level], case.target, case.rest, second)


def turned(pose, index, turns):
    """The pose with one joint turned further, before its own rotation."""
    relative = pose.relative.clone()
    relative[:, index] = relative[:, index] @ turns
    return replace(pose, relative=relative)


@pytest.mark.parametrize("name", ["Spine1", "LeftShoulder", "LeftArm", "RightShin", "Head", "LeftHandIndex2"])
def test_a_step_is_the_best_of_its_joint(name):
    case = Case(real(), noise=0.01)
    index, found = joint(real(), name), alone(case, name)
    others = np.delete(np.arange(real().rig.joint_count), index)
    assert torch.equal(found.relative[:, others], case.start.relative[:, others])
    assert torch.equal(found.translation, case.start.translation)
    lowest, before = case.energy(found), case.energy(case.start)
    assert (lowest < before).all()
    for trial in range(24):
        angle = [1e-3, 0.05, 0.5, 3.0][trial % 4]
        turns = axis_angle_to_matrix(angle * randn(FRAMES, 3, seed=trial))
        assert (case.energy(turned(found, index, turns)) >= lowest - PRIOR * (before - lowest)).all()
    again = alone(case, name, found)
    first, second = (found.relative - case.start.relative).norm(), (again.relative - found.relative).norm()
    assert second < AGAIN * first


def test_the_hips_take_the_translation_with_them():
    case = Case(real(), noise=0.01, off=0.5)
    found = alone(case, "Hips")
    lowest, before = case.energy(found), case.energy(case.start)
    for trial in range(40):
        size = [1e-4, 1e-2, 1.0, 0.0][trial % 4]
        angle = [0.0, 1e-3, 0.1, 1.0][trial // 4 % 4]
        trial_pose = turned(found, 1, axis_angle_to_matrix(angle * randn(FRAMES, 3, seed=trial)))
        trial_pose = replace(
            trial_pose, translation=found.translation + size * randn(FRAMES, 3, seed=trial + 50)
        )
        assert (case.energy(trial_pose) >= lowest - PRIOR * (before - lowest)).all()
    mean = case.body.posed(case.identity, found.relative[:, 1:], found.translation + case.origin)
    residual = (case.weights[..., None] * (mean - case.vertices)).sum(1)
    torch.testing.assert_close(residual, torch.zeros_like(residual), atol=1e-9, rtol=0)


@pytest.mark.parametrize("spread", [0.3, 1.5])
@pytest.mark.parametrize("make", [synthetic, real])
def test_no_sweep_raises_the_energy(make, spread):
    case = Case(make(), noise=0.02, spread=spread, off=spread)
    stage = analytical(case.body)
    second = stage.solver.dense(case.rest.second)
    pose, energy = case.start, case.energy(case.start)
    for levels in (stage.body, stage.body, stage.fingers, stage.full, stage.full):
        pose = stage.sweep(pose, levels, case.target, case.rest, second)
        now = case.energy(pose)
        assert (now <= energy * (1 + EXACT)).all()
        mass = case.weights.sum(1)
        expected = ((energy - now) / mass).sqrt()
        torch.testing.assert_close(pose.last_change, expected, rtol=1e-6, atol=1e-8)
        energy = now


def test_a_level_that_would_overshoot_is_left_as_it_was():
    """Three fingers or more move each of these vertices; each would make up for all of the displacement."""
    body = synthetic()
    fingers = [joint(body, f"LeftHand{finger}2") for finger in ("Thumb", "Index", "Middle", "Ring", "Pinky")]
    shared = (body.skin_weights[:, fingers] > 0.02).sum(1) >= 3
    case = Case(body, weights=body.plain_weights() * torch.tensor(shared), off=0)
    vertices = case.vertices + 1e-3 * randn(FRAMES, 1, 3, seed=3)
    target, origin = body.moments().target(vertices, case.rest)
    start = pose_about(*body.poses(FRAMES), origin)
    stage = analytical(body)
    level = Level(body.structure, np.array(fingers), device=CPU)
    found = stage.sweep(start, [level], target, case.rest, stage.solver.dense(case.rest.second))
    assert torch.equal(found.relative, start.relative)
    assert torch.equal(found.accepted, start.accepted)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_solution_is_a_fixed_point(dtype):
    case = Case(real(), dtype=dtype)
    found = analytical(case.body, dtype)(case.target, case.rest, case.truth)
    assert case.error_mm(found) < (1e-6 if dtype == torch.float64 else 1e-2)


def test_more_sweeps_come_closer():
    case = Case(real())
    case.start = procrustes(case)
    errors = {count: case.error_mm(case.fit(body=0, full=count)) for count in RECOVERED_MM}
    for count, bound in RECOVERED_MM.items():
        assert errors[count] < bound
    assert errors[40] < errors[3] < errors[1] < case.error_mm(case.start)


def test_a_schedule_is_its_sweeps_in_order():
    case = Case(synthetic(), noise=0.01)
    stage = analytical(case.body)
    second = stage.solver.dense(case.rest.second)
    pose = case.start
    for levels in (stage.body, stage.fingers, stage.fingers, stage.full):
        pose = stage.sweep(pose, levels, case.target, case.rest, second)
    found = case.fit(body=1, fingers=2, full=1)
    assert torch.equal(found.relative, pose.relative)
    assert torch.equal(found.accepted, pose.accepted)
    assert torch.equal(case.fit(body=0, full=0).relative, case.start.relative)


@pytest.mark.parametrize(("sweep", "moves"), [("body", False), ("fingers", True)])
def test_body_and_fingers_are_apart(sweep, moves):
    case = Case(real(), noise=0.01)
    options = {"body": 0, "fingers": 0, "full": 0, sweep: 1}
    found = case.fit(**options)
    names = case.body.rig.joint_names
    fingers = [
        i for i, name in enumerate(names) if name[4:].startswith("Hand") or name[5:].startswith("Hand")
    ]
    fingers = [i for i in fingers if names[i] not in ("LeftHand", "RightHand")]
    fixed = np.setdiff1d(np.arange(len(names)), fingers) if moves else fingers
    assert torch.equal(found.relative[:, fixed], case.start.relative[:, fixed])
    free = np.intersect1d(
        fingers if moves else np.setdiff1d(np.arange(len(names)), fingers), case.body.structure.variables
    )
    assert (found.relative[:, free] - case.start.relative[:, free]).abs().amax((0, 2, 3)).min() > 0


@pytest.mark.parametrize("kind", ["point", "plane", "line", "mirrored", "noise"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_degenerate_targets_give_proper_rotations(kind, dtype):
    case = Case(real(), dtype=dtype)
    scale = {"plane": [1, 1, 0], "line": [0, 1, 0], "mirrored": [-1, 1, 1]}.get(kind, [0, 0, 0])
    vertices = case.vertices * torch.tensor(scale, dtype=dtype)
    if kind == "noise":
        vertices = randn(*vertices.shape, seed=3, dtype=dtype)
    case.vertices = vertices
    case.target, case.origin = case.body.moments(dtype).target(vertices, case.rest)
    found = case.fit()
    assert orthonormality_error(found.relative).max() < ORTHONORMAL[dtype]
    assert (case.energy(found) <= case.energy(case.start) * (1 + 1e-5)).all()


def test_joints_without_points_stay():
    body = real()
    arm = [i for i, name in enumerate(body.rig.joint_names) if name.startswith(("LeftForeArm", "LeftHand"))]
    weights = body.plain_weights()
    weights[:, body.skin_weights[:, arm].sum(1) > 0] = 0
    case = Case(body, weights=weights)
    found = case.fit()
    torch.testing.assert_close(found.relative[:, arm], case.start.relative[:, arm], atol=1e-14, rtol=0)
    assert (case.energy(found) < case.energy(case.start)).all()


def test_a_flat_cloud_does_not_pop():
    """A sheet whose noise to either side is a micrometre: neither sign nor size of it turns a joint."""
    body = synthetic()
    flat = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    identity = body.identities(1)
    bind = identity.bind_world.clone()
    bind[..., :3, 3] *= flat
    identity = replace(identity, rest=identity.rest * flat, bind_world=bind)
    rest = body.rest(identity, body.plain_weights())
    rotations, hips = body.poses(1, spread=0.2)
    vertices = body.posed(identity, rotations, hips)
    found = []
    for frame in range(6):
        noisy = vertices + 1e-6 * randn(*vertices.shape, seed=frame)
        target, origin = body.moments().target(noisy, rest)
        start = pose_about(rotations, hips, origin)
        found.append(analytical(body)(target, rest, start).relative)
    # The coarse fingers, a few points in a line, may roll; everything else may not.
    names = body.rig.joint_names
    steady = [i for i, name in enumerate(names) if i in body.structure.variables and "Hand" not in name]
    spread = torch.cat(found)[:, steady]
    assert (spread - spread[:1]).abs().max() < 1e-3


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_frames_do_not_influence_each_other(dtype):
    case = Case(real(), noise=0.01, dtype=dtype)
    whole = case.fit()
    stage = analytical(case.body, dtype)
    for frame in range(FRAMES):
        one = slice(frame, frame + 1)
        single = stage(case.target[one], case.rest, part(case.start, one))
        torch.testing.assert_close(
            single.relative, whole.relative[one], atol=1e-12 if dtype == torch.float64 else 1e-3, rtol=0
        )


def test_every_frame_may_have_its_own_identity_and_weights():
    body = real()
    identity, weights = body.identities(2), body.vertex_weights(2)
    rotations, hips = body.poses(2)
    vertices = body.posed(identity, rotations, hips) + 0.01 * randn(2, body.mesh.vertex_count, 3, seed=4)
    rest = body.rest(identity, weights)
    target, origin = body.moments().target(vertices, rest)
    start = pose_about(body.poses(2, seed=7)[0], hips, origin)
    both = analytical(body)(target, rest, start)
    for frame in range(2):
        who = replace(identity, rest=identity.rest[frame, None], bind_world=identity.bind_world[frame, None])
        mine = body.rest(who, weights[frame, None])
        own, _ = body.moments().target(vertices[frame, None], mine)
        single = analytical(body)(own, mine, part(start, slice(frame, frame + 1)))
        torch.testing.assert_close(single.relative[0], both.relative[frame], atol=1e-10, rtol=0)


def test_float32_follows_float64():
    exact, rounded = Case(real(), noise=0.01), Case(real(), noise=0.01, dtype=torch.float32)
    names = ("relative", "translation", "last_change")
    start = {name: getattr(exact.start, name).float() for name in names}
    rounded.start = Pose(**start, accepted=exact.start.accepted)
    reached = [
        case.body.posed(case.identity, pose.relative[:, 1:], pose.translation + case.origin)
        for case, pose in ((exact, exact.fit()), (rounded, rounded.fit()))
    ]
    fitted = torch.tensor(real().structure.fitted)
    assert (reached[0] - reached[1])[:, fitted].norm(dim=-1).max() < AGREE_M


@pytest.mark.parametrize("name", ["body", "fingers", "full"])
def test_a_negative_number_of_sweeps_is_refused(name):
    with pytest.raises(InputError, match=rf"analytical\.{name}: got -2, expected at least 0"):
        AnalyticalOptions(**{name: -2})
