"""Parameters reach the model in its order, and the model's own pose is what it is asked for."""

from __future__ import annotations

import pytest
import torch
from soma_backend_mhr._files import LOD6
from soma_backend_mhr._generator import POSE, MhrGenerator
from soma_backend_mhr._model_file import load_model

from soma_core import InputError
from tests.standins.mhr_files import StandIn, mhr_body

ROUNDING = 1e-9
"""Centimetres: float64 through a chain of a dozen joints."""
CPU, DOUBLE = torch.device("cpu"), torch.float64


@pytest.fixture(scope="module")
def model(supplied):
    path = supplied / "MHR" / "mhr_model_lod6.pt"
    return MhrGenerator(load_model(path, LOD6, device=CPU, dtype=DOUBLE, trust=True), CPU)


@pytest.fixture(scope="module")
def reference():
    return StandIn(mhr_body(6)).to(DOUBLE)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return 0.3 * torch.randn(*shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))


def split(identity: torch.Tensor, parameters: torch.Tensor):
    params = {"identity": identity, "bone_lengths": parameters[:, 130:136], "scales": parameters[:, 136:]}
    return params, {"parameters": parameters[:, :130]}


def test_the_parameters_of_a_person_give_its_vertices(model, reference):
    identity, parameters, expression = random(3, 45), random(3, 204, seed=1), random(3, 72, seed=2)
    params, pose = split(identity, parameters)
    expected = reference(identity, parameters, expression)[0]
    found = model.posed(params, pose | {"expression": expression})
    torch.testing.assert_close(found, expected, atol=ROUNDING, rtol=0)


def test_rest_is_pose_zero_without_expression(model, reference):
    identity, parameters = random(2, 45), random(2, 204)
    parameters[:, :130] = 0
    params, pose = split(identity, parameters)
    expected = reference(identity, parameters, torch.zeros(2, 72, dtype=DOUBLE))[0]
    torch.testing.assert_close(model.rest(params), expected, atol=ROUNDING, rtol=0)
    torch.testing.assert_close(model.posed(params, pose), expected, atol=ROUNDING, rtol=0)


def test_one_body_takes_many_poses_and_one_pose_many_bodies(model):
    params, pose = split(random(3, 45), random(3, 204))
    one_body = {name: value[:1] for name, value in params.items()}
    many = model.posed(one_body, pose)
    torch.testing.assert_close(many[2:], model.posed(one_body, {"parameters": pose["parameters"][2:]}))
    assert model.posed(params, {"parameters": pose["parameters"][:1]}).shape == (3, LOD6.vertex_count, 3)


def test_the_root_moves_by_tens_of_centimetres(model):
    params, pose = split(random(1, 45), torch.zeros(1, 204, dtype=DOUBLE))
    moved = pose["parameters"].clone()
    moved[0, 1] = 1
    step = model.posed(params, {"parameters": moved}) - model.posed(params, pose)
    torch.testing.assert_close(step, torch.tensor([0.0, 10, 0], dtype=DOUBLE).expand_as(step))


def test_triangles_are_the_faces_of_the_file(model):
    assert model.triangles().tolist() == mhr_body(6).faces.tolist()


@pytest.mark.parametrize(
    ("pose", "got"),
    [
        ({}, "got nothing"),
        ({"parameters": random(1, 204)}, r"got parameters \(1, 204\), expected parameters \(batch, 130\)"),
        ({"rotations": random(1, 24, 3)}, r"got rotations \(1, 24, 3\)"),
        ({"parameters": random(1, 130), "expression": random(1, 10)}, r"expression \(1, 10\)"),
        ({"parameters": random(2, 130)}, "got 2 poses and 1 expressions for 3 bodies"),
    ],
)
def test_other_poses_are_refused(model, pose, got):
    params, _ = split(random(3, 45), random(3, 204))
    with pytest.raises(InputError, match=f"pose: .*{got}"):
        model.posed(params, pose)


def test_random_poses_are_the_seed_s_own_and_keep_the_root():
    generator = MhrGenerator(None, CPU)
    first, again, other = (generator.random_poses(20, seed)["parameters"] for seed in (1, 1, 2))
    assert first.shape == (20, POSE)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert not first[:, :6].any()
    assert first.abs().max() <= 1.6
