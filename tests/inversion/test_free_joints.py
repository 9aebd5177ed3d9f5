"""Joint centres as unknowns: they move where they are told, and the skin of the rest shape stays."""

import numpy as np
import pytest
import torch

from soma_core.inversion.free_parameters import FreeParameters, WithJoints, body_joints
from soma_core.layer import SomaLayer

UNIT_M = 0.01


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", dtype=torch.float64)


@pytest.fixture(scope="module")
def unknowns(layer):
    return WithJoints(FreeParameters(layer), layer)


def test_the_joints_of_the_body_take_part(layer):
    names = {layer.rig.joint_names[joint] for joint in body_joints(layer)}
    assert {"LeftLeg", "RightLeg", "LeftShin", "RightArm", "LeftForeArm", "Spine1", "Head"} <= names
    assert not {"Root", "Hips", "LeftEye", "LeftHandIndex2"} & names


def test_parameters_come_first_and_joints_are_unbounded(layer, unknowns):
    parameters, count = unknowns.parameters, 3 * len(body_joints(layer))
    np.testing.assert_array_equal(unknowns.start, np.r_[parameters.start, np.zeros(count)])
    assert np.isinf(unknowns.lower[-count:]).all()
    assert np.isinf(unknowns.upper[-count:]).all()
    steps = unknowns.inward(unknowns.start, 0.1)
    np.testing.assert_array_equal(steps[:-count], parameters.inward(parameters.start, 0.1))
    assert (steps[-count:] == 0.1).all()


def test_a_shift_moves_one_centre_by_a_centimetre_and_nothing_else(layer, unknowns):
    joints = body_joints(layer)
    shift = np.zeros((len(joints), 3))
    shift[4, 1] = 1.0
    point = np.r_[unknowns.parameters.start, shift.ravel()]
    plain, moved = layer.identity(), unknowns.identities(point[None])
    torch.testing.assert_close(moved.rest, plain.rest, atol=0, rtol=0)
    step = (moved.bind_world - plain.bind_world)[0].numpy()
    expected = np.zeros_like(step)
    expected[joints[4], 1, 3] = UNIT_M
    np.testing.assert_allclose(step, expected, atol=1e-12)
