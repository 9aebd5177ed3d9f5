"""The body that is fitted: its derivatives, its steps and its mirror image."""

from __future__ import annotations

import numpy as np
import pytest

from soma_core.layer import SomaLayer
from soma_core.registration.body_fit import fit_body
from soma_core.registration.body_model import BodyModel
from soma_core.registration.surface import Surface

ORTHONORMAL = 1e-9
STEP_MM = 0.05  # second order of a step of 0.01 rad on a lever of a metre
SIZE = 0.02  # shapes are no similarities
SIDES_MM = 1.5  # the rig's two sides are mirror images only to a millimetre
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
