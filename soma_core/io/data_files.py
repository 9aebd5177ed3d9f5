"""Named values of a file, whatever its container: NPZ, NPY, pickle, joblib's pickle, or a file of tensors.

A file's content is nested dictionaries and lists; its leaves stay as they are stored until their array is
asked for. No class of a pickle is looked up and nothing in it is called.
"""

from __future__ import annotations

import bz2
import functools
import gzip
import io
import lzma
import math
import mmap
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable
from soma_core.io.json_frames import holds_pose_frames, read_pose_frames
from soma_core.io.motion_pickle import array_text, is_tensor, run_motion_pickle, tensor_array
from soma_core.io.pickled_arrays import RecordArrays
from soma_core.npz import ArrayHeader, NpzFile, open_npz_file, read_array_header
from soma_core.pickle_machine import Record, RefusedPickleError
from soma_core.tensor_archive import read_tensor_archive

__all__ = ["DATA_SUFFIXES", "DataFile", "open_data", "read_torch_arrays"]

DATA_SUFFIXES = (".npz", ".npy", ".pkl", ".pickle", ".pt", ".pth")
"""Files that are read."""

_SMALL, _MOST_EXPANSION = 256 * 2**20, 64
_MOST_BYTES = 2**30
_BLOCK = 2**20
_FEW = 64
"""Python objects in one array of an NPZ that are looked at; longer ones are numbers, or labels."""

_DEEPEST, _MOST_VALUES, _PLAIN = 5, 500_000, 32
"""Levels of lists that are an array, and arrays in the lists of a file: a part of 100,000 frames of five
people; of numbers of Python, so many count as one."""

_TRUSTED = (
    "Nothing of it was run. If you trust it, load it where it was written and save plain arrays: "
    "np.savez(FILE, **arrays)."
)

_UNPACKERS: dict[bytes, Callable[[IO[bytes]], IO[bytes]]] = {
    b"\x1f\x8b": lambda file: gzip.GzipFile(fileobj=file),  # type: ignore[dict-item,return-value]
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
    b"\x5d\x00": lzma.LZMAFile,
}  # fmt: skip
"""First bytes of what joblib compresses with, besides its usual zlib, and what reads them."""

_ZLIB, _LZ4 = b"\x78", b"\x04\x22\x4d\x18"
_UNPACKING = (zlib.error, lzma.LZMAError, EOFError, OSError, ValueError)


class _Member:
    """An array of an NPZ or NPY file that is read when asked for, or why it cannot be."""

    def __init__(self, read: Callable[[], np.ndarray], header: ArrayHeader | None = None) -> None:
        self.read, self.header = read, header


