import shutil
from dataclasses import replace

import numpy as np
import pytest

from soma_core.cache import file_sha256
from soma_core.errors import AssetError
from soma_core.paths import assets_dir
from soma_core.rig.manifest import (
    NEUTRAL_NAME,
    PROCEDURAL_NAME,
    RIG_NAME,
    read_manifest,
    write_manifest,
)
from soma_core.tasks.assets import verify_assets

_NEEDED = (RIG_NAME, NEUTRAL_NAME, PROCEDURAL_NAME)


@pytest.fixture
def copied(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))
    root = tmp_path / "assets"
    root.mkdir()
    for name in _NEEDED:
        shutil.copy(assets_dir() / name, root / name)
    shipped = read_manifest(assets_dir())
    files = {name: shipped.files[name] for name in _NEEDED}
    write_manifest(root, replace(shipped, files=files))
    return root


def relist(root, name):
    """Make the manifest agree with a changed file, so that only its contents can give it away."""
    manifest = read_manifest(root)
    files = {key: dict(entry) for key, entry in manifest.files.items()}
    files[name] |= {"sha256": file_sha256(root / name), "size": (root / name).stat().st_size}
    write_manifest(root, replace(manifest, files=files))


def test_shipped_assets_pass():
    assert set(_NEEDED) <= set(verify_assets())


def test_every_finding_is_listed(copied):
    (copied / RIG_NAME).write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    (copied / NEUTRAL_NAME).unlink()
    (copied / "stray.txt").write_text("x")
    with pytest.raises(AssetError, match=r"3 findings") as caught:
        verify_assets(copied)
    for text in ("git lfs pull", "SOMA_neutral.npz: file is missing", "stray.txt: not in MANIFEST.json"):
        assert text in str(caught.value)


@pytest.mark.slow
def test_a_missing_key_is_found_behind_a_right_hash(copied):
    with np.load(copied / NEUTRAL_NAME) as file:
        kept = {name: file[name] for name in file.files if name not in ("triangles_low", "mean")}
    np.savez_compressed(copied / NEUTRAL_NAME, **kept)
    relist(copied, NEUTRAL_NAME)
    with pytest.raises(AssetError, match=r"(?s)missing keys \['triangles_low'\].*missing keys \['mean'\]"):
        verify_assets(copied)


def test_another_rig_is_found_behind_a_right_hash(copied):
    text = (copied / RIG_NAME).read_text()
    (copied / RIG_NAME).write_text(text.replace("metersPerUnit = 0.01", "metersPerUnit = 0.02"))
    relist(copied, RIG_NAME)
    with pytest.raises(AssetError, match="rig revision is"):
        verify_assets(copied)


def test_an_incomplete_manifest_is_found(copied):
    manifest = read_manifest(copied)
    files = {name: entry for name, entry in manifest.files.items() if name != RIG_NAME}
    write_manifest(copied, replace(manifest, files=files))
    with pytest.raises(AssetError, match=r"does not list SOMA_template_rig\.usda"):
        verify_assets(copied)
