"""Public names of a package that are loaded when they are first used (PEP 562)."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

__all__ = ["lazy_names"]


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
