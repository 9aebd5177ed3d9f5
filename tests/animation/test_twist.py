"""Twist joints on the shipped rig: against a loop over helpers, and what they must preserve."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.animation.twist import Twist
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.layer import SomaLayer
from soma_core.rig import load_canonical
from soma_core.rig.procedural import MODES
from tests.bodies import CPU, randn

ROUNDING = 1e-9
"""float64, angles in radians and positions in metres."""
POSITION_M = 1e-7
"""Stored places of helpers come of shares of seven digits."""

ALIGNED, SWING, EULER = "aligned_x_swing_twist", "local_x_swing_twist", "local_x_euler"


@pytest.fixture(scope="module")
def rig():
    return load_canonical("low")[1]


@functools.cache
def body():
    return SomaLayer("soma", lod="low", dtype=torch.float64, correctives=None)


def with_modes(rig, modes):
    """The rig with a mode for every helper: one name, or a function of the helper's index."""
    names = rig.procedural.joint_names
    chosen = {name: modes if isinstance(modes, str) else modes(index) for index, name in enumerate(names)}
    definition = replace(rig.procedural.definition, modes=chosen)
    return replace(rig, procedural=replace(rig.procedural, definition=definition))


def with_definition(rig, **changes):
    definition = replace(rig.procedural.definition, **changes)
    return replace(rig, procedural=replace(rig.procedural, definition=definition))


def twist_of(rig, dtype=torch.float64):
    return Twist(rig, dtype=dtype, device=CPU)


def bind_of(rig, dtype=torch.float64):
    return torch.as_tensor(rig.bind_world.copy(), dtype=dtype)[None]


def angles(rig, turns, bind=None):
    twist = twist_of(rig)
    return (twist.channels(bind_of(rig) if bind is None else bind, turns) @ twist.mix.mT).numpy()


def posed(rig, local):
    """Turns from bind to posed and positions, (B, J, ...), for local rotations in world axes at bind."""
    turns, places = [None] * rig.joint_count, [None] * rig.joint_count
    bind = torch.as_tensor(rig.bind_world.copy())
    for joint, parent in enumerate(rig.parents.tolist()):
        own = local[:, joint]
        place = bind[joint, :3, 3]
        if parent < 0:
            turns[joint], places[joint] = own, place.expand(len(local), 3)
            continue
        turns[joint] = turns[parent] @ own
        places[joint] = places[parent] + turns[parent] @ (place - bind[parent, :3, 3])
    return torch.stack(turns, 1), torch.stack(places, 1)


def still(rig, batch=1):
    return torch.eye(3, dtype=torch.float64).repeat(batch, rig.joint_count, 1, 1)


def random_pose(rig, batch=3, size=0.7):
    local = axis_angle_to_matrix(size * randn(batch, rig.joint_count, 3, seed=5))
    local[:, 0] = torch.eye(3, dtype=torch.float64)
    return posed(rig, local)


def along(rig, segment):
    """Unit vector from the start to the end of a segment at bind."""
    start, end = (rig.bind_world[rig.joint_names.index(name), :3, 3] for name in (segment.start, segment.end))
    return (end - start) / np.linalg.norm(end - start)


# --- the loop that the vectorised evaluator must equal ---------------------------------------------------


def half_angle(matrix, axis):
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    sign = 1 if w >= 0 else -1
    return 4 * np.arctan2(sign * np.dot((x, y, z), axis), 1 + sign * w)


def naive_channel(rig, turns, mode, segment, source):
    names, bind = rig.joint_names, rig.bind_world[:, :3, :3]
    joint = names.index(source)
    parent = rig.parents[joint]
    absolute = (turns[parent] @ bind[parent]).T @ turns[joint] @ bind[joint]
    if mode == SWING:
        return half_angle(absolute, segment.sign * np.eye(3)[segment.axis])
    if mode == EULER and segment.axis == 0:
        return segment.sign * np.arctan2(absolute[2, 1], absolute[1, 1])
    if mode == EULER:
        return segment.sign * Rotation.from_matrix(absolute).as_euler("XYZ")[segment.axis]
    reference = names.index(segment.start if source == segment.end else segment.parent)
    direction = along(rig, segment)
    own = bind[names.index(segment.start)] @ (segment.sign * np.eye(3)[segment.axis])
    frame = np.empty((3, 3))
    frame[:, 0] = direction if direction @ own >= 0 else -direction
    second = bind[names.index(segment.start)][:, (segment.axis + 1) % 3]
    second = second - second @ frame[:, 0] * frame[:, 0]
    frame[:, 1] = second / np.linalg.norm(second)
    frame[:, 2] = np.cross(frame[:, 0], frame[:, 1])
    return half_angle(frame.T @ turns[reference].T @ turns[joint] @ frame, (1, 0, 0))


def naive_angles(rig, turns):
    definition, found = rig.procedural.definition, []
    for helper in rig.procedural.joint_names:
        segment = definition.segment_of(helper)
        found.append(
            sum(
                value * naive_channel(rig, turns, definition.modes[helper], segment, source)
                for source, value in definition.rotation[helper].items()
            )
        )
    return np.array(found)


