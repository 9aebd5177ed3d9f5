"""Arrays of a file of tensors (``.pt``, ``.pth``) without torch: checked before any of them is made.

Since torch 1.6 such a file is a zip archive of one pickle, ``data.pkl``, and of storages, ``data/0`` and so
on, uncompressed; a tensor is a view of a storage by offset, shape and strides. The layout is that of
``torch.save``: https://docs.pytorch.org/docs/stable/notes/serialization.html.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable
from soma_core.pickle_machine import STORED, Global, PickleRules, Record, run_pickle
from soma_core.safe_pickle import ALLOWED_NAMES, plain_values
from soma_core.stored_matrix import StoredMatrix
from soma_core.zip_archive import ARCHIVE_DAMAGE, open_archive

__all__ = ["read_tensor_archive"]

_MOST_BYTES = 2**30
_LONGEST_PICKLE = 64 * 2**20
_SMALL = 256 * 2**20
_MOST_EXPANSION = 4
"""Times its size that a large file may unfold to: views of one storage may repeat its numbers."""

_MOST_AXES, _LONGEST_AXIS = 16, 2**40

_DTYPES = {
    "Double": "f8", "Float": "f4", "Half": "f2", "BFloat16": "u2", "Long": "i8", "Int": "i4", "Short": "i2",
    "Char": "i1", "Byte": "u1", "Bool": "?", "ComplexDouble": "c16", "ComplexFloat": "c8",
}  # fmt: skip
"""Names of torch's storages, less "Storage"; BFloat16 is the upper half of a Float."""

_REBUILT = ("_rebuild_tensor", "_rebuild_tensor_v2", "_rebuild_parameter", "_rebuild_sparse_tensor")
_PLAIN = ("set", "list", "dict", "int", "float", "bool", "str")
_RULES = PickleRules(
    names=ALLOWED_NAMES
    | {Global("torch", f"{name}Storage") for name in _DTYPES}
    | {Global("torch._utils", name) for name in _REBUILT}
    | {Global(module, name) for module in ("builtins", "__builtin__") for name in _PLAIN}
    | {Global("collections", name) for name in ("OrderedDict", "defaultdict")}
    | {Global("torch", name) for name in ("Size", "device")}
    | {Global("torch.serialization", "_get_layout")},
    purpose="a file of tensors",
    stored=True,
    most_instructions=3_000_000,
)
_LAYOUTS = {f"torch.sparse_{name}": name for name in ("coo", "csr", "csc", "bsr", "bsc")}


def read_tensor_archive(
    path: Path | str,
    *,
    fix: str,
    sparse: Callable[[StoredMatrix], Any],
    other: Callable[[Record], Any] | None = None,
) -> Any:
    """Contents of a file of tensors: tensors as arrays, sparse ones as what `sparse` makes of them.

    Lists, tuples and dictionaries with text or small integers as keys are kept, sets come as lists, half
    precision as float16, bfloat16 as float32. Arrays are read-only, and share memory where the tensors do.
    `other` makes values of what is no tensor: the records of numpy.

    Raises:
        AssetError: missing, no archive of ``torch.save`` (older than torch 1.6, TorchScript, compressed),
            classes other than tensors, or tensors that leave their storage or unfold to more than 256 MiB
            and four times the file.
    """
    _refuse_old_layout(path, fix)
    with open_archive(path, kind="a file of tensors (.pt)", fix=fix, most_bytes=_MOST_BYTES) as archive:
        try:
            contents = _Contents(archive, Path(path).stat().st_size)
            contents.sparse, contents.other = sparse, other or _refuse_record
            return contents.read()
        except ARCHIVE_DAMAGE as error:
            cause = str(error)[:500] if isinstance(error, ValueError) else f"is damaged ({error!s:.200})"
            raise AssetError(path, cause=cause, fix=f"Nothing of it was run. {fix}") from error


def _refuse_old_layout(path: Path | str, fix: str) -> None:
    head = refuse_unreadable(path, fix=fix)
    if head[:1] == b"\x80" and b"\x6c\xfc\x9c\x46\xf9" in head:  # torch's magic number
        raise AssetError(
            path,
            cause="is in the layout of torch before 1.6, which is not read here",
            fix='If you trust it, write it anew with torch: python -c "import torch; '
            "torch.save(torch.load('OLD.pt', map_location='cpu', weights_only=True), 'NEW.pt')\".",
        )


def _refuse_record(record: Record) -> None:
    raise ValueError(f"a {record.function}, which is no tensor")


