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
import scipy.sparse

from soma_core.errors import AssetError
from soma_core.io.safe_pickle import Global, Record, read_pickle

__all__ = ["read_pickled_arrays"]

_PLAIN_DTYPE = re.compile(r"[fiub][1248]")
_DEEPEST = 8
"""Levels of chumpy objects inside each other; the official files have two."""

_MOST_AXES, _LONGEST_AXIS = 8, 2**40
_MOST_DENSE = 2**24
"""Entries of a sparse matrix made dense; the largest regressor has 0.6 million."""


def read_pickled_arrays(path: Path | str, keys: Iterable[str]) -> dict[str, np.ndarray]:
    """Arrays of numbers under those of `keys` that a pickled dictionary holds; sparse ones made dense.

    Values are in native byte order and C order, and not checked any further. What lies under other keys
    is not looked at.

    Raises:
        AssetError: as :func:`~soma_core.io.safe_pickle.read_pickle`; no dictionary; or a key that holds no
            array of numbers, which the cause names.
    """
    fix = "Get the file from the model's official site."
    content = read_pickle(path)
    if type(content) is not dict:
        raise AssetError(path, cause=f"holds a {type(content).__name__}, not named arrays", fix=fix)
    found = {}
    for key in keys:
        if key not in content:
            continue
        try:
            found[key] = np.ascontiguousarray(_array(content[key], _DEEPEST))
        except (ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError) as error:
            raise AssetError(path, cause=f"{key}: {_reason(error)}", fix=fix) from error
    return found


def _reason(error: Exception) -> str:
    return f"no sound array ({error})" if type(error) is ValueError else f"no sound array ({error!r:.80})"


def _array(value: Any, depth: int) -> np.ndarray:
    if depth == 0:
        raise ValueError(f"more than {_DEEPEST} objects inside each other")
    if type(value) is not Record:
        raise ValueError(f"a {type(value).__name__}")
    kind = _class(value)
    if kind.name == "_reconstruct":
        return _numpy_array(*value.state[-4:])  # type: ignore[index]  # refused where there is none
    if kind.name == "_frombuffer":
        data, dtype, shape, order = value.arguments
        return _numpy_array(shape, dtype, order == "F", data)
    if kind.name == "scalar":
        dtype, data = value.arguments
        return _numpy_array((), dtype, False, data)  # noqa: FBT003 - the order of a pickled state
    if kind.name.endswith("_matrix"):
        return _dense(kind.name[:3], _state(value), depth - 1)
    if kind.name == "Ch":
        return _array(_state(value)["x"], depth - 1)
    if kind.name == "Select":
        return _selected(_state(value), depth - 1)
    raise ValueError(f"a {kind}")


def _class(value: Record) -> Global:
    """What the record is an instance of, or the function that makes it."""
    return value.arguments[0] if value.function.name == "_reconstructor" else value.function


def _state(value: Record) -> Mapping[Any, Any]:
    state = value.state[0] if type(value.state) is tuple else value.state
    if type(state) is not dict:
        raise ValueError(f"a {_class(value)} without its values")
    return state


def _numpy_array(shape: Any, dtype: Any, fortran: Any, data: Any) -> np.ndarray:
    kind, content = _dtype(dtype), _buffer(data)
    sizes = _shape(shape)
    if math.prod(sizes) * kind.itemsize != len(content):
        raise ValueError(f"{len(content)} bytes for the shape {sizes} of {kind}")
    array = np.frombuffer(content, kind).reshape(sizes, order="F" if fortran else "C")
    return array.astype(kind.newbyteorder("="))


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


def _buffer(data: Any) -> bytes | memoryview:
    if type(data) is Record and data.function == Global("_codecs", "encode"):
        data = data.arguments[0]  # bytes as Python 3 writes them for Python 2: text of Latin-1
    if type(data) is str:
        return data.encode("latin-1")
    if type(data) is not memoryview:
        raise ValueError(f"a {type(data).__name__} of objects, not numbers")
    return data


def _selected(state: Mapping[Any, Any], depth: int) -> np.ndarray:
    values, index = _array(state["a"], depth).ravel(), _array(state["idxs"], depth)
    if index.dtype.kind not in "iu" or (index.size and not 0 <= index.min() <= index.max() < len(values)):
        raise ValueError(f"a selection that leaves its {len(values)} values")
    shape = state.get("preferred_shape")
    selected = values[index]
    return selected if shape is None else selected.reshape(_shape(shape))


def _dense(kind: str, state: Mapping[Any, Any], depth: int) -> np.ndarray:
    rows, columns = _shape(state.get("_shape", state.get("shape")))
    if rows * columns > _MOST_DENSE:
        raise ValueError(f"a sparse matrix of {rows} x {columns}")
    names = ("row", "col") if kind == "coo" else ("indices", "indptr")
    data, first, second = (_array(state[name], depth) for name in ("data", *names))
    if first.dtype.kind not in "iu" or second.dtype.kind not in "iu":
        raise ValueError("a sparse matrix whose indices are no integers")
    if kind == "coo":
        return scipy.sparse.coo_matrix((data, (first, second)), shape=(rows, columns)).toarray()
    make = scipy.sparse.csc_matrix if kind == "csc" else scipy.sparse.csr_matrix
    matrix = make((data, first.astype(np.int64), second.astype(np.int64)), shape=(rows, columns))
    matrix.check_format(full_check=True)
    return matrix.toarray()