@pytest.mark.parametrize("modes", [*MODES, lambda index: MODES[index % 3]], ids=[*MODES, "mixed"])
def test_angles_equal_a_loop_over_the_helpers(rig, modes):
    rig = with_modes(rig, modes)
    turns, _ = random_pose(rig)
    expected = np.stack([naive_angles(rig, one) for one in turns.numpy()])
    np.testing.assert_allclose(angles(rig, turns), expected, atol=ROUNDING)


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("mode", [SWING, EULER])
def test_the_other_axes_are_read_as_documented(rig, axis, mode):
    segments = tuple(replace(segment, axis=axis, sign=-1) for segment in rig.procedural.definition.segments)
    rig = with_modes(with_definition(rig, segments=segments), mode)
    turns, _ = random_pose(rig)
    expected = np.stack([naive_angles(rig, one) for one in turns.numpy()])
    np.testing.assert_allclose(angles(rig, turns), expected, atol=ROUNDING)


def test_world_transforms_follow_the_documented_order(rig):
    """Start joint, then the bind step, then the angle about the source axis."""
    turns, places = random_pose(rig, batch=1)
    found = twist_of(rig).world_transforms(bind_of(rig), turns, places)[0].numpy()
    bind, procedural = rig.bind_world, rig.procedural
    for row, start in enumerate(procedural.start_joints):
        step = np.linalg.inv(bind[start]) @ procedural.bind_world[row]
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec([naive_angles(rig, turns[0].numpy())[row], 0, 0]).as_matrix()
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = turns[0, start].numpy() @ bind[start, :3, :3], places[0, start].numpy()
        np.testing.assert_allclose(found[row], world @ step @ turn, atol=POSITION_M)


# --- what it must preserve ------------------------------------------------------------------------------


@pytest.mark.parametrize("repose", [True, False])
def test_nothing_twists_in_the_bind_pose(repose):
    layer = SomaLayer("soma", lod="low", dtype=torch.float64, repose=repose, correctives=None)
    identity = layer.identity({"shape": 2 * randn(3, 128)})
    world = identity.bind_world
    parents = layer.rig.parents[1:].tolist()
    absolute = world[:, parents, :3, :3].mT @ world[:, 1:, :3, :3]
    result = layer.pose(identity, absolute, world[:, 1, :3, 3], absolute=True)
    torch.testing.assert_close(result.vertices, identity.rest, atol=1e-6, rtol=0)
    helpers = layer.helper_transforms(identity, result.transforms)
    twist = layer.posing.twist
    torch.testing.assert_close(helpers[..., :3, 3], twist.bind_positions(world), atol=1e-6, rtol=0)
    torch.testing.assert_close(helpers[..., :3, :3], twist.bind_rotations(world), atol=1e-6, rtol=0)


@pytest.mark.parametrize("degrees", [-170, -90, 30, 150, 179])
@pytest.mark.parametrize("which", range(8))
def test_helpers_share_a_twist_by_their_place_on_the_segment(rig, which, degrees):
    """Of a turn of the end, or of the whole of a reversed segment, a helper at f makes the part f."""
    segment = rig.procedural.definition.segments[which]
    local = still(rig)
    turned = rig.joint_names.index(segment.start if segment.reverse else segment.end)
    vector = np.radians(degrees) * along(rig, segment)
    local[0, turned] = torch.as_tensor(Rotation.from_rotvec(vector).as_matrix())
    turns, places = posed(rig, local)
    rotated = twist_of(rig)(bind_of(rig), turns, places)[..., :3]
    for helper in segment.helpers:
        share = rig.procedural.definition.translation[helper][segment.end]
        row = rig.procedural.joint_names.index(helper)
        found = Rotation.from_matrix(rotated[0, row].numpy()).as_rotvec()
        np.testing.assert_allclose(found, share * vector, atol=1e-6)  # 0.6666667 of 3 rad


def test_bending_does_not_twist(rig):
    """A turn about an axis across the bone leaves the channel of that joint at zero."""
    for segment in rig.procedural.definition.segments:
        across = np.cross(along(rig, segment), [0.3, 0.5, 0.8])
        local = still(rig)
        vector = 1.9 * across / np.linalg.norm(across)
        joint = rig.joint_names.index(segment.end)
        local[0, joint] = torch.as_tensor(Rotation.from_rotvec(vector).as_matrix())
        rows = [rig.procedural.joint_names.index(helper) for helper in segment.helpers]
        np.testing.assert_allclose(angles(rig, posed(rig, local)[0])[0, rows], 0, atol=ROUNDING)


@pytest.mark.parametrize("mode", MODES)
def test_turning_the_whole_body_changes_no_angle(rig, mode):
    rig = with_modes(rig, mode)
    turns, _ = random_pose(rig)
    whole = axis_angle_to_matrix(randn(3, seed=8))
    np.testing.assert_allclose(angles(rig, whole @ turns), angles(rig, turns), atol=ROUNDING)


