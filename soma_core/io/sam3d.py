"""Read SAM 3D Body outputs: MHR vertices and parameters of one person over time, from camera axes."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from soma_core._lazy import needed
from soma_core.errors import AssetError, InputError
from soma_core.io.npz_fields import NpzFields, open_npz
from soma_core.parquet_file import look_through
from soma_core.paths import expanded
from soma_core.plugin.spec import Unit
from soma_core.topology.frames import METRES

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["MHR_VERTICES", "SAM3D_SUFFIXES", "Sam3dFrames", "read_sam3d"]

MHR_VERTICES = 18439
"""Vertices of MHR at LOD 1, the mesh of every SAM 3D Body output."""

SAM3D_SUFFIXES = (".npz", ".parquet")
"""Files that are read."""

_VERTICES, _PLACEMENT = "pred_vertices", "pred_cam_t"
_LAYOUT = {
    _VERTICES: (MHR_VERTICES, 3),
    _PLACEMENT: (3,),
    "mhr_model_params": (204,),
    "shape_params": (45,),
    "expr_params": (72,),
}
"""Key -> shape of one frame. The other keys are 2D, or are parts of these in another coding."""

_CAMERA_TO_MODEL = np.array([1, -1, -1], np.float32)
"""The camera looks along +z with +y down; MHR stands along +y and faces +z."""

_SIZES = (0.2, 4.0)
"""Longest edge of the box around a body [m]: from a curled-up infant to a tall adult with raised arms."""

_TOP, _SOLE = 2809, 13069
"""A vertex on the top of the head, and one under a foot: which end of the body is up."""

_SMALL, _MOST_EXPANSION = 256 * 2**20, 64
"""Bytes that any file may unfold to, and times its size that a large one may."""

_FIX = "Save one person with np.savez(path, **person), or frames of one person stacked."

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sam3dFrames:
    """One person over time, as SAM 3D Body saw it; metres, +Y up, facing +Z where the pose says so.

    Attributes:
        path: the file.
        vertices: (frames, 18439, 3) float32 [m], MHR LOD 1, around the origin of the model.
        placement: (frames, 3) float32 [m] to add to `vertices` for the place before the camera, in the same
            axes; None where the file does not hold it.
        parameters: what the file holds of ``mhr_model_params`` (frames, 204), ``shape_params``
            (frames, 45) and ``expr_params`` (frames, 72), float32, in the units of MHR.
    """

    path: Path
    vertices: np.ndarray
    placement: np.ndarray | None
    parameters: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.vertices)


def read_sam3d(
    path: str | Path, *, axes: Literal["camera", "model"] = "camera", unit: Unit = "m"
) -> Sam3dFrames:
    """Read the output of SAM 3D Body for one person: one frame, or frames stacked along the first axis.

    An ``.npz`` holds the keys of the output; a ``.parquet``, which needs pyarrow, a frame a row and a key a
    column, as lists or lists of lists. Nothing in a file is executed; keys that are not needed stay unread.

    Args:
        path: the file.
        axes: ``camera``, as SAM 3D Body writes them (+Y down, +Z away from the camera), or ``model`` for
            vertices that were turned back already.
        unit: of the lengths, ``m``, ``cm`` or ``mm``; SAM 3D Body writes metres.

    Raises:
        AssetError: missing, damaged, or no file of its suffix.
        InputError: no vertices, another mesh than MHR LOD 1, another unit, or numbers that are not finite.
    """
    path = expanded(path)
    suffix = path.suffix.lower()
    if suffix not in SAM3D_SUFFIXES:
        raise InputError(
            str(path), got=f"the suffix {path.suffix!r}", expected=" or ".join(SAM3D_SUFFIXES), fix=_FIX
        )
    if axes not in ("camera", "model"):
        raise InputError(
            "axes", got=repr(axes), expected="'camera' or 'model'", fix="SAM 3D Body writes camera axes."
        )
    found = _read_npz(path) if suffix == ".npz" else _read_parquet(path)
    for key in {_VERTICES, _PLACEMENT} & found.keys() if unit != "m" else ():
        found[key] = found[key] * METRES[unit]
    _check(path, found)
    turn = _CAMERA_TO_MODEL if axes == "camera" else np.float32(1)
    vertices = found.pop(_VERTICES) * turn
    placement = found.pop(_PLACEMENT) * turn if _PLACEMENT in found else None
    _warn_upside_down(path, vertices, axes)
    return Sam3dFrames(path=path, vertices=vertices, placement=placement, parameters=found)


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with open_npz(path) as fields:
        if _VERTICES not in fields:
            raise _without_vertices(path, fields.names)
        return {key: _frames(fields, key) for key in _LAYOUT if key in fields}


def _frames(fields: NpzFields, key: str) -> np.ndarray:
    """Numbers under `key` with the axis of frames in front."""
    array, shape = fields.raw(key), _LAYOUT[key]
    if array.dtype.kind != "f" or array.shape[-len(shape) :] != shape or array.ndim > len(shape) + 1:
        raise _another_layout(fields.path, key, f"shape {array.shape}, dtype {array.dtype}")
    return _single(array.reshape(-1, *shape))


def _read_parquet(path: Path) -> dict[str, np.ndarray]:
    look_through(path)
    pa = needed("pyarrow", "parquet", setting=path, pip="[parquet]")
    try:
        with pa.parquet.ParquetFile(path) as file:
            names, rows = file.schema_arrow.names, file.metadata.num_rows
            wanted = [key for key in _LAYOUT if key in names]
            _refuse_bomb(path, rows, wanted)
            table = file.read(wanted, use_threads=False)
        columns = {key: table.column(key).combine_chunks() for key in wanted}
    except (pa.ArrowException, OSError, KeyError, UnicodeDecodeError) as error:
        raise AssetError(path, cause=f"damaged ({error})", fix="Fetch or write it again.") from error
    if _VERTICES not in names:
        raise _without_vertices(path, names)
    return {key: _column(path, key, column) for key, column in columns.items()}


def _refuse_bomb(path: Path, rows: int, keys: Sequence[str]) -> None:
    """Refuse a file that unfolds to more than its size can mean.

    Rows are all that is asked for: pyarrow ends the process at a look at the columns of some damaged files.
    """
    unfolded = 4 * rows * sum(math.prod(_LAYOUT[key]) for key in keys)
    most = max(_SMALL, _MOST_EXPANSION * path.stat().st_size)
    if unfolded > most:
        cause = f"unfolds to {unfolded} bytes, at most {most} are read of a file of {path.stat().st_size}"
        raise AssetError(path, cause=cause, fix="Check where it comes from, or write it in parts.")


def _column(path: Path, key: str, column: pa.Array) -> np.ndarray:
    """Numbers of a column of lists, or lists of lists, one a frame."""
    import pyarrow as pa
    from pyarrow import compute

    values, lengths = column, []
    while (
        pa.types.is_list(kind := values.type)
        or pa.types.is_large_list(kind)
        or pa.types.is_fixed_size_list(kind)
    ):
        lengths.append(compute.min_max(compute.list_value_length(values)).as_py())
        values = values.flatten()
    even = all(length["min"] == length["max"] for length in lengths)
    count = len(column) * math.prod(_LAYOUT[key])
    nulls = column.null_count + values.null_count
    if nulls or not even or len(values) != count or not pa.types.is_floating(values.type):
        ragged = "" if even else ", ragged"
        got = f"{len(column)} rows of {column.type} with {len(values)} numbers and {nulls} nulls{ragged}"
        raise _another_layout(path, key, got)
    return _single(values.to_numpy(zero_copy_only=False).reshape(-1, *_LAYOUT[key]))


def _single(values: np.ndarray) -> np.ndarray:
    """Values as float32; those beyond it become infinite, and are refused as such."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _without_vertices(path: Path, names: Iterable[str]) -> InputError:
    return InputError(
        f"{path}: {_VERTICES}",
        got=f"only the keys {', '.join(names)}",
        expected=f"a key '{_VERTICES}'",
        fix=f"{_FIX} The parameters alone need the MHR model: pose them with the backend mhr.",
    )


