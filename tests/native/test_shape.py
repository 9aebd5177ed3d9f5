"""Parameters of an unknown body beside its poses, on a small model."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.native.model import NativeBody
from soma_core.native.poses import PoseFit
from soma_core.native.shape import fit_shape
from tests.native.small_model import make_model, make_rig, random_pose

EXACT = 1e-3
"""Of a standard deviation: the doubt about parameters that weighs a tenth of a millimetre."""
FRAMES = 4


def small():
    """Pose fits of bodies by their betas (2,), and what a unit of each adds."""
    rig = make_rig(make_model())

    def prepare(betas):
        betas = torch.as_tensor(betas)
        model = make_model(betas=betas)
        body = NativeBody(params={}, identity=rig.bodies(model.rest, model.joints), pelvis=model.joints[0, 0])
        weights = torch.ones(model.rest.shape[1]).double()
        return PoseFit(rig, body, weights, iterations=20, tolerance=1e-8)

    def directions(betas):
        betas = torch.as_tensor(betas)
        model = make_model(betas=torch.cat((betas[None], betas + torch.eye(2).double())))
        return rig.bodies(model.rest[1:] - model.rest[:1], model.joints[1:] - model.joints[:1])

    return rig, prepare, directions


class Free:
    """Two parameters without bounds."""

    lower, upper = np.full(2, -np.inf), np.full(2, np.inf)

    def __init__(self, *start):
        self.start = np.array(start)


def test_body_and_poses_are_found_together():
    rig, prepare, directions = small()
    betas = torch.tensor([0.8, -1.1]).double()
    turns, pelvis = random_pose(FRAMES)
    target = rig.posed(prepare(betas).body.identity, axis_angle_to_matrix(turns), pelvis)
    free = Free(0.0, 0.0)
    found, error = fit_shape(prepare, directions, free, target, start=free.start, iterations=10)
    np.testing.assert_allclose(found, betas.numpy(), atol=EXACT, rtol=0)
    assert error < 1e-5


def test_bounds_hold():
    rig, prepare, directions = small()
    target = rig.posed(prepare([0.8, -1.1]).body.identity, *_still())
    free = Free(0.0, 0.0)
    free.upper = np.array([0.5, np.inf])
    found, _ = fit_shape(prepare, directions, free, target, start=free.start, iterations=10)
    assert found[0] == pytest.approx(0.5)


def test_what_the_frames_leave_open_stays():
    rig, prepare, directions = small()
    free = Free(0.2, 0.4)
    start = free.start
    target = rig.posed(prepare(start).body.identity, *_still())

    def blind(betas):
        identity = directions(betas)
        identity.rest[1] = 0  # the second parameter changes nothing
        identity.bind_world[1, :, :3, 3] = 0
        return identity

    noisy = target + 0.01 * torch.sin(30 * target)
    found, _ = fit_shape(prepare, blind, free, noisy, start=start, iterations=3)
    assert found[1] == start[1]
    assert found[0] != start[0]


def _still():
    eye = torch.eye(3).double().expand(1, 6, 3, 3)
    return eye, torch.zeros(1, 3).double()