def test_a_stretched_limb_keeps_its_helpers_in_place(rig):
    """Identities and bone scales move the helpers along with the two ends of their segment."""
    layer = body()
    identity = layer.identity({"shape": 2 * randn(2, 128, seed=1)})
    scale = 1 + 0.3 * torch.rand(2, 77, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    result = layer.pose(identity, 0.5 * randn(2, 77, 3, seed=2), bone_scale=scale)
    helpers = layer.helper_transforms(identity, result.transforms, scale)[..., :3, 3]
    for segment in rig.procedural.definition.segments:
        start, end = (
            result.transforms[:, rig.joint_names.index(name), :3, 3] for name in (segment.start, segment.end)
        )
        for helper in segment.helpers:
            share = rig.procedural.definition.translation[helper][segment.end]
            place = helpers[:, rig.procedural.joint_names.index(helper)]
            torch.testing.assert_close(place, start + share * (end - start), atol=1e-7, rtol=0)


def test_a_helper_may_be_placed_by_other_helpers(rig):
    translation = dict(rig.procedural.definition.translation)
    translation["LeftArmTwist2"] = {"LeftArmTwist1": 0.5, "LeftArmTwist3": 0.5}
    chained = with_definition(rig, translation=translation)
    first, second, third = twist_of(chained).bind_positions(bind_of(chained))[0, :3]
    torch.testing.assert_close(second, (first + third) / 2, atol=ROUNDING, rtol=0)


@pytest.mark.parametrize(("axis", "sign"), [(1, 1), (2, 1), (0, -1), (1, -1)])
@pytest.mark.parametrize("mode", [ALIGNED, SWING])
def test_renaming_the_axes_of_all_joints_changes_nothing(rig, axis, sign, mode):
    """Frames turned so that the bone lies along another axis, with a definition that says so."""
    rig = with_modes(rig, mode)
    turn = np.roll(np.eye(3), axis, axis=0).T  # column `axis` of B @ turn is column 0 of B
    if sign < 0:
        turn = turn @ np.diag([-1.0 if k in (axis, (axis + 1) % 3) else 1.0 for k in range(3)])
    bind, helpers = rig.bind_world.copy(), rig.procedural.bind_world.copy()
    bind[:, :3, :3] @= turn
    helpers[:, :3, :3] @= turn
    segments = tuple(replace(segment, axis=axis, sign=sign) for segment in rig.procedural.definition.segments)
    definition = replace(rig.procedural.definition, segments=segments)
    procedural = replace(rig.procedural, definition=definition, bind_world=helpers)
    renamed = replace(rig, bind_world=bind, procedural=procedural)
    turns, places = random_pose(rig)
    ours, theirs = (twist_of(one)(bind_of(one), turns, places) for one in (rig, renamed))
    torch.testing.assert_close(ours, theirs, atol=ROUNDING, rtol=0)


# --- gradients ------------------------------------------------------------------------------------------

HALF_TURNS = [
    list(vector)
    for length in (0.0, np.pi, np.pi - 1e-6, 2 * np.pi)
    for vector in length * np.concatenate([np.eye(3), [[0.6, 0.8, 0.0]]])
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("axis", range(3))
def test_gradients_are_finite_at_every_half_turn(rig, mode, axis, dtype):
    segments = tuple(replace(segment, axis=axis) for segment in rig.procedural.definition.segments)
    rig = with_modes(with_definition(rig, segments=segments), mode)
    vectors = torch.tensor(HALF_TURNS, dtype=dtype)[:, None].repeat(1, rig.joint_count, 1).requires_grad_()
    turns = axis_angle_to_matrix(vectors)
    single = torch.eye(3, dtype=dtype).expand_as(turns).clone()
    single[:, ::2] = turns[:, ::2]  # neighbours must not turn alike, or nothing turns against anything
    moved = twist_of(rig, dtype)(bind_of(rig, dtype), single, single[..., 0])
    moved.sum().backward()
    assert moved.isfinite().all()
    assert vectors.grad.isfinite().all()


@pytest.mark.parametrize("angle", [0.4, 3.1])
def test_gradcheck_of_the_angles(rig, angle):
    """At a regular pose, and a twentieth of a radian before half a turn."""
    twist, bind = twist_of(rig), bind_of(rig)
    segment = rig.procedural.definition.segments[1]
    hand = rig.joint_names.index(segment.end)
    along_bone = torch.as_tensor(angle * along(rig, segment))

    def channels(vector, bind):
        turns = still(rig)
        turns = torch.cat(
            (turns[:, :hand], axis_angle_to_matrix(vector)[None, None], turns[:, hand + 1 :]), 1
        )
        return twist.channels(bind, turns)

    vector = (along_bone + 0.02).requires_grad_()
    assert torch.autograd.gradcheck(channels, (vector, bind.requires_grad_()), fast_mode=True)
