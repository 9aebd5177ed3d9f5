"""Gradients through a native fit, against fits of targets that were moved a little."""

from __future__ import annotations

import pytest
import torch

from soma_core.inversion.implicit import attach_gradient
from tests.native.small_model import make_fit, make_model, make_rig
from tests.native.test_poses import targets

MOVED = 1e-5
"""Metres: central differences of fits, whose steps end at a nanometre."""
CLOSE = 1e-4
"""Relative, for the same reason."""
NOISE = 0.01
"""Metres: far more than the model can follow, so that the residual's own curvature matters."""


def fitted(blend: str, noise: float):
    model = make_model(blend=blend)
    rig = make_rig(model)
    fit = make_fit(rig, model, iterations=200)
    target, _, _ = targets(rig, fit)
    away = torch.randn(target.shape, generator=torch.Generator().manual_seed(4), dtype=target.dtype)
    return rig, fit, target + noise * away


def attached(rig, fit, target, valid):
    tracked = target.clone().requires_grad_()
    pose = fit(target)
    pair = attach_gradient(
        tracked, pose.relative[:, 1:], pose.translation, model=rig,
        problem=lambda rows: fit.problem(target[rows]), valid=valid,
    )  # fmt: skip
    return tracked, pair


@pytest.mark.parametrize("noise", [0.0, NOISE], ids=["exact", "noisy"])
@pytest.mark.parametrize("blend", ["none", "linear", "curved"])
def test_it_is_what_fits_of_moved_targets_say(blend, noise):
    rig, fit, target = fitted(blend, noise)
    random = torch.Generator().manual_seed(2)
    toward = torch.randn(target.shape, generator=random, dtype=target.dtype)
    told = [torch.randn(len(target), *shape, generator=random).double() for shape in ((6, 3, 3), (3,))]

    def worth(rotations, pelvis):
        return (rotations * told[0]).sum() + (pelvis * told[1]).sum()

    tracked, pair = attached(rig, fit, target, torch.ones(len(target), dtype=torch.bool))
    (slope,) = torch.autograd.grad(worth(*pair), tracked)
    ends = [fit(target + sign * MOVED * toward) for sign in (1, -1)]
    ends = [worth(pose.relative[:, 1:], pose.translation) for pose in ends]
    expected = (ends[0] - ends[1]) / (2 * MOVED)
    torch.testing.assert_close((slope * toward).sum(), expected, rtol=CLOSE, atol=0)


def test_frames_that_are_not_valid_get_none():
    rig, fit, target = fitted("linear", 0.0)
    tracked, (rotations, pelvis) = attached(rig, fit, target, torch.tensor([True, False, True]))
    (slope,) = torch.autograd.grad(rotations.square().sum() + pelvis.sum(), tracked)
    assert not slope[1].any()
    assert slope[0].any()
