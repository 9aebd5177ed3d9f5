"""Clips as rows of Parquet: what a shard holds of a motion, and motion files that come as rows."""

from __future__ import annotations

import functools
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core._lazy import needed
from soma_core.cache import UnwritableError, atomic_arrays, atomic_write, file_sha256
from soma_core.errors import InputError, SomaError
from soma_core.motion.converter import Converter
from soma_core.motion.files import ResultFiles
from soma_core.motion.folder import Outcome, converters_of, outcome
from soma_core.motion.options import DatasetOptions
from soma_core.npz import open_npz_file
from soma_core.options import Picture
from soma_core.paths import fitting

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = [
    "LONGEST", "Clips", "clip_file", "clip_rows", "clip_schema", "need_pyarrow", "refused", "row_array",
    "row_tables", "write_rows",
]  # fmt: skip

LONGEST = 36_864
"""Frames of a row at most, five minutes at 120 a second: a longer clip is several rows, from `start` on."""

_PIECE = 2048
_GROUP = 16 * 2**20
"""Bytes after which a row group ends."""

_NAMES = ("name", "path", "file_name", "id")
"""Columns that name a row."""

_FIGURES = ("mean", "median", "p95", "max")


def need_pyarrow() -> Any:
    """The module ``pyarrow``, or an InputError that says how to install it."""
    return needed("pyarrow", "compute", "parquet", setting="output", pip="[parquet]")


@functools.cache
def clip_schema() -> pa.Schema:
    """Columns of a clip; those of a motion have the names, units and axes of the NPZ schema."""
    pa = need_pyarrow()
    text, count, number, single = pa.string(), pa.int64(), pa.float64(), pa.float32()
    vectors = pa.list_(single, 3)
    return pa.schema(
        {
            "name": text, "state": text, "reason": text, "layout": text, "sha256": text,
            "start": count, "frames": count, "clip_frames": count, "fps": number,
            "poses": pa.list_(pa.list_(vectors, 77)), "transl": pa.list_(vectors),
            "foot_contacts": pa.list_(pa.list_(pa.bool_(), 4)), "skeleton": pa.list_(vectors),
            "schema_version": count, "rotation_repr": text, "convention": text, "unit": text,
            "up_axis": text, "root_translation": text, "rig_hash": text, "source": text, "licence": text,
            "identity_model_type": text, "identity_params": text, "identity_options": text,
            "identity_rest": pa.list_(vectors), "scale_params": pa.list_(pa.list_(single)),
            **{f"error_{name}_mm": number for name in _FIGURES}, "warnings": pa.list_(text),
        }
    )  # fmt: skip


def clip_rows(found: Outcome, sha256: str, *, longest: int = LONGEST) -> Iterator[pa.Table]:
    """A table of one row for a clip, or of one for each `longest` frames; without a motion where it has none.

    Args:
        found: what became of the clip; its motion is read from its file.
        sha256: of the file that it came from.
        longest: frames of a row at most, a multiple of 2048 or less than that.
    """
    told = {"name": found.name, "sha256": sha256, "warnings": []} | {
        key: found.row.get(key) for key in ("state", "reason", "layout", "warnings")
    }
    if found.converted is None:
        yield _row(told)
        return
    errors = found.converted.error_mm or {}
    told |= {f"error_{name}_mm": errors.get(name) for name in _FIGURES}
    with open_npz_file(found.converted.files.motion) as file:
        total = file.header("poses").shape[0]
        pieces = {
            name: file.pieces(name, min(_PIECE, longest))
            for name in ("poses", "transl", "foot_contacts") if name in file.names
        }  # fmt: skip
        for name in file.names:
            if name not in pieces and name in clip_schema().names:
                array = file.read(name)
                told[name] = array if array.ndim else array.item()
        told |= {"clip_frames": total, "rotation_repr": "rotvec"}
        for start in range(0, total, longest):
            count = min(longest, total - start)
            yield _row(told | {"start": start, "frames": count} | _long(pieces, count))


def _long(pieces: Mapping[str, Iterator[np.ndarray]], count: int) -> dict[str, np.ndarray]:
    """The next `count` frames of each array; rotations as vectors."""
    found = {}
    for name, source in pieces.items():
        parts, left = [], count
        while left > 0:
            part = next(source)
            parts.append(_vectors(part) if name == "poses" else part)
            left -= len(part)
        found[name] = np.concatenate(parts)
    return found


def _vectors(matrices: np.ndarray) -> np.ndarray:
    """Rotation vectors (frames, 77, 3) [rad] in float32, of matrices."""
    turns = Rotation.from_matrix(matrices.reshape(-1, 3, 3).astype(np.float64)).as_rotvec()
    return turns.reshape(*matrices.shape[:2], 3).astype(np.float32)


def _row(values: Mapping[str, Any]) -> pa.Table:
    pa = need_pyarrow()
    columns = [_column(kind, values.get(kind.name)) for kind in clip_schema()]
    return pa.Table.from_arrays(columns, schema=clip_schema())


