"""A body from points alone: exact ones give back its parameters, noisy ones the lengths of its bones."""

from __future__ import annotations

import pytest
import torch

from soma_core import PointInversion, SomaLayer, fit_point_identity
from soma_core.errors import InputError
from soma_core.motion import load_clip
from tests.bodies import randn

LAYER = SomaLayer("toy", lod="low")
PARAMS = {"size": 0.75, "legs": 0.9, "arms": 1.12, "shoulders": 1.1}
FREE = ("size", "legs", "arms", "shoulders")
INVERSION = PointInversion(LAYER, "smpl22")


def _points(frames: int) -> torch.Tensor:
    """Joints of a body in poses that differ, (frames, 22, 3) [m]."""
    clip = load_clip()
    clip = clip.cut(slice(0, clip.frame_count, clip.frame_count // frames))
    posed = LAYER.joints(
        LAYER.identity(PARAMS), torch.as_tensor(clip.rotations), torch.as_tensor(clip.translation)
    )
    return LAYER.points(posed, "smpl22")[:frames]


def _bones(params: object) -> torch.Tensor:
    joints = LAYER.joints(params, torch.zeros(1, 77, 3)).joints[0]
    return (joints[1:] - joints[LAYER.rig.parents[2:] - 1]).norm(dim=-1)


def test_parameters_come_back() -> None:
    found = fit_point_identity(INVERSION, _points(12), free=FREE, frames=12)
    for name, value in PARAMS.items():
        assert float(found.params[name]) == pytest.approx(value, abs=0.02), name
    assert (_bones(found.params) - _bones(PARAMS)).abs().max() < 2e-3
    assert found.converged
    assert found.pose.residual.max() < 1e-3


def test_lengths_are_told_under_noise_and_gaps() -> None:
    points = _points(30)
    points = points + 0.01 * randn(*points.shape, dtype=torch.float32)
    points[3, 4], points[7] = torch.nan, torch.nan
    found = fit_point_identity(INVERSION, points, free=FREE)
    assert (_bones(found.params) - _bones(PARAMS)).abs().max() < 0.01  # m: the acceptance bound
    assert len(found.frames) == 29


@pytest.mark.parametrize(
    ("points", "choice", "said"),
    [
        (torch.full((4, 22, 3), torch.nan), {}, "in no frame"),
        (torch.zeros(4, 22, 3), {"frames": 0}, "frames"),
        (torch.zeros(4, 22, 3), {"free": ["waist"]}, "waist"),
    ],
)
def test_what_tells_no_body_is_refused(points: torch.Tensor, choice: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        fit_point_identity(INVERSION, points, **choice)
