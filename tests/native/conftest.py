"""A data folder with a stand-in for SMPL-X, converted and wrapped as a user's would be."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from soma_backend_smpl import smplx

from soma_core import SomaLayer, read_motion
from soma_core.native import NativeFit
from soma_core.paths import assets_dir
from tests.standins.smpl_files import smpl_arrays, write_npz, write_smpl_wrap

FRAMES = (0, 90, 170, 260)
BETAS = (0.8, -0.5, 0.4, 0.3)


@pytest.fixture(scope="session")
def _smplx(tmp_path_factory) -> tuple[SomaLayer, NativeFit, Path]:
    """Both ways of the stand-in, and its data folder, which is looked at while they are built."""
    root: Path = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOMA_DATA_DIR", str(root))
        official = write_npz(root / "official" / "SMPLX_NEUTRAL.npz", smpl_arrays("smplx", width=20))
        smplx.soma_convert(official, None)
        write_smpl_wrap(root, "smplx")
        return SomaLayer("smplx"), NativeFit("smplx"), root


@pytest.fixture(scope="session")
def layer(_smplx):
    """SMPL-X on the canonical mesh."""
    return _smplx[0]


@pytest.fixture(scope="session")
def fit(_smplx):
    """The way back to SMPL-X."""
    return _smplx[1]


@pytest.fixture
def data(_smplx, monkeypatch):
    """The data folder, for building once more."""
    monkeypatch.setenv("SOMA_DATA_DIR", str(_smplx[2]))


@pytest.fixture(scope="session")
def body(layer):
    """One body of it."""
    return layer.identity({"betas": torch.tensor([BETAS])})


@pytest.fixture(scope="session")
def vertices(layer, body):
    """Canonical vertices of four frames of the shipped motion, hands and fingers included."""
    motion = read_motion(assets_dir() / "motions" / "range_of_motion.npz")
    rotations, translation = (
        torch.as_tensor(one[list(FRAMES)]) for one in (motion.rotations, motion.translation)
    )
    with torch.no_grad():
        return layer.pose(body, rotations, translation).vertices


@pytest.fixture(scope="session")
def motion(fit, vertices):
    """The four frames in parameters of SMPL-X, the body known."""
    return fit(vertices, params={"betas": torch.tensor([BETAS])})
