"""Options of a backend: what the caller gave, checked by type against the plugin's own dataclass."""

from __future__ import annotations

import dataclasses
import enum
import types
import typing
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

from soma_core.errors import InputError
from soma_core.plugin.declaration import did_you_mean
from soma_core.plugin.spec import BackendSpec

__all__ = ["OptionRow", "checked_options", "option_rows", "options_by_name"]


@dataclass(frozen=True, kw_only=True)
class OptionRow:
    """One option as listings show it: name, type, and default as Python writes it; None: it must be given."""

    name: str
    type: str
    default: str | None


def option_rows(options: type | None) -> tuple[OptionRow, ...]:
    """Return the options that a dataclass declares, in its order."""
    hints = get_type_hints(options) if options else {}
    return tuple(
        OptionRow(name=field.name, type=_type_text(hints[field.name]), default=_default_text(field))
        for field in _fields(options)
    )


def checked_options(spec: BackendSpec, options: Mapping[str, Any]) -> Any:
    """Return the options as an instance of ``spec.options``, defaults filled in; None where there are none.

    Values are checked against the annotations of the dataclass: plain classes, ``None``, unions, ``Literal``,
    enums, paths, lists, tuples, dictionaries and nested dataclasses. An integer is taken for a float, a text
    for a path, a name for the member of an enum; any other annotation accepts everything. The dataclass may
    refuse more in its ``__post_init__``, by InputError, ValueError or TypeError.

    Raises:
        InputError: an option that is unknown or missing, or a value that the dataclass does not take.
    """
    if spec.options is None and options:
        key, value = next(iter(options.items()))
        raise InputError(
            f"backend.options.{key}",
            got=repr(value),
            expected=f"nothing: backend {spec.name!r} has no options",
            fix="Leave it out",
        )
    if spec.options is None:
        return None
    return _Value("backend.options", f"See: soma backends show {spec.name}").instance(options, spec.options)


def options_by_name(options: Any) -> dict[str, Any]:
    """Fields of what :func:`checked_options` returned, as plugins of api 1 get them."""
    return {field.name: getattr(options, field.name) for field in _fields(type(options))} if options else {}


def _fields(options: type | None) -> list[dataclasses.Field[Any]]:
    return [field for field in dataclasses.fields(options) if field.init] if options else []


def _default_text(field: dataclasses.Field[Any]) -> str | None:
    if field.default is not MISSING:
        return repr(field.default)
    return None if field.default_factory is MISSING else repr(field.default_factory())


def _type_text(hint: Any) -> str:
    """Spell an annotation as an author would: ``float``, ``str | None``, ``one of 'a', 'b'``."""
    if hint is type(None):
        return "None"
    if get_origin(hint) is Annotated:
        return _type_text(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        return " | ".join(map(_type_text, get_args(hint)))
    if get_origin(hint) is Literal:
        return f"one of {', '.join(map(repr, get_args(hint)))}"
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return f"one of {', '.join(hint.__members__)}"
    if isinstance(hint, type) and not get_args(hint):
        return hint.__name__
    return str(hint).replace("typing.", "").replace("collections.abc.", "")


@dataclass(frozen=True)
class _Value:
    """The place of one value: its full key, and what to do where the value is refused."""

    key: str
    fix: str

    def inside(self, suffix: str) -> _Value:
        return _Value(self.key + suffix, self.fix)

    def refuse(self, value: Any, hint: Any) -> NoReturn:
        got = f"{value!r} ({type(value).__name__})"
        raise InputError(self.key, got=got, expected=_type_text(hint), fix=self.fix)

    def convert(self, value: Any, hint: Any) -> Any:
        """Return `value` in the type that the annotation `hint` names."""
        origin, arguments = get_origin(hint), get_args(hint)
        if origin is Annotated:
            return self.convert(value, arguments[0])
        if origin in (Union, types.UnionType):
            return self.one_of(value, hint)
        if origin is Literal:
            fits = any(value == each and type(value) is type(each) for each in arguments)
            return value if fits else self.refuse(value, hint)
        if origin in (dict, typing.get_origin(Mapping[str, int])):
            return self.mapping(value, hint)
        if origin in (list, tuple, typing.get_origin(Sequence[int])):
            return self.sequence(value, hint)
        known = isinstance(hint, type) and hint is not Any  # Any is a class from Python 3.11 on
        return self.plain(value, hint) if known else value

    def one_of(self, value: Any, hint: Any) -> Any:
        for member in sorted(get_args(hint), key=lambda each: type(value) is not each):  # the very type first
            with suppress(InputError):
                return self.convert(value, member)
        return self.refuse(value, hint)

    def mapping(self, value: Any, hint: Any) -> dict[Any, Any]:
        if not isinstance(value, Mapping):
            self.refuse(value, hint)
        item = get_args(hint)[1]
        return {key: self.inside(f".{key}").convert(each, item) for key, each in value.items()}

    def sequence(self, value: Any, hint: Any) -> Any:
        origin, items = get_origin(hint), get_args(hint)
        if isinstance(value, str) or not isinstance(value, Sequence):
            self.refuse(value, hint)
        if origin is not tuple or items[-1] is ...:
            items = items[:1] * len(value)
        if len(items) != len(value):
            self.refuse(value, hint)
        pairs = enumerate(zip(value, items, strict=True))
        converted = [self.inside(f"[{index}]").convert(each, item) for index, (each, item) in pairs]
        return tuple(converted) if origin is tuple else converted

    def plain(self, value: Any, hint: type) -> Any:
        if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
            return self.instance(value, hint)
        if isinstance(value, str) and issubclass(hint, enum.Enum) and value in hint.__members__:
            return hint[value]
        if hint is Path and isinstance(value, str):
            return Path(value)
        if isinstance(value, bool) and hint in (int, float):  # Python counts True as the integer 1
            self.refuse(value, hint)
        if isinstance(value, int) and hint is float:
            return float(value)
        return value if isinstance(value, hint) else self.refuse(value, hint)

    def instance(self, values: Mapping[str, Any], kind: type) -> Any:
        """Build the dataclass `kind` from `values`, each checked against its field."""
        hints, fields = get_type_hints(kind), {field.name: field for field in _fields(kind)}
        for name, value in values.items():
            if name not in fields:
                expected = f"one of the options {', '.join(fields)}"
                fix = did_you_mean(name, fields) or self.fix
                raise InputError(f"{self.key}.{name}", got=repr(value), expected=expected, fix=fix)
        for name, field in fields.items():
            if name not in values and _default_text(field) is None:
                key = f"{self.key}.{name}"
                raise InputError(key, got="nothing", expected=_type_text(hints[name]), fix=f"Give {key}")
        given = {name: self.inside(f".{name}").convert(value, hints[name]) for name, value in values.items()}
        try:
            return kind(**given)
        except InputError:
            raise
        except (TypeError, ValueError) as error:
            expected = f"what {kind.__name__} takes ({error})"
            raise InputError(self.key, got=repr(dict(values)), expected=expected, fix=self.fix) from error
