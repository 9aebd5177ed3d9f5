"""Texts of a command line: paths, names and captions reach a setting as the shell delivers them."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from hydra.core.override_parser.types import Quote, QuotedString

from soma_core.errors import SomaError
from soma_core.paths import expanded
from soma_core.plugin.registry import default_registry

__all__ = ["literal_texts"]

_OVERRIDE = re.compile(r"(?P<key>(?:\+\+?)?[A-Za-z_][\w.-]*)=(?P<value>.+)", re.DOTALL)
_OPTION = "backend.options."
_OF_HYDRA = {"hydra.run.dir": str, "hydra.sweep.dir": str, "hydra.sweep.subdir": str}
"""Folders that hydra's own schema declares; any of a task's settings is found by its type."""

_FUNCTION = re.compile(r"(choice|glob|interval|range|shuffle|sort|tag)\(.*\)", re.DOTALL)
_MULTIRUN = ("--multirun", "-m")


def literal_texts(overrides: Sequence[str], schema: type) -> list[str]:
    """Quote the values of settings that are texts, so that hydra takes them literally, and a list of one.

    To hydra's grammar brackets, commas, quotes, blanks, ``=``, ``#``, ``$`` and letters beyond ASCII mean
    something else, or nothing; file names hold them all. Left to hydra are ``null``, a value in quotes,
    ``${...}`` of a setting or a resolver, and with ``--multirun`` sweeps: commas then part values, and so do
    hydra's functions. A file or folder of that very name comes before each of these. Where a list is wanted,
    ``write=npz`` is ``write=[npz]``.

    Args:
        overrides: of the command line, flags among them.
        schema: dataclass of the task's configuration; its annotations tell which settings are texts.
    """
    chosen = next((each.partition("=")[2] for each in overrides if each.startswith("backend=")), "soma")
    kinds = {**dict(_texts(schema)), **_OF_HYDRA, **_option_texts(chosen)}
    names = "|".join(re.escape(field.name) for field in dataclasses.fields(schema))
    resolved = re.compile(rf"\$\{{(?:now:|hydra[:.]|oc\.|(?:{names})[.}}])")
    sweeps = any(flag in overrides for flag in _MULTIRUN)
    return [_Line(resolved, sweeps).literal(each, kinds) for each in overrides]


@dataclasses.dataclass(frozen=True)
class _Line:
    """What is left to hydra in the values of one command line."""

    resolved: re.Pattern[str]
    sweeps: bool

    def literal(self, override: str, kinds: dict[str, type]) -> str:
        found = _OVERRIDE.fullmatch(override)
        kind = kinds.get(found["key"].lstrip("+")) if found else None
        if found is None or kind is None or found["value"].lower() == "null":
            return override
        key, value = found["key"], found["value"]
        listed = value.startswith("[") and value.endswith("]")
        if kind is tuple:
            alone = not listed and not self.sweeps and not self.resolved.search(value)
            return f"{key}=[{value}]" if alone else override
        if kind is list:
            return f"{key}=[{self.parts(value[1:-1]) if listed else self.quoted(value)}]"
        if not self.sweeps or _exists(value):
            return f"{key}={self.quoted(value)}"
        return override if _FUNCTION.fullmatch(value) else f"{key}={self.parts(value)}"

    def parts(self, value: str) -> str:
        """Several texts; a blank beside a comma belongs to one only where a file is called so."""
        parts = (part if _exists(part) else part.strip() for part in _split(value))
        return ",".join(map(self.quoted, parts))

    def quoted(self, value: str) -> str:
        exists = _exists(value)
        if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"" and not exists:
            return value
        if exists or not self.resolved.search(value):  # OmegaConf would look for a setting of that name
            value = value.replace("${", r"\${")
        return str(QuotedString(text=value, quote=Quote.single).with_quotes())


def _exists(value: str) -> bool:
    return os.path.lexists(expanded(value))


def _split(value: str) -> Iterator[str]:
    """Parts between commas; those inside a pair of quotes part nothing."""
    start, opened = 0, ""
    for place, letter in enumerate(value):
        if letter == opened:
            opened = ""
        elif letter in "'\"" and not opened and not value[start:place].strip():
            opened = letter
        elif letter == "," and not opened:
            yield value[start:place]
            start = place + 1
    if value[start:]:
        yield value[start:]


def _texts(schema: type, prefix: str = "") -> Iterator[tuple[str, type]]:
    """Full key of each text and each list: str, list of texts, or tuple for a list of numbers or choices."""
    hints = get_type_hints(schema)
    for field in dataclasses.fields(schema):
        hint, key = hints[field.name], prefix + field.name
        for kind in get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,):
            if kind in (str, Path):
                yield key, str
            elif get_origin(kind) is list:
                yield key, list if get_args(kind)[0] in (str, Path) else tuple
            elif isinstance(kind, type) and dataclasses.is_dataclass(kind):
                yield from _texts(kind, f"{key}.")


def _option_texts(backend: str) -> dict[str, Any]:
    """Options of the chosen backend that are texts; what is wrong with the backend is said later."""
    with suppress(SomaError):
        options = default_registry().spec(backend).options
        return dict(_texts(options, _OPTION)) if options else {}
    return {}
