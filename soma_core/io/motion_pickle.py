"""Pickles that motions are kept in: plain ones, joblib's with its arrays between, and the tensors in them.

joblib writes a stand-in for each array, then the array's bytes into the stream itself. A tensor of torch in
a pickle holds a small file of its own: five pickles and the numbers. Layouts: joblib 1.6
(``numpy_pickle``) and torch 2 (``serialization``, ``_legacy_save``). Nothing is looked up or called.
"""

from __future__ import annotations

import math
import mmap
import re
import struct
from typing import Any

import numpy as np

from soma_core.io.pickled_arrays import bytes_of
from soma_core.pickle_machine import (
    STORED,
    Global,
    Machine,
    PickleRules,
    Record,
    RefusedPickleError,
    run_machine,
)
from soma_core.safe_pickle import ALLOWED_NAMES

__all__ = ["array_text", "is_tensor", "run_motion_pickle", "tensor_array"]

_WRAPPERS = frozenset(
    Global(f"{package}.numpy_pickle", "NumpyArrayWrapper")
    for package in ("joblib", "sklearn.externals.joblib")
)
_ARRAY = Global("numpy.core.multiarray", "_reconstruct")
_TENSOR = Global("torch._utils", "_rebuild_tensor_v2")
_STORAGE = Global("torch.storage", "_load_from_bytes")
_STORAGES = {
    "Double": "f8", "Float": "f4", "Half": "f2", "Long": "i8", "Int": "i4", "Short": "i2", "Char": "i1",
    "Byte": "u1", "Bool": "?",
}  # fmt: skip

_RULES = PickleRules(
    names=ALLOWED_NAMES
    | _WRAPPERS
    | {_TENSOR, _STORAGE, Global("torch", "Size"), Global("torch", "device")}
    | {Global("collections", name) for name in ("OrderedDict", "defaultdict")}
    | {Global("pathlib", name) for name in ("Path", "PosixPath", "PurePosixPath", "WindowsPath")}
    | {
        Global(module, name)
        for module in ("builtins", "__builtin__")
        for name in ("list", "dict", "int", "float", "bool", "str", "tuple", "slice", "bytearray", "unicode")
    },
    purpose="a motion",
    most_instructions=8_000_000,
)
"""Tracks in 4,000 frames, one by one, take two million instructions."""

_TENSOR_RULES = PickleRules(
    names=frozenset({Global("torch", f"{name}Storage") for name in _STORAGES}),
    purpose="a tensor",
    stored=True,
    most_instructions=10_000,
)
_ITEM = re.compile(r"([a-zA-Z])(\d{1,9})")
_MOST_NESTED, _NESTED_INSTRUCTIONS = 1000, 10_000
_MOST_AXES = 8


def run_motion_pickle(data: mmap.mmap | bytes) -> Any:
    """Contents of a pickle or of a joblib file that is not compressed; arrays and tensors stay records.

    Raises:
        RefusedPickleError: damaged, or with names or instructions that motions do not need.
    """
    return run_machine(_JoblibMachine(data, _RULES))


class _PartMachine(Machine):
    """A pickle that begins at `start` of a file and leaves the rest to others."""

    def __init__(self, file: mmap.mmap | bytes, rules: PickleRules, *, start: int) -> None:
        super().__init__(file, rules)
        self._at = start

    @property
    def end(self) -> int:
        """Where the pickle ended in the file."""
        return self._at


class _JoblibMachine(Machine):
    """A pickle whose arrays may follow their stand-ins in the stream."""

    _nested = 0

    def build(self) -> None:
        """Give a record its state; an array's bytes come right after it."""
        super().build()
        target = self._stack[-1]
        if type(target) is Record and target.function in _WRAPPERS:
            self._read_array(target)

    def _read_array(self, wrapper: Record) -> None:
        """Make of joblib's stand-in the record that numpy would have left in the pickle."""
        layout = wrapper.state
        if type(layout) is not dict:
            raise RefusedPickleError("is no sound pickle: an array without a layout")
        kind, size = item_of(layout["dtype"])
        if kind == "O":
            self._read_objects(wrapper)
            return
        shape = layout["shape"]
        fits = (
            type(shape) is tuple
            and len(shape) <= _MOST_AXES
            and all(type(n) is int and n >= 0 for n in shape)
        )
        if not fits:
            raise RefusedPickleError("is no sound pickle: an array of a shape that is none")
        if layout.get("numpy_array_alignment_bytes") is not None:
            self._take(self._take(1)[0])
        data = self._take(math.prod(shape) * size)
        wrapper.function = _ARRAY
        wrapper.state = (1, shape, layout["dtype"], layout.get("order") == "F", data)

    def _read_objects(self, wrapper: Record) -> None:
        """An array of Python objects is a pickle of its own."""
        self._nested += 1
        if self._nested > _MOST_NESTED:
            raise RefusedPickleError(f"holds more than {_MOST_NESTED} arrays of Python objects")
        rules = self._rules._replace(most_instructions=_NESTED_INSTRUCTIONS)
        inner = _PartMachine(self._file, rules, start=self._at)
        value = inner.run()
        self._at = inner.end
        wrapper.function, wrapper.state = _ARRAY, getattr(value, "state", None)


