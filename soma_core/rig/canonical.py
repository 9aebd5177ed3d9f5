"""Load the canonical mesh and rig, from the shipped files or from the cache of what they hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np
import scipy.sparse
from scipy.spatial import cKDTree

from soma_core.cache import cached_arrays, content_key
from soma_core.errors import AssetError, InputError
from soma_core.geometry.mesh import split_polygons
from soma_core.paths import assets_dir, shipped_assets
from soma_core.rig.manifest import (
    NEUTRAL_NAME,
    PROCEDURAL_NAME,
    RESTORE,
    RIG_NAME,
    Manifest,
    read_manifest,
    verified_sha256,
)
from soma_core.rig.mesh import CanonicalMesh, Lod
from soma_core.rig.neutral import SEGMENT_NAMES, read_stored_rig, read_topology
from soma_core.rig.procedural import ProceduralDefinition, ProceduralRig
from soma_core.rig.procedural_json import read_procedural
from soma_core.rig.revision import lod_revision
from soma_core.rig.skeleton import Rig

if TYPE_CHECKING:
    from soma_core.rig.usd import UsdRig

__all__ = ["load_canonical"]

_LAYOUT = 3  # raise when the cached arrays change meaning
_SEGMENT = "segment_"
_NO_TEXTURE = (np.empty((0, 2), np.float32), np.empty(0, np.int32))


def _low_topology(topology: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Restrict topology and segments to the low LOD, in its own ids."""
    mid_ids = topology["lod_mid_to_low"]
    to_low = np.full(len(topology["mirror_vert_indices"]), -1, np.int32)
    to_low[mid_ids] = np.arange(len(mid_ids), dtype=np.int32)
    low = {
        "mid_ids": mid_ids,
        "triangles": topology["triangles_low"],
        "mirror": to_low[topology["mirror_vert_indices"][mid_ids]],
    }
    for name in SEGMENT_NAMES:
        ids = to_low[topology[_SEGMENT + name]]
        low[_SEGMENT + name] = ids[ids >= 0]
    return low


