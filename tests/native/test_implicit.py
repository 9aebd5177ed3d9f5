"""Gradients through a native fit, against fits of targets that were moved a little."""

from __future__ import annotations

import torch

from soma_core.native.implicit import attach_gradient
from tests.native.small_model import make_fit, make_model, make_rig
from tests.native.test_poses import targets

MOVED = 1e-4
"""Metres: central differences of fits, whose steps end at a nanometre."""
CLOSE = 1e-3
"""Relative, for the same reason."""


def test_it_is_what_fits_of_moved_targets_say():
    for blended in (True, False):
        model = make_model(blended=blended)
        rig = make_rig(model)
        fit = make_fit(rig, model)
        target, _, _ = targets(rig, fit)
        random = torch.Generator().manual_seed(2)
        toward = torch.randn(target.shape, generator=random, dtype=target.dtype)
        told = [torch.randn(len(target), *shape, generator=random).double() for shape in ((6, 3, 3), (3,))]

        def worth(rotations, pelvis, told=told):
            return (rotations * told[0]).sum() + (pelvis * told[1]).sum()

        tracked = target.clone().requires_grad_()
        valid = torch.ones(len(target), dtype=torch.bool)
        (slope,) = torch.autograd.grad(worth(*attach_gradient(tracked, fit(target), fit, valid)), tracked)
        ends = [fit(target + sign * MOVED * toward) for sign in (1, -1)]
        ends = [worth(pose.relative[:, 1:], pose.translation) for pose in ends]
        expected = (ends[0] - ends[1]) / (2 * MOVED)
        torch.testing.assert_close((slope * toward).sum(), expected, rtol=CLOSE, atol=0)


def test_frames_that_are_not_valid_get_none():
    model = make_model()
    rig = make_rig(model)
    fit = make_fit(rig, model)
    target, _, _ = targets(rig, fit)
    tracked = target.clone().requires_grad_()
    valid = torch.tensor([True, False, True])
    rotations, pelvis = attach_gradient(tracked, fit(target), fit, valid)
    (slope,) = torch.autograd.grad(rotations.square().sum() + pelvis.sum(), tracked)
    assert not slope[1].any()
    assert slope[0].any()
