"""Unposing: what skinning did is undone, whatever is in the way."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import InversionResult, PoseInversion
from soma_core.inversion.unposing import Unposing
from soma_core.layer import SomaLayer
from tests.bodies import randn, tiny_canonical, tiny_registry

FRAMES = 8
UNCHANGED_M = 1e-9
FOUND_MM = 0.05
"""The present shape holds a hundredth of a vertex, and smoothing little where all frames agree."""


@pytest.fixture(scope="module")
def layer(tmp_path_factory):
    registry = tiny_registry(tmp_path_factory.mktemp("pair"))
    return SomaLayer("tiny", dtype=torch.float64, canonical=tiny_canonical(), registry=registry)


@pytest.fixture(scope="module")
def inversion(layer):
    return PoseInversion(layer)


@pytest.fixture(scope="module")
def poses():
    return 0.3 * randn(FRAMES, 77, 3, seed=1), randn(FRAMES, 3, seed=2)


@pytest.fixture(scope="module")
def other(layer):
    """The default body with a rest shape that no parameter makes, on the same skeleton."""
    body = layer.identity()
    height = body.rest[..., 1:2]
    return replace(body, rest=body.rest + 0.01 * torch.sin(12 * height) * torch.tensor([0.3, 0.0, 1.0]))


def known(inversion, vertices, identity, poses):
    """The true poses, as a fit would have found them."""
    found = inversion(vertices, identity)
    return replace(found, rotations=axis_angle_to_matrix(poses[0]), translation=poses[1])


def skin(inversion):
    return inversion.default_weights > 0


def test_what_the_full_model_adds_is_no_shape(poses):
    full = SomaLayer("soma", lod="low", dtype=torch.float64)
    assert full.procedural
    body, turns, places = full.identity(), axis_angle_to_matrix(poses[0][:2]), poses[1][:2]
    vertices, weights = (
        full.pose(body, turns, places).vertices,
        torch.ones(1, full.mesh.vertex_count).double(),
    )
    pose = SimpleNamespace(rotations=turns, translation=places, plain=torch.zeros(2, dtype=torch.bool))
    pose.posed = functools.partial(InversionResult.posed, pose)
    found = Unposing(full, body)(vertices, weights, body, pose)
    torch.testing.assert_close(found, body.rest, atol=UNCHANGED_M, rtol=0)


def test_a_shape_that_explains_the_frames_stays(layer, inversion, poses):
    body = layer.identity()
    vertices = layer.pose(body, *poses).vertices
    pose, weights = known(inversion, vertices, body, poses), inversion.default_weights[None]
    found = Unposing(layer, body)(vertices, weights, body, pose)
    torch.testing.assert_close(
        found[:, skin(inversion)], body.rest[:, skin(inversion)], atol=UNCHANGED_M, rtol=0
    )


def test_another_shape_is_found_in_rounds(layer, inversion, poses, other):
    vertices = layer.pose(other, *poses).vertices
    body, weights = layer.identity(), inversion.default_weights[None]
    before = (body.rest - other.rest)[0, skin(inversion)].norm(dim=-1).mean() * 1e3
    unposing, found = Unposing(layer, body), body
    for _ in range(3):
        pose = known(inversion, vertices, found, poses)
        found = replace(found, rest=unposing(vertices, weights, found, pose))
    after = (found.rest - other.rest)[0, skin(inversion)].norm(dim=-1).mean() * 1e3
    assert before > 5
    assert after < FOUND_MM


def test_vertices_that_no_frame_shows_move_with_their_surroundings(layer, inversion, poses):
    """A body moved as a whole, in its bind pose, with a hole."""
    body, shift = layer.identity(), torch.tensor([0.02, 0.0, 0.01], dtype=torch.float64)
    moved = replace(body, rest=body.rest + shift)
    vertices = layer.pose(moved, *poses).vertices
    centre = body.rest[0, 100]
    hole = (body.rest[0] - centre).norm(dim=-1) < 0.08
    weights = torch.where(hole, 0.0, inversion.default_weights)[None]
    assert hole.sum() > 5
    vertices[:, hole] = torch.nan
    pose = known(inversion, vertices, body, poses)
    found = Unposing(layer, body)(torch.where(hole[:, None], 0.0, vertices), weights, body, pose)
    step = (found - body.rest)[0, hole]
    torch.testing.assert_close(step, shift.expand_as(step), atol=1e-3, rtol=0)


def test_noise_is_smoothed_rather_than_believed(layer, inversion, poses):
    body, weights = layer.identity(), inversion.default_weights[None]
    vertices = layer.pose(body, *poses).vertices
    vertices = vertices + 0.005 * randn(*vertices.shape, seed=7)
    pose = known(inversion, vertices, body, poses)
    found = Unposing(layer, body)(vertices, weights, body, pose)
    error = (found - body.rest)[0, skin(inversion)].square().sum(-1).mean().sqrt()
    believed = 0.005 * (3 / FRAMES) ** 0.5  # the mean of the frames
    assert error < 0.4 * believed
