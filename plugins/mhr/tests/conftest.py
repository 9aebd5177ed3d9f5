"""A data folder with stand-ins for both files, and their wraps, as a user's would be."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.standins.mhr_files import StandIn, mhr_body, write_mhr_pair, write_model


@pytest.fixture(scope="session")
def supplied(tmp_path_factory) -> Path:
    """The data folder."""
    root = tmp_path_factory.mktemp("data")
    for lod, folder in ((1, root / "MHR"), (6, root / "MHR" / "lod6")):
        write_model(root / "MHR" / f"mhr_model_lod{lod}.pt", StandIn(mhr_body(lod)))
        write_mhr_pair(folder, lod)
    return root


@pytest.fixture
def data_folder(supplied, monkeypatch) -> Path:
    """SOMA_DATA_DIR with the files; what is derived of them is made once for all tests."""
    monkeypatch.setenv("SOMA_DATA_DIR", str(supplied))
    monkeypatch.setenv("SOMA_CACHE_DIR", str(supplied.parent / "derived"))
    return supplied
