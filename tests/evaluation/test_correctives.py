"""The experiment on correctives: what its figures say of models whose answer is known."""

import dataclasses

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.correctives.elastic import ElasticSurface
from soma_core.correctives.model import Correctives
from soma_core.errors import AssetError
from soma_core.evaluation import correctives
from soma_core.topology.lod_transfer import offset_rows
from tests.correctives.conftest import made_body
from tests.correctives.test_weights import made_weights


@pytest.fixture(scope="module")
def weights():
    return dataclasses.replace(made_weights(made_body()), meta={"settings": {"reach": 1.5}})


@pytest.fixture(scope="module")
def subject(weights):
    body = made_body()
    model = Correctives(weights, body.rig, offset_rows(body.mesh), dtype=torch.float64, device="cpu")
    surface = ElasticSurface(body.mesh, body.rig)
    return correctives._Subject(mesh=body.mesh, rig=body.rig, surface=surface, model=model)


def test_no_offsets_leave_the_whole_error(subject, weights):
    none = dataclasses.replace(weights, second=0 * weights.second)
    model = Correctives(none, subject.rig, offset_rows(subject.mesh), dtype=torch.float64, device="cpu")
    motion = correctives._unseen(subject.rig, 3, [])["random poses"]
    before, after, worst = correctives._errors(dataclasses.replace(subject, model=model), motion)
    assert before == pytest.approx(after)
    assert worst > before > 1  # only vertices that move by more than a millimetre count


def test_what_holds_by_construction_is_found_to_hold(subject, weights):
    figures = correctives._exact_figures(subject, weights)
    assert [figure.passed for figure in figures] == [True, True]
    wide = dataclasses.replace(weights, meta={"settings": {"reach": 0.5}})
    assert not correctives._exact_figures(subject, wide)[1].passed


def test_the_sparse_product_is_the_dense_one(subject, weights):
    figures = {figure.name: figure for figure in correctives._cost_figures(weights, subject)}
    assert figures["dense product and ours apart"].passed


def test_sections_are_those_of_bent_joints(subject):
    figures = correctives._section_figures(subject)
    taught = [figure.value for figure in figures if figure.name.endswith("by the teacher")]
    assert len(taught) == 2
    np.testing.assert_allclose(taught, 100, atol=6)  # a bend of 120 degrees of a coarse tube


def test_joints_that_skinning_alone_bends_turn_no_farther_and_have_no_balloons(subject, weights):
    none = dataclasses.replace(weights, second=0 * weights.second)
    model = Correctives(none, subject.rig, offset_rows(subject.mesh), dtype=torch.float64, device="cpu")
    rows = correctives._shape_rows(dataclasses.replace(subject, model=model))
    assert {row[0] for row in rows} == {"elbow", "knee", "hip", "shoulder"}
    assert all(row[2] == row[3] for row in rows)
    assert all((row[4] is None) == (row[0] in ("hip", "shoulder")) for row in rows)
    turned, farther, ring = correctives._shape_figures(rows, bones=True)
    assert turned.passed
    assert farther.value < 0.5  # millimetres; skinning pulls skin towards the joint
    rows[0][3], rows[0][4], rows[1][5] = rows[0][2] + 1, 13.7, 2 * ring.bound
    assert not any(figure.passed for figure in correctives._shape_figures(rows, bones=True))


def test_pictures_show_the_offsets(subject):
    pose = torch.as_tensor(correctives._unseen(subject.rig, 1, [])["random poses"])
    rest, posed = correctives._pictured(subject, subject.surface.body.identity, "body", pose)
    assert (rest.caption, posed.caption) == ("body\nat rest", "body\nposed")
    np.testing.assert_array_equal(rest.errors_mm, posed.errors_mm)
    assert rest.errors_mm.max() > 0


def test_assets_without_correctives_are_named(monkeypatch, tmp_path):
    monkeypatch.setenv("SOMA_ASSETS", str(tmp_path))
    config = OmegaConf.create({"experiment": {"checkpoint": None, "motions": [], "count": 1}})
    with pytest.raises(AssetError, match=r"holds no correctives\. Run: soma train-correctives"):
        correctives.run(config)
