"""Linear spaces on bodies given as meshes: what a space holds comes back, what it lacks is measured."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.errors import InputError
from soma_core.evaluation import shape_space
from soma_core.evaluation.shape_space import LinearSpace
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.layer import SomaLayer
from soma_core.obj import write_obj
from soma_core.rig import load_canonical

OWN_MM = 0.05  # mean over bodies of the space: a search ends with a round that gains little
NOISE_MM, SHARE = 2.0, 0.03  # noise outside the space: a fitted pose takes up a little of it
POSED_MM = 0.2  # of one posed mesh, which leaves joint centres a little free


@pytest.fixture(autouse=True)
def low(monkeypatch):
    monkeypatch.setattr(shape_space, "_LOD", "low")


@pytest.fixture(scope="module")
def space():
    return LinearSpace(SomaLayer("soma", lod="low", dtype=torch.float64, correctives=None))


def bodies(space, count=2):
    shape = torch.randn(count, 128, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return space.layer.identity({"shape": shape}).rest


def configured(**changes):
    experiment = {"name": "shape_space", "backend": "soma", "count": 2, "methods": ["soma"], "data": None}
    experiment |= {"options": {}} | changes
    return OmegaConf.create({"experiment": experiment, "seed": 0, "device": "cpu"})


@torch.no_grad()
def test_bodies_of_a_space_are_in_it_wherever_they_stand(space):
    errors, shapes = space.project(bodies(space) + torch.tensor([3.0, -1.0, 0.5]))
    assert space.rank == 128
    assert errors.shape == (2, int(space.kept.sum()))
    assert errors.mean() < OWN_MM
    assert shapes.shape == (2, space.layer.mesh.vertex_count, 3)


@torch.no_grad()
def test_what_a_space_cannot_show_is_measured(space):
    shown = bodies(space)
    noise = torch.randn(shown.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noise *= 1e-3 * NOISE_MM / noise.norm(dim=-1, keepdim=True)
    errors, _ = space.project(shown + noise)
    assert errors.mean() == pytest.approx(NOISE_MM, rel=SHARE)


@torch.no_grad()
def test_directions_that_depend_on_others_are_not_counted(space, monkeypatch):
    layer = SomaLayer("soma", lod="low", dtype=torch.float64, correctives=None)
    basis = layer.rest_shape.basis
    layer.rest_shape.basis = torch.cat([basis[:, :5], basis[:, :5].sum(1, keepdim=True), 0 * basis[:, :2]], 1)
    monkeypatch.setattr(layer.rest_shape, "_linear_coefficients", lambda params: params["shape"][:, :8])
    assert LinearSpace(layer).rank == 5


def test_a_model_that_is_not_linear_is_named():
    with pytest.raises(InputError, match=r"experiment.methods: got toy, whose bodies are not linear"):
        LinearSpace(SomaLayer("toy", lod="low", exact=True))


def written(path, *, scale):
    """A posed body at the full mesh, in another unit and turned."""
    layer = SomaLayer("soma", dtype=torch.float64)
    turns = torch.zeros(1, 77, 3, dtype=torch.float64)
    for joint, angle in (("LeftArm", [0, 0, -0.6]), ("RightShin", [0.5, 0, 0]), ("Hips", [0, 2.0, 0])):
        turns[0, layer.joint_names.index(joint)] = torch.tensor(angle, dtype=torch.float64)
    shape = torch.randn(1, 128, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with torch.no_grad():
        posed = layer.pose(layer.identity({"shape": shape}), axis_angle_to_matrix(turns)).vertices[0]
    write_obj(path, scale * posed.numpy(), load_canonical("mid")[0].triangles)


@pytest.mark.slow
def test_posed_meshes_of_a_folder_are_unposed_in_their_own_unit(tmp_path):
    written(tmp_path / "centimetres.obj", scale=100)
    report = shape_space.run(configured(data=str(tmp_path)))
    (table,) = report.tables
    (row,) = table.rows
    assert row[:3] == ["soma", f"1 of {tmp_path.name}", 128.0]
    assert 0 < row[3] < POSED_MM
    assert [figure.bound for figure in report.figures] == [None]
    (shown,) = report.bodies
    assert np.isnan(shown.errors_mm).sum() == len(load_canonical("low")[0].face_interior)


@pytest.mark.slow
def test_people_that_were_not_trained_on_are_the_default(monkeypatch):
    monkeypatch.delenv("SOMA_TEST_DATA", raising=False)
    report = shape_space.run(configured(options={"anny": {"local_changes": "all"}}))
    (row,) = report.tables[0].rows
    assert row[:3] == ["soma", "2 anny people", 128.0]
    (figure,) = report.figures
    assert figure.passed
    assert figure.bound == 1.0
    assert row[4] < row[3] < row[5] < row[6]


@pytest.mark.parametrize(
    ("vertices", "text"),
    [
        (np.ones((7, 3)), r"odd.obj: got 7 vertices, expected those of a known topology: .*18056 \(soma\)"),
        (np.linspace(0, 2e8, 18056 * 3).reshape(-1, 3), r"odd.obj: got a body 1.99993e\+08 long, expected"),
        (np.zeros((18056, 3)), r"odd.obj: got a body 0 long"),
    ],
)
def test_meshes_that_cannot_be_are_named(tmp_path, vertices, text):
    write_obj(tmp_path / "odd.obj", vertices, np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match=text):
        shape_space.run(configured(data=str(tmp_path)))


def test_a_folder_without_meshes_is_named(tmp_path):
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match=r"experiment.data: got .*, without a mesh, expected a folder"):
            shape_space.run(configured(data=str(folder)))