def item_of(dtype: Any) -> tuple[str, int]:
    """Kind of a pickled dtype, and bytes of an entry.

    Raises:
        RefusedPickleError: it is none.
    """
    name = (
        dtype.arguments[0] if type(dtype) is Record and dtype.function == Global("numpy", "dtype") else None
    )
    found = _ITEM.fullmatch(name) if type(name) is str else None
    if found is None:
        raise RefusedPickleError("is no sound pickle: an array of an unknown type")
    return found[1], int(found[2]) * (4 if found[1] == "U" else 1)


def array_text(record: Record) -> np.ndarray | None:
    """Array of text that a record of numpy stands for; None where it stands for something else.

    Raises:
        ValueError: damaged.
    """
    state = record.state[-4:] if type(record.state) is tuple and len(record.state) >= 4 else None
    if record.function.name == "scalar" and len(record.arguments) == 2:
        state = ((), record.arguments[0], False, record.arguments[1])
    if state is None:
        return None
    dtype = state[1]
    if type(dtype) is not Record or type(dtype.arguments[0]) is not str or dtype.arguments[0][:1] not in "US":
        return None
    kind, size = item_of(dtype)
    data = bytes_of(state[3])
    if not size or len(data) % size:
        raise ValueError("text of a damaged length")
    order = dtype.state[1] if type(dtype.state) is tuple and dtype.state[1] in ("<", ">") else "="
    return np.frombuffer(data, np.dtype(f"{order}{kind}{size // (4 if kind == 'U' else 1)}"))


def is_tensor(record: Record) -> bool:
    """Whether a record stands for a tensor of torch."""
    return record.function == _TENSOR


def tensor_array(record: Record) -> np.ndarray:
    """Array of a tensor that lies in a pickle; at most as many numbers as its storage has.

    Raises:
        ValueError: a storage of another kind, or a tensor that leaves it or repeats it.
    """
    try:
        stored, offset, size, stride = record.arguments[:4]
        numbers = _storage(stored)
        sound = (
            all(type(values) is tuple for values in (size, stride)) and len(size) == len(stride) <= _MOST_AXES
        )
        if not sound or not all(type(n) is int and n >= 0 for n in (offset, *size, *stride)):
            raise ValueError("a tensor without a sound size")
        last = offset + sum((count - 1) * step for count, step in zip(size, stride, strict=True))
        if not math.prod(size):
            return np.empty(size, numbers.dtype)
        if last >= len(numbers) or math.prod(size) > len(numbers):
            raise ValueError(f"a tensor of shape {size} in a storage of {len(numbers)} numbers")
        strides = tuple(step * numbers.itemsize for step in stride)
        return np.lib.stride_tricks.as_strided(numbers[offset:], size, strides, writeable=False)
    except (TypeError, KeyError, IndexError) as error:
        raise ValueError(f"no sound tensor ({error!r:.80})") from error


def _storage(stored: Any) -> np.ndarray:
    """Numbers of a storage as torch wrote them into bytes: magic, version, system, storage, keys, numbers."""
    if type(stored) is not Record or stored.function != _STORAGE:
        raise ValueError("a tensor without its storage")
    data, at, parts = bytes(stored.arguments[0]), 0, []
    for _ in range(5):
        machine = _PartMachine(data, _TENSOR_RULES, start=at)
        parts.append(run_machine(machine))
        at = machine.end
    reference = parts[3]
    if type(reference) is not Record or reference.function != STORED:
        raise ValueError("a tensor without its storage")
    kind = reference.arguments[0][1].name.removesuffix("Storage")
    if kind not in _STORAGES:
        raise ValueError(f"a tensor of {kind}, which is not read here")
    count = struct.unpack_from("<q", data, at)[0]
    numbers = np.frombuffer(data, f"<{_STORAGES[kind]}" if kind != "Bool" else "?", offset=at + 8)
    if count != len(numbers):
        raise ValueError(f"a storage of {count} numbers that holds {len(numbers)}")
    return numbers
