"""MHR's own parameters from bodies of this skeleton: vertices that MHR itself posed, and motions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from soma_core import InputError, SomaLayer, write_motion
from soma_core.motion import BackendChoice, ConvertOptions, FrameRange, convert_file, load_clip
from soma_core.native import ParameterFit
from tests.standins.mhr_files import StandIn, mhr_body

TRUST = {"trust": True}

SAME_MM = 0.5
"""Mean distance to vertices that the model itself can reach: what a smooth mesh loses on its way over ours."""

FIT_MM = 5.0
"""Mean distance to another skin; the stand-in has neither twist joints nor correctives."""


@pytest.fixture(scope="module")
def fit(supplied):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOMA_DATA_DIR", str(supplied))
        yield ParameterFit("mhr_lod6", options=TRUST, lod="low")


@pytest.fixture(scope="module")
def layer(supplied):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOMA_DATA_DIR", str(supplied))
        yield SomaLayer("mhr_lod6", options=TRUST, lod="low")


def turned_clip():
    """Three frames of the shipped motion, turned by 0, 100 and 200 degrees on the spot."""
    from dataclasses import replace

    from scipy.spatial.transform import Rotation

    clip = load_clip(frames=FrameRange(start=0, stop=280, step=120))
    rotations = clip.rotations.copy()
    rotations[:, 0] = Rotation.from_euler("y", [[0], [100], [200]], degrees=True).as_matrix() @ rotations[:, 0]
    return replace(clip, rotations=rotations)


def test_a_pose_of_the_model_is_found(fit, layer):
    random = np.random.default_rng(0)
    model = np.zeros((2, 130), np.float32)
    model[:, :3], model[1, 4] = [[0, 0, 0], [3, -1, 2]], 2.0
    model[:, 6:60] = 0.15 * random.standard_normal((2, 54))
    posed = fit._posed({name: torch.zeros(1, size) for name, size in (("identity", 45), ("scales", 68), ("bone_lengths", 6))}, torch.as_tensor(model))
    print(posed.shape)
