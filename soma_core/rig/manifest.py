"""The list of shipped assets, and the checks that a file on disk is the one that was shipped."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soma_core.cache import atomic_text, file_sha256
from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable
from soma_core.json_file import read_json
from soma_core.paths import assets_dir, shipped_assets

__all__ = [
    "CORRECTIVES_NAME",
    "MANIFEST_NAME",
    "NEUTRAL_NAME",
    "PROCEDURAL_NAME",
    "RESTORE",
    "RIG_NAME",
    "Manifest",
    "check_files",
    "read_manifest",
    "shipped_file",
    "verified_sha256",
    "write_manifest",
]

MANIFEST_NAME = "MANIFEST.json"
RIG_NAME = "SOMA_template_rig.usda"
NEUTRAL_NAME = "SOMA_neutral.npz"
CORRECTIVES_NAME = "correctives_model.pt"
PROCEDURAL_NAME = "SOMA_procedural_transforms.json"
_OWN = (RIG_NAME, NEUTRAL_NAME, CORRECTIVES_NAME, PROCEDURAL_NAME)
"""What belongs to one rig, and is never taken from another folder."""

_SCHEMA = 1
RESTORE = "Restore it with `git checkout -- assets`, or install soma-body-core again"


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What the assets folder must hold.

    Attributes:
        rig_hash: 64 hex digits of the mid rig; `rig_revision` is its first 16. Empty where the files of
            another folder were found rather than listed: their rig names itself when it is read.
        files: name -> sha256, size, licence, origin, unit, counts; of files that were found the size alone.
        listed: whether the folder has a manifest, which its files must match.
    """

    rig_hash: str
    rig_revision: str
    files: Mapping[str, Mapping[str, Any]]
    listed: bool = True


def read_manifest(root: Path) -> Manifest:
    """Read ``MANIFEST.json`` of an assets folder; without one, a folder of the user's is what is found in it.

    Raises:
        AssetError: missing in the shipped folder, not JSON, of another schema, or without a required key; or
            a folder without ``SOMA_neutral.npz``.
    """
    path = root / MANIFEST_NAME
    if not path.exists() and root.resolve() != shipped_assets().resolve():
        return _found(root)
    content = read_json(path, fix=RESTORE)
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != _SCHEMA:
        raise AssetError(path, cause=f"manifest schema is {schema}, expected {_SCHEMA}", fix=RESTORE)
    missing = [key for key in ("rig_hash", "rig_revision", "files") if key not in content]
    if missing:
        raise AssetError(path, cause=f"missing keys {missing}", fix=RESTORE)
    if not isinstance(content["files"], dict):
        raise AssetError(path, cause="files are no list of names", fix=RESTORE)
    return Manifest(
        rig_hash=content["rig_hash"], rig_revision=content["rig_revision"], files=content["files"]
    )


def _found(root: Path) -> Manifest:
    """The assets in a folder that has no manifest, such as the published ones."""
    files = {name: {"size": (root / name).stat().st_size} for name in _OWN if (root / name).is_file()}
    if NEUTRAL_NAME not in files:
        cause = f"holds no {NEUTRAL_NAME}" if root.is_dir() else "is no folder"
        fix = "Name the folder of SOMA's assets in SOMA_ASSETS, or go back: `soma assets use shipped`"
        raise AssetError(root, cause=cause, fix=fix)
    return Manifest(rig_hash="", rig_revision="", files=files, listed=False)


def write_manifest(root: Path, manifest: Manifest) -> None:
    """Write ``MANIFEST.json``: sorted keys, one line a value, atomic."""
    content = {
        "schema": _SCHEMA,
        "rig_hash": manifest.rig_hash,
        "rig_revision": manifest.rig_revision,
        "files": {name: dict(entry) for name, entry in manifest.files.items()},
    }
    text = json.dumps(content, indent=2, sort_keys=True) + "\n"
    atomic_text(root / MANIFEST_NAME, text)


def shipped_file(name: str, *, fix: str = RESTORE, root: Path | None = None) -> Path:
    """Path of an asset, which is the one that was shipped where a manifest lists it.

    What a folder of the user's lacks and is of no rig, such as a clip, comes from the shipped one.

    Raises:
        AssetError: it is listed and was changed, or the manifest itself is damaged.
    """
    root = assets_dir() if root is None else root
    path = root / name
    if not path.is_file() and not (root / MANIFEST_NAME).is_file() and name not in _OWN:
        root = shipped_assets()
        path = root / name
    if path.is_file() and (root / MANIFEST_NAME).is_file():
        manifest = read_manifest(root)
        if name in manifest.files:
            verified_sha256(root, manifest, name, fix=fix)
    return path


def verified_sha256(root: Path, manifest: Manifest, name: str, *, fix: str = RESTORE) -> str:
    """Check one asset against the manifest and return its SHA-256.

    Raises:
        AssetError: not listed, missing, a git-LFS pointer, of another size, or of another hash.
    """
    path = root / name
    if not manifest.listed:
        refuse_unreadable(path, fix=f"Complete the folder; `soma assets show {root}` lists what is missing")
        return file_sha256(path)
    if name not in manifest.files:
        raise AssetError(root / MANIFEST_NAME, cause=f"does not list {name}", fix=fix)
    refuse_unreadable(path, fix=fix)
    expected = manifest.files[name]
    if not isinstance(expected, dict) or not {"size", "sha256"} <= {*expected}:
        raise AssetError(root / MANIFEST_NAME, cause=f"{name} is without size or sha256", fix=fix)
    size = path.stat().st_size
    if size != expected["size"]:
        state = "truncated" if size < expected["size"] else "not the shipped one"
        cause = f"file is {state}: {size} bytes, expected {expected['size']}"
        raise AssetError(path, cause=cause, fix=fix)
    got = file_sha256(path)
    if got != expected["sha256"]:
        cause = f"SHA-256 is {got[:16]}..., expected {expected['sha256'][:16]}..."
        raise AssetError(path, cause=cause, fix=fix)
    return got


def check_files(root: Path, manifest: Manifest) -> list[str]:
    """Return one finding for every listed file that fails `verified_sha256`; empty when all pass."""
    findings = []
    for name in manifest.files:
        try:
            verified_sha256(root, manifest, name)
        except AssetError as error:
            findings.append(str(error))
    return findings
