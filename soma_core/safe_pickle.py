"""Read a pickle as plain data: no class is looked up, no function is called.

The program of a pickle is run by :mod:`soma_core.pickle_machine`, which knows no instruction that calls;
:mod:`soma_core.io.pickled_arrays` and :mod:`soma_core.tensor_archive` make arrays of the records that it
leaves.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable
from soma_core.pickle_machine import Global, PickleRules, Record, RefusedPickleError, run_pickle

__all__ = ["ALLOWED_NAMES", "plain_values", "read_pickle"]

MOST_BYTES = 600 * 2**20

_DEEPEST, _MOST_VALUES = 64, 2_000_000

_CORES = ("numpy.core", "numpy._core")
_SPARSE = ("csc", "csr", "coo")
ALLOWED_NAMES = frozenset(
    {
        Global("chumpy.ch", "Ch"),
        Global("chumpy.reordering", "Select"),
        Global("numpy", "ndarray"),
        Global("numpy", "dtype"),
        *(Global(f"{core}.multiarray", name) for core in _CORES for name in ("_reconstruct", "scalar")),
        *(Global(f"{core}.numeric", "_frombuffer") for core in _CORES),
        *(
            Global(f"scipy.sparse.{module}", f"{kind}_matrix")
            for kind in _SPARSE
            for module in (kind, f"_{kind}")
        ),
        *(Global(module, name) for module in ("builtins", "__builtin__") for name in ("set", "object")),
        Global("copyreg", "_reconstructor"),
        Global("copy_reg", "_reconstructor"),
        Global("_codecs", "encode"),
    }
)
"""All that a body model's file may name; everything else ends the reading."""


_BODY_MODEL = PickleRules(ALLOWED_NAMES, "a body model")


def read_pickle(path: Path | str, rules: PickleRules = _BODY_MODEL) -> Any:
    """Contents of a pickle, as :func:`~soma_core.pickle_machine.run_pickle` gives them.

    Raises:
        AssetError: missing, a git-LFS pointer, truncated, too large, or a pickle that names what is not
            in the rules or has instructions that data do not need.
    """
    refuse_unreadable(path, fix="Check the path.", most_bytes=MOST_BYTES)
    with open(path, "rb") as stream:
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    try:
        return run_pickle(data, rules)
    except RefusedPickleError as error:
        fix = "Nothing of it was run. Get the file from the model's official site."
        raise AssetError(path, cause=str(error), fix=fix) from error


def plain_values(content: Any, made: Callable[[Record], Any]) -> Any:
    """Contents of a pickle with every record replaced by what `made` makes of it, in new containers.

    A container that the pickle holds at many places is copied to each, up to two million values; long
    bytes stay a memoryview of the file.

    Raises:
        ValueError: deeper than 64 levels, more values, the name of a class as a value, or what `made` says;
            the text begins with the keys that lead there.
    """
    count = 0

    def copied(value: Any, way: tuple[str, ...]) -> Any:
        nonlocal count
        count += 1
        if len(way) > _DEEPEST or count > _MOST_VALUES:
            raise ValueError(f"more than {_DEEPEST} levels or {_MOST_VALUES} values")
        if isinstance(value, dict):
            return {key: copied(item, (*way, str(key))) for key, item in value.items()}
        if type(value) in (list, tuple):
            return type(value)(copied(item, (*way, "")) for item in value)
        if type(value) is Record:
            return _named(made, value, way)
        if type(value) is Global:
            return _named(_refuse_class, value, way)
        return value

    return copied(content, ())


def _refuse_class(name: Global) -> None:
    raise ValueError(f"the class {name} where a value was expected")


def _named(make: Callable[[Any], Any], value: Any, way: tuple[str, ...]) -> Any:
    try:
        return make(value)
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError) as error:
        place = ".".join(name[:40] for name in way[:8] if name) or "content"
        reason = str(error) if type(error) is ValueError else f"no sound values ({error!r:.80})"
        raise ValueError(f"{place}: {reason}") from error