def _mid_topology(topology: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    mirror = topology["mirror_vert_indices"]
    mid = {"mid_ids": np.arange(len(mirror), dtype=np.int32), "mirror": mirror}
    mid["triangles"] = topology["triangles"]
    return mid | {_SEGMENT + name: topology[_SEGMENT + name] for name in SEGMENT_NAMES}


def _xlo_topology(
    vertices: np.ndarray, indices: np.ndarray, counts: np.ndarray, low: CanonicalMesh
) -> dict[str, np.ndarray]:
    """Topology and segments of the extra-low LOD, which has no bags in the face.

    A vertex belongs to the segments of the low vertex that is nearest to it.
    """
    outside = np.setdiff1d(np.arange(low.vertex_count), low.face_interior)
    nearest = outside[cKDTree(low.vertices[outside]).query(vertices)[1]]
    xlo = {
        "mid_ids": np.empty(0, np.int32),
        "triangles": split_polygons(indices, counts, vertices),
        "mirror": cKDTree(vertices).query(vertices * [-1, 1, 1])[1].astype(np.int32),
    }
    for name, ids in low.segments.items():
        xlo[_SEGMENT + name] = np.flatnonzero(np.isin(nearest, ids)).astype(np.int32)
    return xlo


def _skin(
    root: Path, lod: Lod, topology: Mapping[str, np.ndarray], definition: ProceduralDefinition | None
) -> UsdRig:
    """The rig of one LOD, from the template, or from the arrays of the first releases."""
    from soma_core.rig.usd import canonical_rig, read_usd_rig  # imports pxr, needed only without a cache

    keep = None if definition is not None else read_procedural(shipped_assets() / PROCEDURAL_NAME).main_joints
    triangles = topology["triangles"]
    if (root / RIG_NAME).is_file():
        found = read_usd_rig(root / RIG_NAME, lod=lod, triangles=triangles, definition=definition, keep=keep)
        only_mid = lod == "low" and len(found.rig.bind_shape) == len(topology["mirror_vert_indices"])
        return _low_of_mid(found, topology) if only_mid else found
    stored = read_stored_rig(root / NEUTRAL_NAME)
    if stored is None:
        cause = f"holds no rig, and there is no {RIG_NAME} beside it"
        raise AssetError(root / NEUTRAL_NAME, cause=cause, fix=f"Put {RIG_NAME} of the same release there")
    if lod == "xlo":
        cause = "is of a release that has no extra-low mesh"
        raise AssetError(root / NEUTRAL_NAME, cause=cause, fix="Use lod=low, or the files of a newer release")
    part = "" if lod == "mid" else "_low"
    polygons = (topology[f"face_vert_indices{part}"], topology[f"face_vert_counts{part}"])
    if lod == "low":
        ids = topology["lod_mid_to_low"]
        stored = replace(stored, bind_shape=stored.bind_shape[ids], weights=stored.weights[ids])
    texture = (topology["uv_coord_st"], topology["uv_indices_st"]) if lod == "mid" else _NO_TEXTURE
    return canonical_rig(root / NEUTRAL_NAME, stored, (*polygons, *texture), triangles, definition, keep)


def _low_of_mid(found: UsdRig, topology: Mapping[str, np.ndarray]) -> UsdRig:
    """The low mesh of a template that holds the mid skin alone: a subset of its vertices."""
    ids, rig = topology["lod_mid_to_low"], found.rig
    helpers = rig.procedural
    if helpers is not None:
        helpers = replace(helpers, weights=helpers.weights[ids])
    return replace(
        found,
        rig=replace(rig, bind_shape=rig.bind_shape[ids], weights=rig.weights[ids], procedural=helpers),
        face_vert_indices=topology["face_vert_indices_low"],
        face_vert_counts=topology["face_vert_counts_low"],
        uv=_NO_TEXTURE[0],
        uv_indices=_NO_TEXTURE[1],
    )


def _parse(
    root: Path, lod: Lod, manifest: Manifest, definition: ProceduralDefinition | None
) -> dict[str, np.ndarray]:
    """Read mesh and rig and flatten what one LOD needs into arrays."""
    instead = None if manifest.listed else shipped_assets() / NEUTRAL_NAME
    topology = read_topology(root / NEUTRAL_NAME, instead=instead)
    found = _skin(root, lod, topology, definition)
    if manifest.listed and lod == "mid" and found.rig_hash != manifest.rig_hash:
        cause = f"rig revision is {found.rig.revision}, the manifest says {manifest.rig_revision}"
        raise AssetError(root / RIG_NAME, cause=cause, fix=RESTORE)
    rig, procedural = found.rig, found.rig.procedural
    _refuse_another_mesh(root, lod, topology, rig)
    if lod == "xlo":
        low = load_canonical("low", root)[0]
        arrays = _xlo_topology(rig.bind_shape, found.face_vert_indices, found.face_vert_counts, low)
    else:
        arrays = _mid_topology(topology) if lod == "mid" else _low_topology(topology)
    return (
        arrays
        | {
            "joint_names": np.array(rig.joint_names),
            "parents": rig.parents,
            "bind_world": rig.bind_world,
            "t_pose_world": rig.t_pose_world,
            "bind_shape": rig.bind_shape,
            "weights_data": rig.weights.data,
            "weights_indices": rig.weights.indices,
            "weights_indptr": rig.weights.indptr,
            "rig_hash": np.array(found.rig_hash),
            "face_vert_indices": found.face_vert_indices,
            "face_vert_counts": found.face_vert_counts,
            "uv": found.uv,
            "uv_indices": found.uv_indices,
        }
        | (
            {}
            if procedural is None
            else {
                "helper_start": procedural.start_joints,
                "helper_bind_world": procedural.bind_world,
                "helper_weights_data": procedural.weights.data,
                "helper_weights_indices": procedural.weights.indices,
                "helper_weights_indptr": procedural.weights.indptr,
            }
        )
    )


def _refuse_another_mesh(root: Path, lod: Lod, topology: Mapping[str, np.ndarray], rig: Rig) -> None:
    """The skin must be the mesh of the topology."""
    counts = {"mid": len(topology["mirror_vert_indices"]), "low": len(topology["lod_mid_to_low"])}
    found = len(rig.bind_shape)
    if lod == "xlo" and found in counts.values():
        cause = "has no extra-low mesh"
        raise AssetError(root / RIG_NAME, cause=cause, fix="Use lod=low, or the files of a newer release")
    if found != counts.get(lod, found):
        cause = f"its {lod} skin has {found} vertices, {NEUTRAL_NAME} has {counts[lod]}"
        raise AssetError(root / RIG_NAME, cause=cause, fix="Use files of one release together")


def load_canonical(lod: Lod = "mid", root: Path | str | None = None) -> tuple[CanonicalMesh, Rig]:
    """Load the canonical mesh and rig in metres, +Y up; every array is read-only.

    The files are checked against the manifest on every call; what they hold is parsed once and
    cached, keyed by their contents. A folder without a manifest, such as the published ones, names its rig
    by its own hash; the rig is that of ``SOMA_template_rig.usda`` or, of the first releases, of
    ``SOMA_neutral.npz``.

    Args:
        lod: "mid" (18,056 vertices), "low" (4,505, an index subset of mid) or "xlo" (612, a mesh of its own).
        root: assets folder; default: the shipped one.

    Raises:
        AssetError: a file is missing, damaged or not the one of the manifest.
        InputError: unknown `lod`.
    """
    if lod not in get_args(Lod):
        raise InputError("lod", got=repr(lod), expected="'mid', 'low' or 'xlo'", fix="Choose one of them.")
    given, root = root, assets_dir() if root is None else Path(root)
    manifest = read_manifest(root)
    names: tuple[str, ...] = (RIG_NAME, NEUTRAL_NAME, PROCEDURAL_NAME)
    # The first releases have no template, and those without twist joints no definition of them.
    names = names if manifest.listed else tuple(name for name in names if name in manifest.files)
    sums = [verified_sha256(root, manifest, name) for name in names]
    definition = read_procedural(root / PROCEDURAL_NAME) if PROCEDURAL_NAME in names else None
    key = content_key(_LAYOUT, lod, manifest.rig_hash, *names, *sums)
    arrays = cached_arrays("canonical", key, lambda: _parse(root, lod, manifest, definition))
    for array in arrays.values():
        array.setflags(write=False)
    revision = manifest.rig_hash or str(arrays["rig_hash"])
    if not manifest.listed and lod != "mid":
        revision = load_canonical("mid", root)[1].revision
    mesh, rig = _assemble(arrays, lod, lod_revision(revision, lod), definition)
    return (mesh if given is None else replace(mesh, root=root)), rig


def _weights(arrays: Mapping[str, np.ndarray], prefix: str, columns: int) -> scipy.sparse.csr_array:
    parts = tuple(arrays[f"{prefix}_{part}"] for part in ("data", "indices", "indptr"))
    return scipy.sparse.csr_array(parts, shape=(len(arrays["bind_shape"]), columns))


def _assemble(
    arrays: Mapping[str, np.ndarray], lod: Lod, revision: str, definition: ProceduralDefinition | None
) -> tuple[CanonicalMesh, Rig]:
    mesh = CanonicalMesh(
        vertices=arrays["bind_shape"],
        triangles=arrays["triangles"],
        face_vert_indices=arrays["face_vert_indices"],
        face_vert_counts=arrays["face_vert_counts"],
        uv=arrays["uv"],
        uv_indices=arrays["uv_indices"],
        segments={name: arrays[_SEGMENT + name] for name in SEGMENT_NAMES},
        mirror=arrays["mirror"],
        mid_ids=arrays["mid_ids"],
        lod=lod,
        revision=revision,
    )
    names = tuple(arrays["joint_names"].tolist())
    procedural = (
        None
        if definition is None
        else ProceduralRig(
            joint_names=definition.helpers,
            start_joints=arrays["helper_start"],
            bind_world=arrays["helper_bind_world"],
            weights=_weights(arrays, "helper_weights", len(names) + len(definition.helpers)),
            definition=definition,
        )
    )
    rig = Rig(
        joint_names=names,
        parents=arrays["parents"],
        bind_world=arrays["bind_world"],
        t_pose_world=arrays["t_pose_world"],
        bind_shape=arrays["bind_shape"],
        weights=_weights(arrays, "weights", len(names)),
        revision=revision,
        procedural=procedural,
    )
    return mesh, rig
