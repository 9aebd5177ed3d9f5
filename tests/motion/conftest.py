"""A stand-in of SMPL-H as a user has it, and a motion for it as AMASS stores them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

AMASS_FRAMES = 6


@pytest.fixture(scope="session")
def smplh_supplied(tmp_path_factory) -> Path:
    """A data folder with a converted model and its wrap pair; a female one only."""
    smplh = pytest.importorskip("soma_backend_smpl.smplh")
    from tests.standins.smpl_files import smpl_arrays, write_npz, write_smpl_wrap

    root = tmp_path_factory.mktemp("smplh")
    official = write_npz(root / "official/SMPLH_FEMALE.npz", smpl_arrays("smplh", width=3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOMA_DATA_DIR", str(root))
        smplh.soma_convert(official, None)
    write_smpl_wrap(root, "smplh")
    return root


@pytest.fixture
def smplh_models(smplh_supplied, monkeypatch) -> Path:
    """SOMA_DATA_DIR with that model; the correspondence is built once for all tests."""
    monkeypatch.setenv("SOMA_DATA_DIR", str(smplh_supplied))
    monkeypatch.setenv("SOMA_CACHE_DIR", str(smplh_supplied / "cache"))
    return smplh_supplied


@pytest.fixture(scope="session")
def amass() -> dict[str, object]:
    """Keys of a file: a person who bends and walks while turning, in a world that has +z up."""
    random = np.random.default_rng(0)
    phase, amplitude = 2 * np.pi * random.random((52, 3)), 0.15 * random.standard_normal((52, 3))
    time = np.linspace(0, 1, AMASS_FRAMES)[:, None, None]
    poses = amplitude * np.sin(2 * np.pi * time + phase)
    upright = Rotation.from_euler("x", 90, degrees=True)
    poses[:, 0] = (Rotation.from_euler("z", 60 * time[:, :, 0], degrees=True) * upright).as_rotvec()
    return {
        "poses": poses.reshape(AMASS_FRAMES, -1), "trans": np.array([1.0, 2.0, 0.9]) + 0.1 * time[:, :, 0],
        "betas": np.array([0.5, -1.0, 0, 0, 0]), "gender": "female", "mocap_framerate": 60.0,
        "dmpls": np.zeros((AMASS_FRAMES, 8)),
    }  # fmt: skip


@pytest.fixture
def amass_file(amass, tmp_path) -> Path:
    """The file."""
    np.savez(tmp_path / "walk_poses.npz", **amass)
    return tmp_path / "walk_poses.npz"
