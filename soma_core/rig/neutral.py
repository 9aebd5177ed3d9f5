"""``SOMA_neutral.npz``: topology and semantics of the canonical mesh, and the PCA shape space [cm]."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from soma_core.errors import AssetError, InputError
from soma_core.files import FARTHEST
from soma_core.json_file import parse_json
from soma_core.npz import NpzFile, open_npz_file
from soma_core.paths import assets_dir
from soma_core.rig.manifest import NEUTRAL_NAME, RESTORE, read_manifest, verified_sha256
from soma_core.rig.stored import StoredRig, refuse_bad_weights
from soma_core.stored_matrix import StoredMatrix

__all__ = [
    "SEGMENT_NAMES",
    "TOPOLOGY_KEYS",
    "ShapeSpace",
    "load_shape_space",
    "read_arrays",
    "read_stored_rig",
    "read_topology",
]

SEGMENT_NAMES = (
    "head",
    "feet",
    "torso",
    "mouth_bag",
    "eye_bags",
    "between_toes",
    "hair",
    "haircap",
    "armpits",
)
TOPOLOGY_KEYS = (
    "triangles",
    "triangles_low",
    "lod_mid_to_low",
    "face_vert_indices",
    "face_vert_counts",
    "face_vert_indices_low",
    "face_vert_counts_low",
    "mirror_vert_indices",
    "uv_coord_st",
    "uv_indices_st",
    "uv_interp_st",
    *(f"segment_{name}" for name in SEGMENT_NAMES),
)
_DERIVED = tuple(name for name in TOPOLOGY_KEYS if name.startswith(("mirror", "uv", "segment")))
"""What older files may lack: it follows from the numbers of the vertices, which all revisions share."""
_RIG_KEYS = (
    "joint_names",
    "joint_parent_ids",
    "bind_pose_world",
    "t_pose_world",
    "bind_shape",
    *(f"skinning_weights_{part}" for part in ("data", "indices", "indptr", "shape")),
)
_SHAPE_KEYS = ("mean", "shapedirs", "eigenvalues")

# Values accepted in foreign metadata; a file in metres or Z-up would load silently wrong.
_ACCEPTED = {
    "units": ("cm", "centimeter", "centimeters", "centimetre", "centimetres"),
    "up_axis": ("y", "+y"),
    "forward_axis": ("z", "+z"),
    "handedness": ("right", "right-handed", "right_handed"),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class ShapeSpace:
    """A linear shape space on the canonical mesh: ``v = mean + (c * sqrt(eigenvalues)) @ shapedirs``.

    Attributes:
        mean: (v, 3) float32 [cm].
        shapedirs: (k, 3 v) float32, vertex-major xyz.
        eigenvalues: (k,) float32 [cm^2], not negative.
        metadata: what it was trained on.
    """

    mean: np.ndarray
    shapedirs: np.ndarray
    eigenvalues: np.ndarray
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together."""
        mean, directions, eigenvalues = (np.asarray(getattr(self, key)) for key in _SHAPE_KEYS)
        fits = (
            mean.ndim == 2
            and mean.shape[1] == 3
            and eigenvalues.ndim == 1
            and directions.shape == (len(eigenvalues), mean.size)
        )
        if not fits:
            raise InputError(
                "mean, shapedirs, eigenvalues",
                got=f"shapes {mean.shape}, {directions.shape}, {eigenvalues.shape}",
                expected="shapes (v, 3), (k, 3 v), (k,)",
                fix="Train the space again with `soma train-shape`.",
            )
        finite = all(np.isfinite(array).all() for array in (mean, directions, eigenvalues))
        if not finite or (len(eigenvalues) and eigenvalues.min() < 0):
            raise InputError(
                "mean, shapedirs, eigenvalues",
                got="a negative eigenvalue" if finite else "NaN or infinity",
                expected="finite values and eigenvalues of at least 0",
                fix="Train the space again with `soma train-shape`.",
            )

    @property
    def component_count(self) -> int:
        """Number of components k."""
        return len(self.eigenvalues)


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read the named arrays of an npz, and `metadata` where present; other keys stay unread.

    Raises:
        AssetError: unreadable file or missing keys.
    """
    with open_npz_file(path, fix=RESTORE) as file:
        missing = [name for name in names if name not in file.names]
        if missing:
            raise AssetError(path, cause=f"missing keys {missing}", fix=RESTORE)
        wanted = [*names, *(["metadata"] if "metadata" in file.names else [])]
        found = {}
        for name in wanted:
            try:
                found[name] = file.read(name)
            except ValueError as error:
                raise AssetError(path, cause=f"{name} cannot be read ({error})", fix=RESTORE) from error
    return found


def _read_metadata(path: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Parse the metadata JSON and check unit, axes and handedness where it states them."""
    if "metadata" not in arrays:
        return {}
    try:
        metadata = parse_json(str(arrays["metadata"]))
    except ValueError as error:
        cause = f"metadata is not JSON ({error})"
        raise AssetError(path, cause=cause, fix="Write it again with the tool that made it") from error
    if not isinstance(metadata, dict):
        cause = f"metadata is {type(metadata).__name__}, not a JSON object"
        raise AssetError(path, cause=cause, fix="Write it again with the tool that made it")
    for key, accepted in _ACCEPTED.items():
        value = metadata.get(key, accepted[0])
        if str(value).lower() not in accepted:
            cause = f"metadata says {key} = {value}, expected one of {', '.join(accepted)}"
            raise AssetError(path, cause=cause, fix="Convert the file to centimetres, +Y up, +Z forward")
    return metadata


