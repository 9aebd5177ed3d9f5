"""What every backend must hold, on stand-ins for both files; and how a user's files are found."""

from __future__ import annotations

import shutil

import pytest
import torch
from soma_backend_mhr._files import LOD1, LOD6

from soma_core import InputError
from soma_core.plugin import BrokenBackendError, Registry
from soma_core.testing import check_backend

CPU = torch.device("cpu")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mhr", "mhr_lod6"])
def test_conformance(data_folder, name):
    report = check_backend(name, registry=Registry(), options={"trust": True})
    assert not report.missing_files
    assert not report.failed, report.text()


def test_a_user_without_the_file_is_told_where_it_goes(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    with pytest.raises(
        BrokenBackendError, match="the MHR model of LOD 1 is missing at .*MHR.mhr_model_lod1.pt"
    ) as error:
        Registry().generator("mhr", device=CPU, dtype=torch.float32)
    assert "Get it from https://github.com/facebookresearch/MHR" in error.value.fix


def test_a_user_without_a_wrap_is_told_how_to_make_it(data_folder, tmp_path, monkeypatch):
    (tmp_path / "MHR").mkdir()
    shutil.copy(data_folder / "MHR" / "mhr_model_lod6.pt", tmp_path / "MHR")
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    with pytest.raises(BrokenBackendError, match="its neutral mesh as OBJ is missing") as error:
        Registry().generator("mhr_lod6", device=CPU, dtype=torch.float32)
    assert f"Run: soma wrap backend=mhr_lod6 out={tmp_path / 'MHR' / 'lod6'}" in error.value.fix


def test_files_are_found_by_any_of_their_names(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    folder = tmp_path / "mhr"
    folder.mkdir()
    assert LOD1.model() == folder / "mhr_model_lod1.pt"
    (folder / "MHR_model.pt").touch()
    assert LOD1.model() == folder / "MHR_model.pt"
    for name in ("mhr_neutral.obj", "SOMA_wrap.obj", "base_body_lod1.obj", "base_body_lod6.obj"):
        (folder / name).touch()
    assert LOD1.pair().wrap == folder / "SOMA_wrap.obj"
    assert LOD6.pair().wrap == folder / "lod6" / "SOMA_wrap.obj"
    (folder / "SOMA_wrap_lod1.obj").touch()
    assert LOD1.pair().native == folder / "base_body_lod1.obj"
    assert LOD6.pair().wrap == folder / "SOMA_wrap_lod1.obj"


def test_trust_must_be_said_in_so_many_words(data_folder):
    with pytest.raises(InputError, match="backend.options.trust: got 'yes'"):
        Registry().generator("mhr", device=CPU, dtype=torch.float32, options={"trust": "yes"})
    with pytest.raises(BrokenBackendError, match="mhr_model_lod1.pt: is not the published file"):
        Registry().generator("mhr", device=CPU, dtype=torch.float32)
