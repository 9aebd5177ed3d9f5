"""The body that is fitted: its derivatives, its steps and its mirror image."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from soma_core.layer import SomaLayer
from soma_core.registration.body_fit import fit_body, place_hands
from soma_core.registration.body_model import BodyModel
from soma_core.registration.digits import digit_guide
from soma_core.registration.surface import Surface

ORTHONORMAL = 1e-9
STEP_MM = 0.05  # second order of a step of 0.01 rad on a lever of a metre
SIZE = 0.02  # shapes are no similarities
SIDES_MM = 1.5  # the rig's two sides are mirror images only to a millimetre
AWAY_MM, PLACED_MM = 40.0, 12.0  # of a hand half closed; each of its joints is bent by 29 degrees
FEW = 12  # one vertex of so many is left of a hand
SETTLED_MM = 5.0  # after the seven steps of the rough fit, from 140 mm away


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return BodyModel(SomaLayer("soma", lod="low", procedural=False))


def test_the_end_of_the_way_is_the_bind_pose(model: BodyModel) -> None:
    vertices, joints = model.evaluate(model.start(1.0))
    bind = model.rig.bind_world[1:, :3, 3]
    arms = [model.layer.joint_names.index(name) for name in ("LeftHand", "RightHand")]
    height = np.ptp(vertices[:, 1])
    span = np.linalg.norm(joints[arms[0]] - joints[arms[1]]) / height
    expected = np.linalg.norm(bind[arms[0]] - bind[arms[1]]) / np.ptp(model.mesh.vertices[:, 1])
    assert abs(span - expected) < 0.03  # another body, the same pose


def test_a_step_turns_what_hangs_on_the_joint(model: BodyModel) -> None:
    pose = model.start(0.5)
    vertices, joints = model.evaluate(pose)
    place = list(model.joints).index(model.layer.joint_names.index("LeftForeArm"))
    step = np.zeros(3 * len(model.joints) + 3 + model.count)
    turn = np.array([0.0, 0.01, 0.0])
    step[3 * place : 3 * place + 3] = turn
    moved, _ = model.evaluate(model.moved_by(pose, step))
    joint = model.joints[place]
    predicted = vertices + model.moved[:, joint, None] * np.cross(turn, vertices - joints[joint])
    assert 1000 * np.linalg.norm(moved - predicted, axis=1).max() < STEP_MM


@pytest.mark.parametrize("size", [0.45, 1.0, 1.3])
def test_a_sized_body_is_as_large_in_the_same_pose(model: BodyModel, size: float) -> None:
    pose = model.start(1.4)
    sized = model.sized(pose, size)
    before, after = (model.evaluate(each)[0] for each in (pose, sized))
    assert np.ptp(after[:, 1]) / np.ptp(before[:, 1]) == pytest.approx(size, abs=SIZE)
    assert 1000 * np.abs(after.max(0) + after.min(0)).max() < STEP_MM
    np.testing.assert_array_equal(sized.rotations, pose.rotations)


def test_a_spun_hand_turns_in_its_wrist(model: BodyModel) -> None:
    pose, names = model.start(0.5), model.layer.joint_names
    before, after = (model.evaluate(each)[1] for each in (pose, model.spun(pose, "Left", 0.3)))
    moved = 1000 * np.linalg.norm(after - before, axis=1)
    wrist, knuckle = names.index("LeftHand"), names.index("LeftHandMiddle1")
    length = 1000 * np.linalg.norm(before[knuckle] - before[wrist])
    assert abs(moved[knuckle] - 2 * np.sin(0.15) * length) < STEP_MM
    still = np.array([name == "LeftHand" or not name.startswith("LeftHand") for name in names])
    assert moved[still].max() < STEP_MM


def test_a_body_like_its_left_side_is_symmetric(model: BodyModel) -> None:
    random = np.random.default_rng(0)
    pose = model.start(0.6)
    step = 0.05 * random.standard_normal(3 * len(model.joints) + 3 + model.count)
    left = model.like(model.moved_by(pose, step), "Left")
    vertices, _ = model.evaluate(left)
    gap = np.linalg.norm(vertices - vertices[model.mesh.mirror] * [-1, 1, 1], axis=1)
    assert 1000 * gap.mean() < SIDES_MM


def test_a_fit_finds_its_own_body_again(model: BodyModel) -> None:
    truth = model.start(0.8)
    step = np.zeros(3 * len(model.joints) + 3 + model.count)
    step[-model.count : -model.count + 4] = (1.0, -0.5, 0.5, 0.3)
    truth = model.moved_by(truth, step)
    vertices, _ = model.evaluate(truth)
    begin = model.start(0.8)
    surface = Surface(vertices, model.triangles)
    found = fit_body(model, surface, begin, scales=[0.2] * 4 + [0.1] * 3, ends=20.0)
    gap = np.linalg.norm(found.vertices - vertices, axis=1)[model.skin]
    assert 1000 * np.median(gap) < SETTLED_MM


def test_a_hand_far_from_its_fingers_is_closed_over_them(model: BodyModel) -> None:
    fine, names = BodyModel(SomaLayer("soma", lod="mid", procedural=False)), model.layer.joint_names
    begin, step = model.start(0.8), np.zeros(3 * len(model.joints) + 3 + model.count)
    fingers = [re.match("(Left|Right)Hand(Index|Middle|Ring|Pinky)", name) for name in names]
    for place, joint in enumerate(model.joints):
        if finger := fingers[joint]:
            step[3 * place + 2] = -0.5 if finger[1] == "Left" else 0.5
    truth, near = (model.moved_by(begin, bent * step) for bent in (1.0, 0.05))
    surface = Surface(fine.evaluate(truth)[0], fine.triangles)
    ours = np.array(fingers, bool)[model.rig.weights.toarray().argmax(1)]
    digits = digit_guide().find(surface, fine.evaluate(begin)[0])
    found = place_hands(model, begin, digits)
    ends, starts, placed = (model.evaluate(pose)[0][ours] for pose in (truth, begin, found))
    assert 1000 * np.median(np.linalg.norm(starts - ends, axis=1)) > AWAY_MM
    assert 1000 * np.median(np.linalg.norm(placed - ends, axis=1)) < PLACED_MM
    open_hand = Surface(fine.evaluate(begin)[0], fine.triangles)
    assert place_hands(model, near, digit_guide().find(open_hand, fine.evaluate(near)[0])) is near
    assert digits.least("LeftHand") > FEW
    few = {
        limb: np.where(np.arange(along.shape[1]) % FEW == 0, along, 0) for limb, along in digits.along.items()
    }
    assert place_hands(model, begin, replace(digits, along=few)) is begin  # too coarse for middles


def test_rotations_stay_rotations_over_many_steps(model: BodyModel) -> None:
    random = np.random.default_rng(3)
    pose = model.start(0.5)
    for _ in range(60):
        step = 0.3 * random.standard_normal(3 * len(model.joints) + 3 + model.count)
        pose = model.moved_by(pose, step)
    gram = pose.rotations @ pose.rotations.transpose(0, 2, 1)
    assert np.abs(gram - np.eye(3)).max() < ORTHONORMAL


def test_hands_and_feet_can_be_taken_from_the_other_side(model: BodyModel) -> None:
    step = np.zeros(3 * len(model.joints) + 3 + model.count)
    step[: 3 * len(model.joints)] = 0.1 * np.random.default_rng(0).standard_normal(3 * len(model.joints))
    pose = model.moved_by(model.start(0.5), step)
    taken = model.ends_like(pose, "Left")
    names = model.layer.joint_names
    left, right, arm = (names.index(f"{name}") for name in ("LeftHandIndex2", "RightHandIndex2", "RightArm"))
    mirror = np.diag([-1.0, 1, 1])
    np.testing.assert_allclose(
        taken.rotations[right], mirror @ pose.rotations[left] @ mirror, atol=ORTHONORMAL
    )
    np.testing.assert_array_equal(taken.rotations[[left, arm]], pose.rotations[[left, arm]])
