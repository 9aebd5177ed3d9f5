"""The arrays in a pickle of numpy, scipy and chumpy objects, without any of their classes being built.

SMPL and its relatives are handed out as pickles written by Python 2. Their arrays are numpy's, scipy's
sparse matrices, and chumpy's ``Ch`` (an array under ``x``) and ``Select`` (entries of another array).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import AssetError
from soma_core.pickle_machine import Global, Record
from soma_core.safe_pickle import read_pickle
from soma_core.stored_matrix import StoredMatrix

__all__ = ["RecordArrays", "bytes_of", "read_pickled_arrays"]

_PLAIN_DTYPE = re.compile(r"[fiub][1248]")
_DEEPEST = 8
"""Levels of chumpy objects inside each other; the official files have two."""

_MOST_AXES, _LONGEST_AXIS = 8, 2**40
_SMALL, _MOST_EXPANSION = 256 * 2**20, 4


def read_pickled_arrays(path: Path | str, keys: Iterable[str]) -> dict[str, np.ndarray]:
    """Arrays of numbers under those of `keys` that a pickled dictionary holds; sparse ones made dense.

    Values are in native byte order and C order, and not checked any further. What lies under other keys
    is not looked at.

    Raises:
        AssetError: as :func:`~soma_core.safe_pickle.read_pickle`; no dictionary; or a key that holds no
            array of numbers, which the cause names.
    """
    fix = "Get the file from the model's official site."
    content = read_pickle(path)
    if type(content) is not dict:
        raise AssetError(path, cause=f"holds a {type(content).__name__}, not named arrays", fix=fix)
    arrays = RecordArrays(Path(path).stat().st_size)
    try:
        wanted = {key: content[key] for key in keys if key in content}
        return {key: np.ascontiguousarray(array) for key, array in arrays.named(wanted).items()}
    except ValueError as error:
        raise AssetError(path, cause=str(error), fix=fix) from error


class RecordArrays:
    """Arrays of the records of one file, which may unfold to no more than four times its size.

    Each record is made once; two that share their bytes count twice.
    """

    def __init__(self, file_size: int) -> None:
        self._left = max(_SMALL, _MOST_EXPANSION * file_size)
        self._known: dict[int, np.ndarray] = {}

    def named(self, records: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Array of each of the records.

        Raises:
            ValueError: no array of numbers, damaged, or too large; the text begins with the name.
        """
        return {key: self._refusing(value, f"{key}: no sound array ") for key, value in records.items()}

    def array(self, record: Any) -> np.ndarray:
        """Array of numbers that a record of numpy, scipy or chumpy stands for, in native byte order.

        Raises:
            ValueError: no array of numbers, damaged, or too large.
        """
        return self._refusing(record, "no sound array ")

    def dense(self, matrix: StoredMatrix) -> np.ndarray:
        """A sparse matrix with its zeros.

        Raises:
            ValueError: indices that leave it, or too large.
        """
        made = matrix.dense()
        self._spend(made.nbytes)
        return made

    def _refusing(self, record: Any, words: str) -> np.ndarray:
        try:
            return self._array(record, _DEEPEST)
        except ValueError as error:
            raise ValueError(f"{words}({error})") from error
        except (TypeError, KeyError, IndexError, OverflowError, MemoryError) as error:
            raise ValueError(f"{words}({error!r:.80})") from error

    def _array(self, value: Any, depth: int) -> np.ndarray:
        if depth == 0:
            raise ValueError(f"more than {_DEEPEST} objects inside each other")
        if type(value) is not Record:
            raise ValueError(f"a {type(value).__name__}")
        if id(value) not in self._known:
            self._known[id(value)] = self._made(value, depth)
        return self._known[id(value)]

    def _made(self, value: Record, depth: int) -> np.ndarray:
        kind = _class(value)
        if kind.name == "_reconstruct":
            return self._numpy_array(*value.state[-4:])  # type: ignore[index]  # refused where there is none
        if kind.name == "_frombuffer":
            data, dtype, shape, order = value.arguments
            return self._numpy_array(shape, dtype, order == "F", data)
        if kind.name == "scalar":
            dtype, data = value.arguments
            return self._numpy_array((), dtype, False, data)  # noqa: FBT003 - the order of a pickled state
        if kind.name.endswith("_matrix"):
            return self._dense(kind.name[:3], _state(value), depth - 1)
        if kind.name == "Ch":
            return self._array(_state(value)["x"], depth - 1)
        if kind.name == "Select":
            return self._selected(_state(value), depth - 1)
        raise ValueError(f"a {kind}")

    def _spend(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise ValueError("arrays that unfold to far more than the file holds")

    def _numpy_array(self, shape: Any, dtype: Any, fortran: Any, data: Any) -> np.ndarray:
        self._spend(len(data.arguments[0]) if type(data) is Record else len(data))
        kind, content = _dtype(dtype), bytes_of(data)
        sizes = _shape(shape)
        if math.prod(sizes) * kind.itemsize != len(content):
            raise ValueError(f"{len(content)} bytes for the shape {sizes} of {kind}")
        array = np.frombuffer(content, kind).reshape(sizes, order="F" if fortran else "C")
        return array.astype(kind.newbyteorder("="))

    def _selected(self, state: Mapping[Any, Any], depth: int) -> np.ndarray:
        values, index = self._array(state["a"], depth).ravel(), self._array(state["idxs"], depth)
        if index.dtype.kind not in "iu" or (index.size and not 0 <= index.min() <= index.max() < len(values)):
            raise ValueError(f"a selection that leaves its {len(values)} values")
        shape = state.get("preferred_shape")
        self._spend(index.size * values.itemsize)
        selected = values[index]
        return selected if shape is None else selected.reshape(_shape(shape))

    def _dense(self, kind: str, state: Mapping[Any, Any], depth: int) -> np.ndarray:
        shape = _shape(state.get("_shape", state.get("shape")))
        names = ("row", "col") if kind == "coo" else ("indptr", "indices")
        data, first, second = (self._array(state[name], depth) for name in ("data", *names))
        return self.dense(StoredMatrix(layout=kind, indices=(first, second), values=data, shape=shape))


def _class(value: Record) -> Global:
    """What the record is an instance of, or the function that makes it."""
    return value.arguments[0] if value.function.name == "_reconstructor" else value.function


def _state(value: Record) -> Mapping[Any, Any]:
    state = value.state[0] if type(value.state) is tuple else value.state
    if type(state) is not dict:
        raise ValueError(f"a {_class(value)} without its values")
    return state


def _shape(value: Any) -> tuple[int, ...]:
    fits = type(value) is tuple and len(value) <= _MOST_AXES
    if not fits or not all(type(size) is int and 0 <= size <= _LONGEST_AXIS for size in value):
        raise ValueError("a shape that is none")
    return value


def _dtype(value: Any) -> np.dtype:
    if type(value) is not Record or value.function != Global("numpy", "dtype"):
        raise ValueError("no dtype")
    name = value.arguments[0]
    if type(name) is not str or not _PLAIN_DTYPE.fullmatch(name):
        raise ValueError("objects or text, not numbers")
    order = value.state[1] if value.state else "="
    return np.dtype(name).newbyteorder(order if order in ("<", ">", "|") else "=")  # type: ignore[arg-type]


def bytes_of(data: Any) -> bytes | memoryview:
    """Bytes of an array in a pickle, of whatever Python wrote it.

    Raises:
        ValueError: something else.
    """
    if type(data) is Record and data.function == Global("_codecs", "encode"):
        data = data.arguments[0]  # bytes as Python 3 writes them for Python 2: text of Latin-1
    if type(data) is str:
        return data.encode("latin-1")
    if type(data) is not memoryview:
        raise ValueError(f"a {type(data).__name__} of objects, not numbers")
    return data
