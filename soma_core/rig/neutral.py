"""``SOMA_neutral.npz``: topology and semantics of the canonical mesh, and the PCA shape space [cm]."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.json_file import parse_json
from soma_core.npz import open_npz_file
from soma_core.paths import assets_dir
from soma_core.rig.manifest import NEUTRAL_NAME, RESTORE, read_manifest, verified_sha256

__all__ = [
    "SEGMENT_NAMES",
    "TOPOLOGY_KEYS",
    "ShapeSpace",
    "load_shape_space",
    "read_arrays",
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


def read_topology(path: Path) -> dict[str, np.ndarray]:
    """Read every array of `TOPOLOGY_KEYS`; extra keys (also those of old files) are ignored.

    Raises:
        AssetError: unreadable file, missing keys, or metadata of another unit or axis.
    """
    arrays = read_arrays(path, TOPOLOGY_KEYS)
    _read_metadata(path, arrays)
    return {name: arrays[name] for name in TOPOLOGY_KEYS}


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
