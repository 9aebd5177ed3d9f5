import json

import pytest

from soma_core.errors import AssetError
from soma_core.rig.manifest import MANIFEST_NAME, Manifest, read_manifest, verified_sha256, write_manifest


def test_manifest_round_trips(tmp_path):
    manifest = Manifest(rig_hash="a" * 64, rig_revision="a" * 16, files={"x": {"size": 1}})
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "schema is None"),
        ('{"schema": 7}', "schema is 7, expected 1"),
        ('{"schema": 1, "files": {}}', r"missing keys \['rig_hash', 'rig_revision'\]"),
    ],
)
def test_bad_manifests_are_refused(tmp_path, text, message):
    (tmp_path / MANIFEST_NAME).write_text(text)
    with pytest.raises(AssetError, match=message):
        read_manifest(tmp_path)


def test_missing_manifest_names_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr("soma_core.rig.manifest.shipped_assets", lambda: tmp_path)
    with pytest.raises(AssetError, match="git checkout -- assets"):
        read_manifest(tmp_path)


def test_unlisted_asset_is_refused(tmp_path):
    (tmp_path / MANIFEST_NAME).write_text(
        json.dumps({"schema": 1, "rig_hash": "", "rig_revision": "", "files": {}})
    )
    with pytest.raises(AssetError, match=r"does not list extra\.npz"):
        verified_sha256(tmp_path, read_manifest(tmp_path), "extra.npz")