class DataFile:
    """Content of one file.

    Attributes:
        path: the file.
        content: dictionaries with text or integer keys, lists and tuples; leaves are for :meth:`array`.
    """

    def __init__(self, path: Path, content: Any) -> None:
        self.path, self.content = path, content
        self._records = RecordArrays(path.stat().st_size)
        self._lists: dict[int, np.ndarray | ValueError] = {}
        self._values_left, self._bytes_left = _MOST_VALUES, max(_SMALL, _MOST_EXPANSION * path.stat().st_size)

    def array(self, value: Any) -> np.ndarray:
        """Array of a leaf: numbers or text, or a list of such that are alike.

        Raises:
            ValueError: something else, damaged, or too large.
        """
        return self._array(value, 0)

    def _array(self, value: Any, depth: int) -> np.ndarray:
        if isinstance(value, _Member):
            return value.read()
        if isinstance(value, Record):
            return self._of_record(value)
        if isinstance(value, (list, tuple)):
            return self._of_list(value, depth + 1)
        if isinstance(value, (np.ndarray, np.generic, int, float, str)):
            return np.asarray(value)
        raise ValueError(f"Python objects: a {type(value).__name__}")

    def _of_list(self, values: list[Any] | tuple[Any, ...], depth: int) -> np.ndarray:
        """A list is read once, since what looks like a tree may be a few lists in each other."""
        if id(values) not in self._lists:
            try:
                self._lists[id(values)] = self._stacked(values, depth)
            except ValueError as error:
                self._lists[id(values)] = error
        found = self._lists[id(values)]
        if isinstance(found, ValueError):
            raise found
        return found

    def _stacked(self, values: list[Any] | tuple[Any, ...], depth: int) -> np.ndarray:
        plain = all(type(value) in (int, float) for value in values)
        self._values_left -= 1 + len(values) // (_PLAIN if plain else 1)
        if depth > _DEEPEST or self._values_left < 0:
            raise ValueError(f"lists of more than {_DEEPEST} levels or {_MOST_VALUES} arrays")
        parts = [] if plain else [self._array(value, depth) for value in values]
        if not values or len({(part.shape, part.dtype.kind) for part in parts}) > 1:
            raise ValueError(f"a list of {len(values)} values that are not alike")
        self._bytes_left -= len(values) * max((part.nbytes for part in parts), default=8)
        if self._bytes_left < 0:
            raise ValueError("lists that unfold to far more than the file holds")
        found = np.asarray(values) if plain else np.stack(parts)
        if found.dtype.kind == "O":
            raise ValueError("numbers beyond 64 bits")
        return found

    def shape(self, value: Any) -> tuple[int, ...] | None:
        """Shape of a leaf, None where it is none; the numbers of an NPZ stay unread."""
        if isinstance(value, _Member) and value.header is not None:
            return value.header.shape
        try:
            return self.array(value).shape
        except ValueError:
            return None

    def _of_record(self, record: Record) -> np.ndarray:
        if is_tensor(record):
            return tensor_array(record)
        if (objects := _objects_in(record)) is not None:
            shape, values = objects
            found = self._of_list(values, 1)
            return found.reshape(*shape, *found.shape[1:])
        text = array_text(record)
        return self._records.array(record) if text is None else text


@contextmanager
def open_data(path: str | Path) -> Iterator[DataFile]:
    """Open a file of `DATA_SUFFIXES`, or a folder of JSON frames.

    Raises:
        AssetError: missing, damaged, a git-LFS pointer, of another kind than its suffix says, or a pickle
            that asks for what is no data.
    """
    path = Path(path).expanduser()
    suffix = path.suffix.lower()
    if holds_pose_frames(path):
        yield DataFile(path, read_pose_frames(path))
    elif suffix == ".npz":
        with open_npz_file(path, fix="Give a complete .npz file.") as file:
            found = DataFile(path, None)
            found.content = {name: _npz_value(file, name, found) for name in file.names}
            yield found
    elif suffix == ".npy":
        yield DataFile(path, _npy_value(path))
    elif suffix in (".pt", ".pth"):
        yield DataFile(path, read_torch_arrays(path))
    else:
        yield DataFile(path, _pickled(path))


def _npz_value(file: NpzFile, name: str, found: DataFile) -> Any:
    """An array that is still unread, or what an array of a few Python objects holds."""
    try:
        header = file.header(name, objects=True)
        if not header.dtype.hasobject:
            return _Member(lambda: file.read(name), header)
        if header.count <= _FEW:
            return _opened(run_motion_pickle(file.pickled(name)))
    except RefusedPickleError as error:
        return _Member(_refusing(f"Python objects, which {error}"))
    except ValueError as error:
        return _Member(_refusing(str(error)))

    @functools.cache
    def read() -> np.ndarray:
        try:
            return found.array(run_motion_pickle(file.pickled(name)))
        except RefusedPickleError as error:
            raise ValueError(f"Python objects, which {error}") from error

    return _Member(read)


def _refusing(reason: str) -> Callable[[], np.ndarray]:
    def refuse() -> np.ndarray:
        raise ValueError(reason)

    return refuse


def _npy_value(path: Path) -> Any:
    """The array of an NPY file, still unread; or what its Python objects are."""
    refuse_unreadable(path, most_bytes=_MOST_BYTES)
    with open(path, "rb") as stream:
        try:
            header = read_array_header(stream, objects=True)
        except ValueError as error:
            raise AssetError(
                path, cause=f"no NPY file ({error})", fix="Give a complete .npy file."
            ) from error
        if header.dtype.hasobject:
            return _run(path, stream.read())
    if header.begin + header.byte_count != path.stat().st_size:
        cause = f"cut off, or longer than its shape {header.shape}"
        raise AssetError(path, cause=cause, fix="Give a complete .npy file.")

    def read() -> np.ndarray:
        flat = np.fromfile(path, header.dtype, offset=header.begin)
        return flat.reshape(header.shape, order="F" if header.fortran else "C")

    return _Member(read, header)