class _Contents:
    """One archive while it is read."""

    sparse: Callable[[StoredMatrix], Any]
    other: Callable[[Record], Any]

    def __init__(self, archive: zipfile.ZipFile, size: int) -> None:
        self._archive = archive
        self._members = {info.filename: info for info in archive.infolist()}
        self._left = max(_SMALL, _MOST_EXPANSION * size)
        self._storages: dict[str, tuple[str, np.ndarray]] = {}
        self._refuse_strange_members(size)
        pickles = [name for name in self._members if re.fullmatch(r"[^/]*/data\.pkl", name)]
        if len(pickles) != 1:
            raise ValueError("is not what torch.save writes: no data.pkl, or several")
        self._root = pickles[0].removesuffix("data.pkl")
        order = f"{self._root}byteorder"
        self._big = order in self._members and self._member(order, most=6) == b"big"

    def _refuse_strange_members(self, size: int) -> None:
        if len(self._members) != len(self._archive.infolist()):
            raise ValueError("has two members of one name")
        if any(name.endswith("/constants.pkl") for name in self._members):
            raise ValueError("is a TorchScript program, which is code, where tensors were expected")
        if any(info.compress_type != zipfile.ZIP_STORED for info in self._members.values()):
            raise ValueError("has compressed members, which torch.save never writes")
        if sum(info.file_size for info in self._members.values()) > size:
            raise ValueError("has members that are longer than the file, or lie on each other")

    def _member(self, name: str, *, most: int) -> bytes:
        if name not in self._members:
            raise ValueError(f"has no member {name[:80]!a}")
        if self._members[name].file_size > most:
            size = self._members[name].file_size
            raise ValueError(f"has a member {name[:80]!a} of {size} bytes, more than the {most} it can have")
        return self._archive.read(name)

    def read(self) -> Any:
        program = self._member(f"{self._root}data.pkl", most=_LONGEST_PICKLE)
        return plain_values(run_pickle(program, _RULES), self._made)

    def _made(self, record: Record) -> Any:
        """Value of a record of torch's."""
        name, arguments = record.function.name, record.arguments
        if name in ("_rebuild_tensor", "_rebuild_tensor_v2"):
            if any(arguments[6:]):
                raise ValueError("a tensor that is conjugated, negated or of a class of its own")
            return self._tensor(*arguments[:4])
        if name == "_rebuild_parameter":
            return self._made(self._record(arguments[0], "_rebuild_tensor_v2"))
        if name == "_rebuild_sparse_tensor":
            return self._sparse(*arguments)
        if record.function == Global("torch", "Size"):
            return self._sizes(arguments[0], "size")
        if record.function == Global("torch", "device"):
            return ":".join(str(part) for part in arguments if type(part) in (str, int))
        return self.other(record)

    def _record(self, value: Any, *names: str) -> Record:
        if type(value) is not Record or value.function.name not in names:
            raise ValueError(f"no {' or '.join(names)} where one was expected")
        return value

    def _sizes(self, value: Any, what: str) -> tuple[int, ...]:
        if type(value) is Record and value.function == Global("torch", "Size"):
            value = value.arguments[0]
        fits = type(value) is tuple and len(value) <= _MOST_AXES
        if not fits or not all(type(size) is int and 0 <= size <= _LONGEST_AXIS for size in value):
            raise ValueError(f"a {what} that is none")
        return value

    def _tensor(self, stored: Any, offset: Any, size: Any, stride: Any) -> np.ndarray:
        numbers = self._storage(self._record(stored, STORED.name).arguments[0])
        shape, steps = self._sizes(size, "size"), self._sizes(stride, "stride")
        if type(offset) is not int or offset < 0 or len(shape) != len(steps):
            raise ValueError("an offset, a size and strides that do not belong together")
        last = offset + sum((count - 1) * step for count, step in zip(shape, steps, strict=True))
        if math.prod(shape) and last >= len(numbers):
            raise ValueError(f"a tensor of shape {shape} that leaves its storage of {len(numbers)} numbers")
        self._left -= math.prod(shape) * numbers.itemsize
        if self._left < 0:
            raise ValueError("tensors that unfold to far more than the file holds")
        if not math.prod(shape):
            return np.empty(shape, numbers.dtype)
        strides = tuple(step * numbers.itemsize for step in steps)
        return np.lib.stride_tricks.as_strided(numbers[offset:], shape, strides, writeable=False)

    def _storage(self, reference: Any) -> np.ndarray:
        """Numbers of a storage, which is read once."""
        mark, kind, key, _, count = reference
        if mark != "storage" or type(kind) is not Global or type(key) is not str or type(count) is not int:
            raise ValueError("a reference to something that is no storage")
        known, numbers = self._storages.get(key, (kind.name, None))
        if known != kind.name:
            raise ValueError(f"a storage {key[:20]!a} of both {known} and {kind.name}")
        if numbers is not None:
            return numbers
        name = kind.name.removesuffix("Storage")
        if name not in _DTYPES:
            raise ValueError(f"a storage of {kind}, which is not read here")
        dtype = np.dtype(_DTYPES[name]).newbyteorder(">" if self._big else "<")
        member = f"{self._root}data/{key}"
        data = self._member(member, most=_MOST_BYTES)
        if len(data) != count * dtype.itemsize:
            raise ValueError(f"{len(data)} bytes in the storage {key[:20]!a} of {count} numbers")
        numbers = np.frombuffer(data, dtype)
        if dtype.kind != "b" and dtype.byteorder == ">":
            numbers = numbers.astype(dtype.newbyteorder("="))
        if name == "BFloat16":
            numbers = (numbers.astype(np.uint32) << 16).view(np.float32)
        self._storages[key] = kind.name, numbers
        return numbers

    def _sparse(self, layout: Any, data: Any) -> Any:
        name = self._record(layout, "_get_layout").arguments[0]
        if name not in _LAYOUTS or type(data) is not tuple:
            raise ValueError("a sparse tensor of an unknown layout")
        count = 2 if name == "torch.sparse_coo" else 3
        *tensors, size = data[: count + 1]
        parts = [self._made(self._record(part, "_rebuild_tensor", "_rebuild_tensor_v2")) for part in tensors]
        shape = self._sizes(size, "size")
        *indices, values = parts
        if count == 2 and indices[0].shape[:1] != (2,):
            raise ValueError("indices of a sparse tensor that are not two rows")
        first, second = indices[0] if count == 2 else indices
        return self.sparse(
            StoredMatrix(layout=_LAYOUTS[name], indices=(first, second), values=values, shape=shape)
        )
