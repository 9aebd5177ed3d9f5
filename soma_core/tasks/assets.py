"""Check the shipped assets (`soma assets verify`)."""

from __future__ import annotations

from pathlib import Path

from soma_core.errors import AssetError
from soma_core.paths import assets_dir
from soma_core.rig.manifest import (
    CORRECTIVES_NAME,
    MANIFEST_NAME,
    NEUTRAL_NAME,
    PROCEDURAL_NAME,
    RESTORE,
    RIG_NAME,
    check_files,
    read_manifest,
)

__all__ = ["verify_assets"]

_MAKERS = "make"  # in a checkout, the scripts that make the assets lie among them


def _unlisted(root: Path, listed: set[str]) -> list[str]:
    """Files of the folder that the manifest does not know."""
    present = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    present = {name for name in present if name.partition("/")[0] != _MAKERS}
    hidden = {name for name in present if name.rpartition("/")[2].startswith(".")}
    return [
        f"{root / name}: not in {MANIFEST_NAME}. Remove it"
        for name in sorted(present - hidden - listed - {MANIFEST_NAME})
    ]


def _contents(root: Path) -> list[str]:
    """Open what the hashes cannot vouch for when the manifest itself is wrong: keys, rig, shapes."""
    from soma_core.rig.canonical import load_canonical
    from soma_core.rig.neutral import load_shape_space

    findings = []
    for check in (
        lambda: load_canonical("mid", root),
        lambda: load_canonical("low", root),
        lambda: load_canonical("xlo", root),
        lambda: load_shape_space(root / NEUTRAL_NAME),
        lambda: _correctives(root),
    ):
        try:
            check()
        except AssetError as error:
            findings.append(str(error))
    return findings


def _correctives(root: Path) -> None:
    """Open the correctives, where there are any, and compare them with the rig."""
    from soma_core.correctives.weights import check_bind_pose, read_weights
    from soma_core.rig.canonical import load_canonical

    path = root / CORRECTIVES_NAME
    if path.is_file():
        check_bind_pose(path, read_weights(path), load_canonical("mid", root)[1])


def verify_assets(root: Path | None = None) -> list[str]:
    """Check every asset against the manifest, then that the files open and belong together.

    Args:
        root: assets folder; default: the shipped one.

    Returns:
        The names of the files that were checked.

    Raises:
        AssetError: one that lists every finding, each with what to do.
    """
    root = assets_dir() if root is None else Path(root)
    manifest = read_manifest(root)
    findings = check_files(root, manifest)
    findings += [
        f"{root / MANIFEST_NAME}: does not list {name}. {RESTORE}"
        for name in (RIG_NAME, NEUTRAL_NAME, PROCEDURAL_NAME)
        if name not in manifest.files
    ]
    findings += _unlisted(root, set(manifest.files))
    findings = findings or _contents(root)
    if findings:
        cause = f"{len(findings)} finding{'s' if len(findings) > 1 else ''}\n  " + "\n  ".join(findings)
        raise AssetError(root, cause=cause, fix="Restore the files above")
    return sorted(manifest.files)