def read_torch_arrays(path: Path | str) -> Any:
    """Contents of a ``.pt`` or ``.pth`` file: nested dictionaries, lists, tuples, arrays and plain values.

    Tensors come as arrays in native byte order (bfloat16 as float32, sparse ones dense), which may be
    read-only views of each other; numpy's arrays as they are; keys are text or integers. Nothing is run,
    and nothing is built that the metadata of the file do not bear out.

    Raises:
        AssetError: as :func:`~soma_core.tensor_archive.read_tensor_archive`; the cause names the keys that
            lead to what cannot be read.
    """
    refuse_unreadable(path)
    arrays = RecordArrays(Path(path).stat().st_size)
    return read_tensor_archive(
        path,
        fix="Save plain tensors: torch.save({'name': tensor.cpu()}, FILE).",
        sparse=arrays.dense,
        other=arrays.array,
    )


def _pickled(path: Path) -> Any:
    head = refuse_unreadable(path, most_bytes=_MOST_BYTES)
    if head.startswith(_LZ4):
        fix = "If you trust it, write it without: joblib.dump(joblib.load('OLD.pkl'), 'NEW.pkl')."
        raise AssetError(path, cause="compressed by lz4, which is not read here", fix=fix)
    with open(path, "rb") as stream:
        unpack = next((unpack for mark, unpack in _UNPACKERS.items() if head.startswith(mark)), None)
        if unpack is not None:
            return _run(path, _unpacked(path, unpack(stream)))
        if head.startswith(_ZLIB):
            return _run(path, _unpacked(path, _ZlibStream(stream)))
        return _run(path, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))


def _run(path: Path, data: mmap.mmap | bytes) -> Any:
    try:
        return _opened(run_motion_pickle(data))
    except RefusedPickleError as error:
        raise AssetError(path, cause=str(error), fix=_TRUSTED) from error


class _ZlibStream(io.RawIOBase):
    """What a zlib stream unfolds to, block by block."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self._unpacker = stream, zlib.decompressobj()

    def read(self, size: int = -1, /) -> bytes:
        while not self._unpacker.eof:
            packed = self._unpacker.unconsumed_tail or self._stream.read(_BLOCK)
            if not packed:
                raise EOFError("cut off")
            if found := self._unpacker.decompress(packed, size):
                return found
        return b""


def _unpacked(path: Path, stream: IO[bytes] | io.RawIOBase) -> bytes:
    """All of a compressed stream, up to what its size can mean."""
    most, data = max(_SMALL, _MOST_EXPANSION * path.stat().st_size), bytearray()
    try:
        while block := stream.read(_BLOCK):
            data += block
            if len(data) > most:
                cause = f"unfolds to more than {most} bytes, which a file of its size does not mean"
                raise AssetError(path, cause=cause, fix="Check where it comes from.")
    except _UNPACKING as error:
        raise AssetError(path, cause=f"damaged ({error})", fix="Fetch or write it again.") from error
    return bytes(data)


def _opened(value: Any) -> Any:
    """What an array of Python objects holds: its one value, or a list of them; one of more axes stays."""
    shape, items = _objects_in(value) or ((0, 0), [])
    return value if len(shape) > 1 else items[0] if shape == () and len(items) == 1 else items


def _objects_in(value: Any) -> tuple[tuple[int, ...], list[Any]] | None:
    """Shape and entries of an array of Python objects; None for anything else."""
    state = value.state if isinstance(value, Record) else None
    if not (isinstance(state, tuple) and len(state) >= 4 and isinstance(state[-1], list)):
        return None
    shape = state[-4]
    sizes = isinstance(shape, tuple) and all(type(size) is int and size >= 0 for size in shape)
    return (shape, state[-1]) if sizes and math.prod(shape) == len(state[-1]) else None
