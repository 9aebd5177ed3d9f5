"""Shapes of a motion add up to its correctives."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from soma_core.correctives.shapes import corrective_shapes
from soma_core.correctives.weights import read_weights, write_weights
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.layer import SomaLayer
from soma_core.rig.manifest import CORRECTIVES_NAME, shipped_file
from tests.bodies import randn

TOLERANCE = 1e-4
"""What the files may be off [m]."""


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low")


@pytest.fixture(scope="module")
def identity(layer):
    return layer.identity({"shape": [2.0, -1.0]})


def swung(frames):
    """A motion of few ways to go, beside a little of everything."""
    time = torch.linspace(0, 6, frames)[:, None, None]
    large = torch.sin(time + randn(1, 77, 1, seed=1)) * randn(1, 77, 3, seed=2)
    return axis_angle_to_matrix((0.5 * large + 0.02 * randn(frames, 77, 3, seed=3)).float())


@pytest.mark.parametrize("frames", [1, 40, 150])
def test_shapes_add_up_to_the_offsets(layer, identity, frames):
    relative = swung(frames)
    shapes = corrective_shapes(layer.correctives, relative, identity.bind_world)
    truth = layer.correctives(relative, identity.bind_world).numpy()
    found = (shapes.weights @ shapes.targets).reshape(truth.shape)
    worst = np.linalg.norm(found - truth, axis=2).max()
    assert worst < TOLERANCE
    assert worst == pytest.approx(shapes.worst, abs=1e-6)  # of a model in float32
    assert 0 < len(shapes) <= min(frames, 192)
    assert np.abs(shapes.weights).max() == pytest.approx(1)


def test_a_tighter_tolerance_takes_more_shapes(layer, identity):
    relative = swung(90)
    counts = [
        len(corrective_shapes(layer.correctives, relative, identity.bind_world, tolerance=each))
        for each in (4e-3, 1e-3, 2e-4)
    ]
    assert counts == sorted(set(counts))


def test_targets_are_given_vertex_by_vertex(layer, identity):
    shapes = corrective_shapes(layer.correctives, swung(30), identity.bind_world)
    dense = shapes.targets.toarray().reshape(len(shapes), -1, 3)
    for index in range(len(shapes)):
        ids, offsets = shapes.target(index)
        assert (np.diff(ids) > 0).all()
        again = np.zeros_like(dense[index])
        again[ids] = offsets
        np.testing.assert_allclose(again, dense[index], atol=1e-9)


def test_the_bind_pose_has_none(layer, identity):
    local = layer.rig.t_pose_world[1:, :3, :3]
    still = torch.as_tensor(local @ local.swapaxes(-1, -2)).float()[None]
    turned = layer.correctives(still, identity.bind_world).abs().max()
    shapes = corrective_shapes(layer.correctives, still, identity.bind_world)
    assert (len(shapes) == 0) == bool(turned < TOLERANCE)


def test_correctives_that_move_nothing_have_none(identity, tmp_path):
    weights = read_weights(shipped_file(CORRECTIVES_NAME))
    write_weights(tmp_path / "still.pt", replace(weights, second=0.0 * weights.second))
    still = SomaLayer("soma", lod="low", correctives=tmp_path / "still.pt").correctives
    assert len(corrective_shapes(still, swung(3), identity.bind_world)) == 0