def _column(field: pa.Field, value: Any) -> pa.Array:
    """A column with this value alone; arrays are not taken apart into Python's numbers."""
    pa = need_pyarrow()
    if not isinstance(value, np.ndarray):
        return pa.array([value], field.type)
    flat = pa.array(np.ascontiguousarray(value).ravel())
    for size in reversed(value.shape[1:]):
        flat = pa.FixedSizeListArray.from_arrays(flat, size)
    return pa.ListArray.from_arrays([0, len(value)], flat).cast(field.type)


def write_rows(path: Path, tables: Iterable[pa.Table]) -> None:
    """Write a Parquet file with zstd; equal rows give equal bytes, and few are in memory at a time."""
    pa = need_pyarrow()
    with pa.parquet.ParquetWriter(path, clip_schema(), compression="zstd") as writer:
        waiting: list[pa.Table] = []
        for table in tables:
            waiting.append(table)
            if sum(each.nbytes for each in waiting) >= _GROUP:
                writer.write_table(pa.concat_tables(waiting))
                waiting = []
        if waiting:
            writer.write_table(pa.concat_tables(waiting))


def clip_file(row: Mapping[str, Any], name: str, folder: Path) -> tuple[str, Path]:
    """Write the motion file that a row holds; give the row's name, and the file.

    Args:
        row: column -> Arrow array of one entry. ``bytes`` is a file as it is, whose name tells its format;
            other columns are the arrays of an NPZ.
        name: of where the row lies, before its own; may be empty.
        folder: for the file.

    Raises:
        InputError: a column is ragged, or holds what no NPZ can.
    """
    texts = [row[key][0].as_py() for key in _NAMES if key in row]
    own = next((text for text in texts if isinstance(text, str) and text), "")
    name = "/".join(filter(None, (name, own))) or "clip"
    stem = fitting(re.sub(r"[\x00-\x1f\\]", "_", PurePosixPath(own).name).strip(".") or "clip")
    if "bytes" in row:
        content, path = row["bytes"][0].as_py() or b"", folder / stem
        atomic_write(path, lambda place: place.write_bytes(content))
    else:
        arrays = {key: row_array(name, key, column) for key, column in row.items() if column[0].is_valid}
        path = folder / (stem if stem.lower().endswith(".npz") else f"{stem}.npz")
        atomic_arrays(path, arrays, compressed=False)
    # A fit knows its file again by the time of change: here that follows from the content.
    stamp = int(file_sha256(path)[:12], 16)
    os.utime(path, ns=(stamp, stamp))
    return name, path


def row_array(name: str, key: str, column: pa.Array) -> np.ndarray:
    """The one entry of a column."""
    pa = need_pyarrow()
    if isinstance(column, pa.ExtensionArray):  # Ray's tensors
        return np.asarray(column.to_numpy(zero_copy_only=False)[0])
    kind, values, shape = column.type, column, []
    while pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        sizes = pa.compute.list_value_length(values).unique().to_pylist()
        if len(sizes) != 1 or sizes[0] is None:
            raise InputError(
                f"{name}: {key}", got=f"lists of {len(sizes)} lengths", expected="lists of one length",
                fix="Store an array a row, or leave the column out.",
            )  # fmt: skip
        shape.append(sizes[0])
        values = values.flatten()
        kind = values.type
    found = values.to_numpy(zero_copy_only=False).reshape(shape)
    return found.astype(str) if found.dtype == object else found


class Clips:
    """Clips to rows, one after the other: backends and fits serve all of them."""

    def __init__(self, options: DatasetOptions, run: str) -> None:
        self._options, self._run = replace(options, picture=Picture(frames=0)), run
        self._convert = Converter(self._options, refuse_unused=False)

    def __call__(
        self, file: Path, name: str, work: Path, rows: dict[str, Any], sha256: str
    ) -> Iterator[pa.Table]:
        """The rows of a file, those of the report too; texts name the clip, not where it lies for now.

        Raises:
            UnwritableError: the disk is full.
        """
        for number, (one, convert) in enumerate(converters_of(self._convert, file, name, self._options)):
            place = work / str(number)
            found = outcome(convert, file, ResultFiles.of_folder(place), place / "chunks", one, run=self._run)
            if isinstance(found.error, UnwritableError):
                raise found.error
            row = json.loads(json.dumps(found.row, default=float).replace(json.dumps(str(file))[1:-1], name))
            rows[one] = row
            yield from clip_rows(replace(found, row=row), sha256)


def row_tables(
    clips: Clips, columns: Mapping[str, pa.Array], name: str, work: Path, rows: dict[str, Any]
) -> Iterator[pa.Table]:
    """The clip of a row, through a file of its own."""
    try:
        name, file = clip_file(columns, name, work / "source")
    except UnwritableError:
        raise
    except Exception as error:  # one row never ends a batch
        yield from refused(name, error, rows)
        return
    yield from clips(file, name, work, rows, file_sha256(file))


def refused(name: str, error: Exception, rows: dict[str, Any]) -> Iterator[pa.Table]:
    """The row of what cannot be read."""
    told = str(error) if isinstance(error, SomaError) else f"{name}: cannot be read ({error})"
    rows[name] = {"state": "failed", "reason": told}
    return clip_rows(Outcome(name=name, row=rows[name], told=told), "")
