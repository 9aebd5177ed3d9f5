"""Write pickles as Python 2, numpy, scipy and chumpy of their time wrote them, none of them installed."""

from __future__ import annotations

import io
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

__all__ = ["Instance", "ch", "csc", "select", "write_pickle"]


class Instance:
    """An object of the class ``module.name`` with this state; the class need not exist."""

    def __init__(self, module: str, name: str, state: dict[str, Any]) -> None:
        self.module, self.name, self.state = module, name, state


def ch(array: np.ndarray) -> Instance:
    """An array in chumpy's basic class, with what such an object carries along."""
    return Instance(
        "chumpy.ch",
        "Ch",
        {"x": array, "_status": "new", "_dirty_vars": set(), "_itr": None, "_make_dense": 0},
    )


def select(array: np.ndarray) -> Instance:
    """An array as chumpy's selection of the leading entries of a longer one."""
    longer = np.concatenate([array.ravel(), np.full(3, np.nan)])
    state = {"a": ch(longer), "idxs": np.arange(array.size), "preferred_shape": array.shape}
    return Instance("chumpy.reordering", "Select", state | {"_dirty_vars": set()})


def csc(matrix: np.ndarray, *, module: str = "scipy.sparse.csc") -> Instance:
    """A sparse matrix of scipy."""
    made = scipy.sparse.csc_matrix(matrix)
    state = {
        "_shape": made.shape, "data": made.data, "indices": made.indices, "indptr": made.indptr,
        "format": "csc", "maxprint": 50,
    }  # fmt: skip
    return Instance(module, "csc_matrix", state)


class _Pickler(pickle._Pickler):
    """Python's own pickler, which also writes instances of classes that are not there."""

    dispatch = dict(pickle._Pickler.dispatch)  # noqa: RUF012

    def __init__(self, stream: io.BytesIO, protocol: int, *, python_2: bool) -> None:
        super().__init__(stream, protocol)
        self._python_2 = python_2 and protocol <= 2
        self._cores = python_2 or protocol <= 2

    def _name(self, module: str, name: str) -> None:
        if self.proto >= 4:
            self.save(module)
            self.save(name)
            self.write(pickle.STACK_GLOBAL)
        else:
            self.write(pickle.GLOBAL + f"{module}\n{name}\n".encode())

    def save_instance(self, value: Instance) -> None:
        if self.proto >= 2:
            self._name(value.module, value.name)
            self.write(pickle.EMPTY_TUPLE + pickle.NEWOBJ)
        else:
            self._name("copy_reg", "_reconstructor")
            self.write(pickle.MARK)
            self._name(value.module, value.name)
            self._name("__builtin__", "object")
            self.write(pickle.NONE + pickle.TUPLE + pickle.REDUCE)
        self.memoize(value)
        self.save(value.state)
        self.write(pickle.BUILD)

    dispatch[Instance] = save_instance

    def save_global(self, value: Any, name: str | None = None) -> None:
        module = getattr(value, "__module__", "") or ""
        if self._cores and module.startswith("numpy._core"):
            self._name(module.replace("numpy._core", "numpy.core"), value.__name__)
            self.memoize(value)
        else:
            super().save_global(value, name)

    def save_bytes(self, value: bytes) -> None:
        if not self._python_2:
            super().save_bytes(value)
        elif self.bin:
            self.write(pickle.BINSTRING + struct.pack("<i", len(value)) + value)
        else:
            self.write(pickle.STRING + repr(value)[1:].encode() + b"\n")

    dispatch[bytes] = save_bytes

    def save_str(self, value: str) -> None:
        if self._python_2:
            self.save_bytes(value.encode("latin-1"))
        else:
            super().save_str(value)

    dispatch[str] = save_str
    dispatch[type(ch)] = save_global


def write_pickle(path: Path, content: Any, *, protocol: int = 2, python_2: bool = True) -> Path:
    """Pickle `content`, by default as Python 2 does, whose strings are bytes."""
    stream = io.BytesIO()
    _Pickler(stream, protocol, python_2=python_2).dump(content)
    path.write_bytes(stream.getvalue())
    return path
