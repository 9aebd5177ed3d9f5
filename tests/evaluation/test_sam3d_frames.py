"""Frames of SAM 3D Body: on a stand-in the report and its refusals, on the published ones the bound."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.errors import AssetError, InputError
from soma_core.evaluation import sam3d_frames
from soma_core.evaluation.sam3d_frames import Wrap
from soma_core.rig import load_canonical
from soma_core.topology.correspondence import build_correspondence
from tests.real_mhr import NEUTRAL, needs_mhr, registered_mhr
from tests.standins.body import surface_wrap
from tests.standins.mhr_files import StandIn, mhr_body

BOUND_MM = 1.0
OWN_MM = 3.0
"""A body of this project's own shape space, skinned alike: what one frame and low LOD leave."""


def configured(data: Path | None) -> object:
    experiment = {"name": "sam3d_frames", "backend": "soma", "data": str(data) if data else None}
    return OmegaConf.create({"experiment": experiment, "seed": 0, "device": "cpu"})


@pytest.fixture
def low(monkeypatch):
    """The experiment on the low LOD."""
    monkeypatch.setattr(sam3d_frames, "_LOD", "low")


def test_the_data_must_be_named_and_there(tmp_path, monkeypatch):
    monkeypatch.delenv("SOMA_TEST_DATA", raising=False)
    with pytest.raises(
        InputError, match=r"experiment.data: got none, expected a folder with mhr/mhr_neutral_lod1"
    ):
        sam3d_frames.run(configured(None))
    with pytest.raises(AssetError, match=r"mhr_neutral_lod1.ply: file is missing. Name a folder"):
        sam3d_frames.run(configured(tmp_path))
    (tmp_path / "mhr").mkdir()
    (tmp_path / sam3d_frames.NEUTRAL).write_bytes(b"ply")
    monkeypatch.setenv("SOMA_TEST_DATA", str(tmp_path))
    with pytest.raises(AssetError, match=r"mhr: holds no sam3d_\*.npz"):
        sam3d_frames.run(configured(None))


@pytest.fixture
def person(tmp_path) -> Path:
    """A folder with one person, posed by a stand-in for MHR."""
    folder = tmp_path / "mhr"
    folder.mkdir()
    (tmp_path / sam3d_frames.NEUTRAL).write_bytes(b"ply")
    random = torch.Generator().manual_seed(0)
    parameters = torch.zeros(1, 204)
    parameters[:, 6:130] = 0.15 * torch.randn(1, 124, generator=random)
    identity = 0.5 * torch.randn(1, 45, generator=random)
    with torch.no_grad():
        vertices = StandIn(mhr_body(1))(identity, parameters, torch.zeros(1, 72))[0][0].numpy() / 100
    np.savez(folder / "sam3d_one.npz", pred_vertices=(vertices * [1, -1, -1]).astype(np.float32))
    return tmp_path


@pytest.mark.slow
def test_a_person_is_found_and_shown(person, monkeypatch, low):
    body = mhr_body(1)
    wrap = Wrap(
        correspondence=build_correspondence(100 * body.vertices, body.faces, 100 * surface_wrap(body)),
        distance_mm=0.0, flipped_percent=0.0, seconds=0.0,
    )  # fmt: skip
    monkeypatch.setattr(sam3d_frames, "make_wrap", lambda neutral: wrap)
    report = sam3d_frames.run(configured(person))
    values = {figure.name: figure for figure in report.figures}
    assert values["plain, sam3d_one, mean"].value < OWN_MM
    assert values["default, sam3d_one, mean"].bound == BOUND_MM
    assert values["default, sam3d_one, hands, more than before it"].bound == 0
    assert all(figure.bound is None for name, figure in values.items() if name.startswith("plain"))
    (table,) = report.tables
    regions = ["all", "body", "hands", "feet", "head"]
    assert [row[:2] for row in table.rows] == [
        (region, layer) for layer in ("default", "plain") for region in regions
    ]
    target, fitted = report.bodies
    mesh = load_canonical("low")[0]
    assert target.vertices.shape == fitted.vertices.shape == mesh.vertices.shape
    assert np.isnan(target.errors_mm).all()
    assert np.flatnonzero(np.isnan(fitted.errors_mm)).tolist() == sorted(mesh.face_interior)
    assert fitted.caption.startswith("fitted\nmean")


@pytest.mark.slow
@needs_mhr
def test_the_published_frames(low, monkeypatch):
    monkeypatch.setattr(sam3d_frames, "register", lambda *_: registered_mhr())
    report = sam3d_frames.run(configured(NEUTRAL.parents[1]))
    assert len(report.tables) == 2
    assert not report.failed, report.as_markdown()