def _another_layout(path: Path, key: str, got: str) -> InputError:
    shape = ", ".join(map(str, _LAYOUT[key]))
    lod = " of MHR LOD 1" if key == _VERTICES else ""
    return InputError(
        f"{path}: {key}", got=got, expected=f"numbers ({shape}){lod}, or (frames, {shape})", fix=_FIX
    )


def _check(path: Path, found: Mapping[str, np.ndarray]) -> None:
    """Refuse an empty file, keys of another length, what is not finite, and another unit."""
    frames = len(found[_VERTICES])
    for key, values in found.items():
        if len(values) != frames or not frames:
            raise InputError(
                f"{path}: {key}", got=f"{len(values)} frames",
                expected=f"as many as {_VERTICES} ({frames}), at least 1", fix=_FIX,
            )  # fmt: skip
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            index = tuple(map(int, bad[0]))
            raise InputError(
                f"{path}: {key}", got=f"{values[index]} at index {index}", expected="finite numbers",
                fix="Remove or interpolate the damaged frames.",
            )  # fmt: skip
    edges = np.ptp(found[_VERTICES], axis=1).max(axis=1)
    size, (low, high) = float(np.median(edges)), _SIZES
    if not low <= size <= high:
        unit = next((name for name, metres in METRES.items() if low <= size * metres <= high), None)
        raise InputError(
            f"{path}: {_VERTICES}",
            got=f"a body of {size:.4g} m" + (f", as of a file in {unit}" if unit else ""),
            expected=f"{low:g} to {high:g} m",
            fix=f"Pass unit={unit or 'm, cm or mm, as they are stored'}.",
        )


def _warn_upside_down(path: Path, vertices: np.ndarray, axes: str) -> None:
    up = vertices[:, _TOP, 1] > vertices[:, _SOLE, 1]
    if up.mean() < 0.5:
        upright = "y" if axes == "camera" else "-y"
        _log.warning(
            "%s: the body is upside down in most frames; if that is not its pose, pass up=%s",
            path.name,
            upright,
        )
