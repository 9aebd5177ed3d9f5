"""Public names of a package that are loaded when they are first used (PEP 562)."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from soma_core.errors import InputError

__all__ = ["lazy_names", "needed"]


def lazy_names(
    package: str, homes: Mapping[str, Iterable[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of `package`, whose names live in other modules.

    Args:
        package: its name; its ``__all__`` is what it says that it offers.
        homes: modules, and the names that are taken from each.
    """
    home = {name: module for module, names in homes.items() for name in names}
    here = sys.modules[package]

    def load(name: str) -> Any:
        if name not in home:
            offers = ", ".join(here.__all__)
            raise AttributeError(f"module {package!r} has no attribute {name!r}; it offers {offers}")
        value = getattr(importlib.import_module(home[name]), name)
        setattr(here, name, value)
        return value

    return load, lambda: sorted({*vars(here), *here.__all__})


def needed(package: str, *parts: str, setting: object, pip: str, otherwise: str = "") -> Any:
    """A package that is not always installed, with those of its modules that are named.

    Args:
        package: its name.
        parts: modules below it, ``data`` of ``ray``.
        setting: what asked for it.
        pip: what to install: an extra of ours in brackets, ``[ray]``, or a package.
        otherwise: what to do instead, after a semicolon.

    Raises:
        InputError: it is not installed.
    """
    try:
        for name in parts:
            importlib.import_module(f"{package}.{name}")
        return importlib.import_module(package)
    except ImportError as error:
        wheel = f"'soma-body-core{pip}'" if pip.startswith("[") else pip
        fix = f"Run: pip install {wheel}{otherwise and '; or '}{otherwise}."
        raise InputError(
            str(setting), got=f"no {package}", expected=f"{package} installed", fix=fix
        ) from error
