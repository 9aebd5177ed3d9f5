"""Rigs with joints that no pose controls: folded to the public ones, and with their twist joints beside."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from assets.make.twist_template import procedural_document
from soma_core.errors import AssetError
from soma_core.rig import load_canonical
from soma_core.rig.expansion import expanded_rig, helper_bind, public_rig, with_helpers
from soma_core.rig.procedural_json import parse_procedural
from soma_core.rig.stored import StoredRig
from soma_core.rig.transforms import world_transforms
from soma_core.rig.usd import read_usd_rig

ROUNDING = 1e-12
POSITION_M = 1e-9  # metres after a way through centimetres and back

AUXILIARY = 12  # in a template of 122 joints


@pytest.fixture(scope="module")
def rig():
    return load_canonical("low")[1]


def stored(rig):
    """The rig with all its joints, as a file in centimetres states it."""
    full = expanded_rig(rig)
    worlds = [world.copy() for world in (full.bind_world, full.t_pose_world)]
    for world in worlds:
        world[:, :3, 3] *= 100
    return StoredRig(
        joint_names=full.joint_names,
        parents=full.parents,
        bind_world=worlds[0],
        t_pose_world=worlds[1],
        bind_shape=100 * full.bind_shape,
        weights=full.weights,
    )


def with_auxiliary(plain, rng):
    """Twelve joints more, leaves and joints between others, that take half of some joint's skin each."""
    count, total = len(plain.joint_names), len(plain.joint_names) + AUXILIARY
    names = (*plain.joint_names, *(f"Auxiliary{number}" for number in range(AUXILIARY)))
    parents = np.concatenate([plain.parents, np.zeros(AUXILIARY, np.int32)])
    weights = scipy.sparse.lil_array((plain.weights.shape[0], total))
    weights[:, :count] = plain.weights
    carriers = rng.permutation(np.arange(1, count))[:AUXILIARY]
    for extra, carrier in enumerate(carriers.tolist(), start=count):
        parents[extra] = carrier
        children = np.flatnonzero(plain.parents == carrier)
        if extra % 2 and len(children):
            parents[children[0]] = extra
        half = plain.weights[:, [carrier]] / 2
        weights[:, [carrier]], weights[:, [extra]] = half, half
    pad = [np.concatenate([world, world[carriers]]) for world in (plain.bind_world, plain.t_pose_world)]
    return replace(
        plain,
        joint_names=names,
        parents=parents,
        bind_world=pad[0],
        t_pose_world=pad[1],
        weights=weights.tocsr(),
    )


def shuffled(plain, rng):
    """The same joints in another order, children before parents too."""
    order = rng.permutation(len(plain.joint_names))
    place = np.append(np.argsort(order), -1)
    return replace(
        plain,
        joint_names=tuple(plain.joint_names[joint] for joint in order),
        parents=place[plain.parents[order]],
        bind_world=plain.bind_world[order],
        t_pose_world=plain.t_pose_world[order],
        weights=plain.weights[:, order],
    )


def read(rig, file):
    definition = replace(rig.procedural.definition, joint_count=len(file.joint_names))
    folded = public_rig(Path("x.usda"), file, definition)
    return with_helpers(folded.metric(folded.digest(np.zeros((0, 3)))), file, definition)


@pytest.mark.parametrize("order", ["file", "shuffled"])
@pytest.mark.parametrize("joints", [110, 122])
def test_templates_of_110_and_122_joints_are_the_same_rig(rig, joints, order):
    rng = np.random.default_rng(1)
    file = stored(rig) if joints == 110 else with_auxiliary(stored(rig), rng)
    file = shuffled(file, rng) if order == "shuffled" else file
    assert len(file.joint_names) == joints
    found = read(rig, file)
    assert found.joint_names == rig.joint_names
    np.testing.assert_array_equal(found.parents, rig.parents)
    np.testing.assert_allclose(found.bind_world, rig.bind_world, atol=POSITION_M)
    np.testing.assert_allclose(found.t_pose_world, rig.t_pose_world, atol=POSITION_M)
    assert abs(found.weights - rig.weights).max() < ROUNDING
    ours, theirs = found.procedural, rig.procedural
    assert ours.joint_names == theirs.joint_names
    np.testing.assert_array_equal(ours.start_joints, theirs.start_joints)
    np.testing.assert_allclose(ours.bind_world, theirs.bind_world, atol=POSITION_M)
    assert abs(ours.weights - theirs.weights).max() < ROUNDING


