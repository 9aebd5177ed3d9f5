"""What is installed: backends read from package metadata, without importing any plugin."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import logging
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from soma_core.plugin.hookspecs import ENTRY_POINT_GROUP

__all__ = [
    "CORE_DISTRIBUTION",
    "CORE_PACKAGE",
    "EntryPointLike",
    "Offer",
    "config_folder",
    "find_offers",
    "normalised",
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


def normalised(distribution: str) -> str:
    """Spelling of a distribution name that pip treats as equal (PEP 503)."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def find_offers(entry_points: Iterable[EntryPointLike] | None = None) -> dict[str, tuple[Offer, ...]]:
    """Group the installed entry points by backend name, sorted by name.

    A distribution seen twice (an editable install beside a stale wheel) counts once: the first on
    ``sys.path`` wins, as it does for imports. More than one offer under a name is a conflict.
    """
    found: dict[tuple[str, str], Offer] = {}
    for point in _installed() if entry_points is None else entry_points:
        distribution = getattr(point.dist, "name", None) or "unknown distribution"
        version = getattr(point.dist, "version", None) or ""
        offer = Offer(
            name=point.name, distribution=distribution, version=version, target=point.value, load=point.load
        )
        found.setdefault((point.name, normalised(distribution)), offer)
    grouped: dict[str, tuple[Offer, ...]] = {}
    for (name, _), offer in sorted(found.items()):
        grouped[name] = (*grouped.get(name, ()), offer)
    return grouped


def _installed() -> Iterable[EntryPointLike]:
    """Entry points of our group; where one distribution's metadata is damaged, those of all others."""
    try:
        return importlib.metadata.entry_points(group=ENTRY_POINT_GROUP)
    except Exception as error:  # whatever a damaged file makes of the standard library's parser
        _log.debug("reading the distributions one by one: %r", error)
    points: dict[str, Iterable[EntryPointLike]] = {}
    for distribution in importlib.metadata.distributions():
        try:
            found = distribution.entry_points.select(group=ENTRY_POINT_GROUP)
            points.setdefault(normalised(distribution.name or ""), found)
        except Exception as error:
            where = distribution.locate_file("")
            _log.warning("the metadata of %s in %s is damaged (%r)", distribution.name, where, error)
    return [point for several in points.values() for point in several]


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