def read_topology(path: Path, *, instead: Path | None = None) -> dict[str, np.ndarray]:
    """Read every array of `TOPOLOGY_KEYS`; extra keys (also those of old files) are ignored.

    Args:
        path: the file.
        instead: a file of the same mesh, for mirror ids, texture coordinates and segments that are missing.

    Raises:
        AssetError: unreadable file, missing keys, ids that are no vertices, or another unit or axis.
    """
    with open_npz_file(path, fix=RESTORE) as file:
        lacking = [] if instead is None else [name for name in _DERIVED if _empty(file, name)]
    arrays = read_arrays(path, [name for name in TOPOLOGY_KEYS if name not in lacking])
    _read_metadata(path, arrays)
    if instead is not None:
        _refuse_wrong_ids(path, arrays)
    if lacking and instead is not None:
        others = read_arrays(instead, TOPOLOGY_KEYS)
        if not np.array_equal(others["face_vert_indices"], arrays["face_vert_indices"]):
            cause = f"missing keys {lacking}, and its faces are not those of the canonical mesh"
            raise AssetError(path, cause=cause, fix="Take the file of a newer release")
        arrays |= {name: others[name] for name in lacking}
    return {name: arrays[name] for name in TOPOLOGY_KEYS}


def _empty(file: NpzFile, name: str) -> bool:
    """Whether an array is missing, or a segment without vertices."""
    return name not in file.names or (name.startswith("segment") and 0 in file.header(name).shape)


def _refuse_wrong_ids(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Vertex ids, and corners of polygons, of both levels of detail: no manifest vouches for them."""
    count, low = int(np.max(arrays["face_vert_indices"], initial=0)) + 1, len(arrays["lod_mid_to_low"])
    limits = {name: low if name.endswith("_low") else count for name in TOPOLOGY_KEYS if "uv" not in name}
    for name, limit in ((name, limit) for name, limit in limits.items() if name in arrays):
        ids = arrays[name]
        polygons = name.startswith("face_vert_counts")
        good = np.issubdtype(ids.dtype, np.integer) and (not ids.size or ids.min() >= (3 if polygons else 0))
        if not good or (ids.size and not polygons and ids.max() >= limit):
            cause = f"{name} holds {ids.dtype} values that are no ids of {limit} vertices"
            raise AssetError(path, cause=cause, fix="Take the file as it was published")
    for part in ("", "_low"):
        if arrays[f"face_vert_counts{part}"].sum() != len(arrays[f"face_vert_indices{part}"]):
            cause = f"face_vert_counts{part} does not add up to the corners there are"
            raise AssetError(path, cause=cause, fix="Take the file as it was published")


def read_stored_rig(path: Path) -> StoredRig | None:
    """The 78-joint rig that files of the first releases hold; None where the file has none.

    Raises:
        AssetError: arrays that do not fit together, or weights that are none.
    """
    with open_npz_file(path, fix=RESTORE) as file:
        if not {*_RIG_KEYS} <= {*file.names}:
            return None
    found = read_arrays(path, _RIG_KEYS)
    names, parents = found["joint_names"], np.array(found["joint_parent_ids"], np.int64)
    points, worlds = found["bind_shape"], (found["bind_pose_world"], found["t_pose_world"])
    count = len(names)
    shapes = (len(points), count), (count, 4, 4)
    parts = [found[f"skinning_weights_{part}"] for part in ("data", "indices", "indptr", "shape")]
    fits = (
        np.array_equal(parts[3], shapes[0])
        and points.ndim == 2
        and parents.shape == (count,)
        and all(world.shape == shapes[1] and np.isfinite(world).all() for world in worlds)
        and bool((np.abs(points) <= FARTHEST).all())
        and bool(((parents >= 0) & (parents < count)).all())
    )
    if not fits:
        raise AssetError(path, cause="the arrays of its rig do not fit together", fix="Take it as published")
    # The root is its own parent there. Columns are joints: the matrix is compressed by them.
    parents[parents == np.arange(count)] = -1
    try:
        stored = StoredMatrix(layout="csc", indices=(parts[2], parts[1]), values=parts[0], shape=shapes[0])
        weights = scipy.sparse.csr_array(stored.csr(), dtype=np.float64)
        weights.eliminate_zeros()
    except ValueError as error:
        raise AssetError(path, cause=f"skinning_weights: {error}", fix="Take it as published") from error
    refuse_bad_weights(path, weights)
    return StoredRig(
        joint_names=tuple(str(name) for name in names),
        parents=parents.astype(np.int32),
        bind_world=np.array(worlds[0], np.float64),
        t_pose_world=np.array(worlds[1], np.float64),
        bind_shape=np.array(points, np.float64),
        weights=weights,
    )


def load_shape_space(path: Path | str | None = None) -> ShapeSpace:
    """Load a shape space from a shape-space file or from any ``SOMA_neutral.npz``.

    Args:
        path: the file; default: the shipped one, checked against the manifest.

    Raises:
        AssetError: unreadable file, missing keys, another unit, or arrays that do not fit.
    """
    if path is None:
        root = assets_dir()
        verified_sha256(root, read_manifest(root), NEUTRAL_NAME)
        path = root / NEUTRAL_NAME
    path = Path(path)
    arrays = read_arrays(path, _SHAPE_KEYS)
    metadata = _read_metadata(path, arrays)
    provenance = metadata.get("provenance")
    trained = provenance.get("shape_space") if isinstance(provenance, dict) else None
    try:
        values = {key: np.ascontiguousarray(arrays[key], np.float32) for key in _SHAPE_KEYS}
        return ShapeSpace(**values, metadata=metadata if trained is None else trained)
    except (InputError, ValueError) as error:
        raise AssetError(path, cause=str(error).rstrip("."), fix="Restore the file") from error