def test_the_hash_is_that_of_the_rig_without_helpers(rig):
    plain = replace(stored(rig)).keep(rig.joint_names)
    file = with_auxiliary(stored(rig), np.random.default_rng(2))
    folded = public_rig(Path("x.usda"), file, replace(rig.procedural.definition, joint_count=None))
    assert folded.digest(np.zeros((0, 3))) == plain.digest(np.zeros((0, 3)))


@pytest.mark.parametrize("name", ["LeftArmTwist3", "RightFoot"])
def test_a_skeleton_without_a_joint_of_the_definition_is_refused(rig, name):
    file = stored(rig)
    file = replace(file, joint_names=tuple("Other" if n == name else n for n in file.joint_names))
    with pytest.raises(AssetError, match=rf"lacks 1 joints of the procedural definition, first {name}"):
        public_rig(Path("x.usda"), file, rig.procedural.definition)


def test_a_definition_for_another_template_is_refused(rig):
    file = with_auxiliary(stored(rig), np.random.default_rng(3))
    with pytest.raises(AssetError, match=r"x\.usda: the skeleton has 122 joints, the definition is for 110"):
        public_rig(Path("x.usda"), file, rig.procedural.definition)


def test_helpers_of_an_identity_are_those_of_the_rig_at_its_own_bind_pose(rig):
    placed = helper_bind(rig, rig.bind_world)
    np.testing.assert_allclose(placed, rig.procedural.bind_world, atol=1e-7)  # shares of seven digits


def test_an_expanded_rig_is_a_rig_of_all_joints(rig):
    full = expanded_rig(rig)
    assert full.joint_count == 110 == full.weights.shape[1]
    assert full.procedural is None
    assert all(parent < joint for joint, parent in enumerate(full.parents.tolist()))
    local = np.linalg.inv(full.t_pose_world[full.parents]) @ full.t_pose_world
    local[0] = full.t_pose_world[0]
    np.testing.assert_allclose(world_transforms(local, full.parents), full.t_pose_world, atol=ROUNDING)


# --- through a file -------------------------------------------------------------------------------------

LEG = ("Root", "Hips", "LeftLeg", "LeftShin")
JOINTS = (
    "Root",
    "Root/Hips",
    "Root/Hips/Socket",
    "Root/Hips/Socket/LeftLeg",
    "Root/Hips/Socket/LeftLeg/LeftLegTwist1",
    "Root/Hips/Socket/LeftLeg/LeftShin",
)


def leg_definition():
    """The shipped definition cut down to one thigh with one helper, half way down."""
    document = copy.deepcopy(procedural_document(LEG))
    segment = next(part for part in document["segments"] if part["start_joint"] == "LeftLeg")
    document["segments"] = [segment | {"twist_joints": ["LeftLegTwist1"]}]
    document["template_asset"]["joint_count"] = len(JOINTS)
    rotation, place = (
        document["parameter_matrices"]["rotation"],
        document["parameter_matrices"]["translation"],
    )
    for matrix, start in ((rotation, -0.5), (place, 0.5)):
        matrix["entries"] = [
            {"row": "LeftLegTwist1", "column": "LeftLeg", "value": start},
            {"row": "LeftLegTwist1", "column": "LeftShin", "value": 0.5},
        ]
    return parse_procedural(document, Path("leg.json"))


def moved(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def test_a_file_with_a_twist_joint_and_another_one(tiny_usd):
    heights = (0, 100, 100, 95, 70, 45)
    rest = tuple(moved(0, y, 0) for y in (0, 100, 0, -5, -25, -50))
    path = tiny_usd(
        joints=JOINTS,
        bind=tuple(moved(0, y, 0) for y in heights),
        rest=rest,
        influences=((2, 4),) * 8,
        weights=((0.25, 0.75),) * 8,
    )
    found = read_usd_rig(path, definition=leg_definition()).rig
    assert found.joint_names == LEG
    assert found.parents.tolist() == [-1, 0, 1, 2]
    np.testing.assert_allclose(found.weights.toarray(), np.tile([0, 0.25, 0.75, 0], (8, 1)))
    np.testing.assert_allclose(found.procedural.weights.toarray(), np.tile([0, 0.25, 0, 0, 0.75], (8, 1)))
    np.testing.assert_allclose(found.procedural.bind_world[0, :3, 3], [0, 0.7, 0])
    assert found.procedural.start_joints.tolist() == [2]
    assert read_usd_rig(path).rig.procedural is None
    assert read_usd_rig(path).rig.joint_count == len(JOINTS)
