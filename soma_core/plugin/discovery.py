"""What is installed: backends read from package metadata, without importing any plugin."""

from __future__ import annotations

import contextlib
import importlib.machinery
import importlib.metadata
import importlib.util
import logging
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from soma_core.plugin.hookspecs import ENTRY_POINT_GROUP

__all__ = [
    "CORE_DISTRIBUTION",
    "CORE_PACKAGE",
    "Damaged",
    "EntryPointLike",
    "Offer",
    "config_folder",
    "find_offers",
    "hide_damaged",
    "installed_versions",
    "normalised",
    "read_installed",
]

CORE_DISTRIBUTION, CORE_PACKAGE = "soma-body-core", "soma_core"

_log = logging.getLogger(__name__)


class EntryPointLike(Protocol):
    """The part of ``importlib.metadata.EntryPoint`` that is used; tests bring their own."""

    @property
    def name(self) -> str:
        """Name of the backend."""

    @property
    def value(self) -> str:
        """Module, or module and attribute, that holds the hooks."""

    @property
    def dist(self) -> Any:
        """The distribution, with ``name`` and ``version``, or None."""

    def load(self) -> object:
        """Import and return the plugin."""


@dataclass(frozen=True, kw_only=True)
class Offer:
    """A backend that one installed distribution offers.

    Attributes:
        name: entry-point name, which is the backend's name.
        distribution, version: who offers it.
        target: what the entry point names, ``package.module`` or ``package.module:attribute``.
        load: imports the plugin; nothing is imported before.
    """

    name: str
    distribution: str
    version: str
    target: str
    load: Callable[[], object]

    @property
    def package(self) -> str:
        """Top-level package of the plugin."""
        return re.split(r"[.:]", self.target, maxsplit=1)[0]

    @property
    def source(self) -> str:
        """Who offers it, as messages name it: distribution and version."""
        return f"{self.distribution} {self.version}".strip()

    @property
    def of_core(self) -> bool:
        """Whether the core itself offers it."""
        return self.package == CORE_PACKAGE and normalised(self.distribution) == CORE_DISTRIBUTION


@dataclass(frozen=True, kw_only=True)
class Damaged:
    """An installed distribution whose metadata cannot be read: its name, where it lies, and why not.

    `distribution` is what messages call it, its folder of metadata where its name cannot be read either.
    """

    name: str
    distribution: str
    folder: str
    cause: str


def normalised(distribution: str) -> str:
    """Spelling of a distribution name that pip treats as equal (PEP 503)."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def find_offers(entry_points: Iterable[EntryPointLike] | None = None) -> dict[str, tuple[Offer, ...]]:
    """Group entry points, by default the installed ones, by backend name, sorted by name.

    A distribution seen twice (an editable install beside a stale wheel) counts once: the first on
    ``sys.path`` wins, as it does for imports. More than one offer under a name is a conflict.
    """
    found: dict[tuple[str, str], Offer] = {}
    for point in read_installed()[0] if entry_points is None else entry_points:
        offer = Offer(
            name=point.name, distribution=_told(point.dist, "name") or "unknown distribution",
            version=_told(point.dist, "version"), target=point.value, load=point.load,
        )  # fmt: skip
        found.setdefault((point.name, normalised(offer.distribution)), offer)
    grouped: dict[str, tuple[Offer, ...]] = {}
    for (name, _), offer in sorted(found.items()):
        grouped[name] = (*grouped.get(name, ()), offer)
    return grouped


def _told(distribution: object, field: str) -> str:
    """A field of a distribution's metadata, empty where it is left out: some day a KeyError (Python 3.12)."""
    try:
        return getattr(distribution, field, None) or ""
    except (KeyError, DeprecationWarning):
        return ""


def installed_versions() -> dict[str, str]:
    """Version of each installed distribution, by its name; without those whose metadata cannot be read."""
    found: dict[str, str] = {}
    for distribution in importlib.metadata.distributions():
        with contextlib.suppress(Exception):  # whatever a damaged file makes of the standard library's parser
            if name := _told(distribution, "name"):
                found.setdefault(name, _told(distribution, "version"))
    return found


def read_installed() -> tuple[tuple[EntryPointLike, ...], tuple[Damaged, ...]]:
    """Entry points of our group, and the distributions whose metadata cannot be read; they hurt no other."""
    try:
        return tuple(importlib.metadata.entry_points(group=ENTRY_POINT_GROUP)), ()
    except Exception as error:  # whatever a damaged file makes of the standard library's parser
        _log.debug("reading the distributions one by one: %r", error)
        # PyTorch (2.5 on) when it is imported, and Triton at PyTorch's first operator of our own, look for
        # device backends in the same way, and would die of it:
        # https://docs.pytorch.org/tutorials/unstable/python_extension_autoload.html
        os.environ["TORCH_DEVICE_BACKEND_AUTOLOAD"] = "0"
        os.environ["TRITON_BACKENDS_IN_TREE"] = "1"
    points: dict[str, tuple[EntryPointLike, ...]] = {}
    damaged: list[Damaged] = []
    for number, distribution in enumerate(importlib.metadata.distributions()):
        folder, name = str(distribution.locate_file("")), ""
        try:
            name = _told(distribution, "name")
            found = distribution.entry_points.select(group=ENTRY_POINT_GROUP)
            points.setdefault(normalised(name) or str(number), tuple(found))
        except Exception as error:
            cause = f"{type(error).__name__}: {' '.join(str(error).split())}"
            shown = name or Path(getattr(distribution, "_path", "a distribution")).name
            damaged.append(Damaged(name=name, distribution=shown, folder=folder, cause=cause))
    return tuple(point for several in points.values() for point in several), tuple(damaged)


def hide_damaged() -> None:
    """In a process of our own: let no library come upon metadata that cannot be read.

    Triton, NetworkX, fsspec and others read the entry points of all that is installed, and die of one file.
    """
    if not read_installed()[1]:
        return
    found = importlib.machinery.PathFinder.find_distributions

    def sound(*arguments: Any, **named: Any) -> list[Any]:
        return [each for each in found(*arguments, **named) if _readable(each)]

    importlib.machinery.PathFinder.find_distributions = sound  # type: ignore[method-assign]


def _readable(distribution: importlib.metadata.Distribution) -> bool:
    try:
        return all(each is not None for each in (distribution.metadata, distribution.entry_points))
    except Exception:
        return False


def config_folder(offer: Offer) -> Path | None:
    """Return the ``configs`` folder inside the plugin's package, found without importing it.

    Only the top-level package is looked up, which runs none of its code; wheels and editable
    installs look the same. None where there is no package or no folder.
    """
    try:
        spec = importlib.util.find_spec(offer.package)
    except (ImportError, ValueError, AttributeError):
        return None  # a broken installation shows at the import stage, with its own message
    for location in (spec.submodule_search_locations or ()) if spec else ():
        folder = Path(location) / "configs"
        if folder.is_dir():
            return folder
    return None
