"""A data folder with stand-ins for the three models, converted and wrapped as a user's would be."""

from __future__ import annotations

from pathlib import Path

import pytest
from soma_backend_smpl import smpl, smplh, smplx

from tests.standins.smpl_files import smpl_arrays, write_npz, write_smpl_pickle, write_smpl_wrap


@pytest.fixture(scope="session")
def official(tmp_path_factory) -> Path:
    """Files as their makers hand them out."""
    folder = tmp_path_factory.mktemp("official")
    wide = smpl_arrays("smpl", width=24)
    write_smpl_pickle(folder / "basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl", wide, chumpy=False)
    write_smpl_pickle(folder / "basicModel_m_lbs_10_207_0_v1.0.0.pkl", smpl_arrays("smpl", width=10))
    for gender in ("male", "neutral"):
        write_npz(folder / "smplh" / gender / "model.npz", smpl_arrays("smplh", width=16))
    write_npz(folder / "SMPLX_NEUTRAL.npz", smpl_arrays("smplx", width=20))
    return folder


@pytest.fixture(scope="session")
def supplied(official, tmp_path_factory) -> Path:
    """The converted models and their wraps."""
    root = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOMA_DATA_DIR", str(root))
        for name in ("basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl", "basicModel_m_lbs_10_207_0_v1.0.0.pkl"):
            smpl.soma_convert(official / name, None)
        for gender in ("male", "neutral"):
            smplh.soma_convert(official / "smplh" / gender / "model.npz", None)
        smplx.soma_convert(official / "SMPLX_NEUTRAL.npz", None)
    write_smpl_wrap(root, "smpl")
    write_smpl_wrap(root, "smplx")
    return root


@pytest.fixture
def data_folder(supplied, monkeypatch) -> Path:
    """SOMA_DATA_DIR with the models; what is derived of them is made once for all tests."""
    monkeypatch.setenv("SOMA_DATA_DIR", str(supplied))
    monkeypatch.setenv("SOMA_CACHE_DIR", str(supplied.parent / "derived"))
    return supplied
