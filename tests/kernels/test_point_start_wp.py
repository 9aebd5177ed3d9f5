"""The start of fits to points in Warp: that of the torch loop, for every kind of point set."""

import numpy as np
import pytest
import torch

from soma_core import PointInversion, SomaLayer
from soma_core.evaluation.random_poses import random_axis_angles
from soma_core.kernels import point_start_wp
from tests.bodies import randn
from tests.kernels.parity import DTYPES

SAME = {torch.float32: 3e-4, torch.float64: 1e-10}


def starts(name, dtype, count):
    layer = SomaLayer("soma", lod="low", dtype=dtype)
    body, names = layer.identity(), list(layer.joint_names)
    vectors = random_axis_angles(names, count, np.random.default_rng(0))
    posed = layer.pose(body, torch.as_tensor(vectors).to(dtype))
    points = layer.points(posed, name)
    inversion = PointInversion(layer, name, kernels="warp")
    start, rest = inversion.start, inversion.model.rest(body)
    weights = (randn(count, points.shape[1], seed=1) + 0.5).clamp_min(0).to(dtype)
    return start, (rest, points, weights, start.expected(rest))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["smpl22", "coco17", "mano21-left", "markers38"])
def test_the_twin_agrees(name, dtype):
    start, given = starts(name, dtype, 35)
    for found, expected in zip(start._by_warp(*given), start._by_torch(*given), strict=True):
        torch.testing.assert_close(found, expected, atol=SAME[dtype], rtol=0)


def test_the_layout_of_a_gpu_gives_the_same(monkeypatch):
    start, given = starts("smpl22", torch.float64, 5)
    expected = start._by_warp(*given)
    monkeypatch.setattr(point_start_wp, "lane_count", lambda tensor: 1)
    for found, known in zip(start._by_warp(*given), expected, strict=True):
        torch.testing.assert_close(found, known, atol=1e-13, rtol=0)
