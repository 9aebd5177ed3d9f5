"""The registry: finds backends, loads each one alone, and keeps a broken one from hurting the others."""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pluggy

from soma_core.errors import InputError
from soma_core.plugin import hookspecs
from soma_core.plugin.declaration import checked_options, checks_problem, did_you_mean, spec_problem
from soma_core.plugin.discovery import CORE_PACKAGE, EntryPointLike, Offer, config_folder, find_offers
from soma_core.plugin.errors import (
    BackendConflictError,
    BackendDisabledError,
    BackendError,
    BackendWarning,
    BrokenBackendError,
    Stage,
    UnknownBackendError,
)
from soma_core.plugin.known import KNOWN_BACKENDS, install_line, publication
from soma_core.plugin.spec import API_VERSION, BackendSpec, Generator

if TYPE_CHECKING:
    import torch

    from soma_core.testing import Check

__all__ = ["OLDEST_API_VERSION", "Entry", "Registry", "State", "default_registry"]

OLDEST_API_VERSION = 1
"""Oldest version of the plugin contract that this core still speaks."""

State = Literal["found", "declared", "built", "blocked", "conflict", "broken"]


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of ``soma backends``: an offer and how far it came in this process."""

    name: str
    distribution: str
    version: str
    state: State
    error: BackendError | None = None


@dataclass
class _Record:
    """What the registry knows of one name; it only ever moves forward."""

    name: str
    offers: tuple[Offer, ...]
    state: State = "found"
    error: BackendError | None = None
    manager: pluggy.PluginManager | None = None
    spec: BackendSpec | None = None
    who: str = field(init=False)

    def __post_init__(self) -> None:
        sources = " and ".join(f"{offer.distribution} {offer.version}".strip() for offer in self.offers)
        self.who = f'backend "{self.name}" ({sources})'


class Registry:
    """All backends that are installed, by name.

    Listing reads package metadata only. A backend is imported when its declaration is asked for,
    and its native model is built when its generator is asked for. Whatever a plugin does wrong
    (SystemExit included) becomes an error that belongs to that backend alone.
    """

    def __init__(
        self, entry_points: Iterable[EntryPointLike] | None = None, *, allowed: Iterable[str] | None = None
    ) -> None:
        """Read the installed entry points, or take `entry_points`.

        `allowed` is the allow-list; by default the comma-separated environment variable
        SOMA_BACKENDS, and everything where that is unset.
        """
        if allowed is None:
            text = os.environ.get("SOMA_BACKENDS", "")
            allowed = [name.strip() for name in text.split(",") if name.strip()]
        self._allowed = frozenset(allowed)
        self._records = {name: _Record(name, offers) for name, offers in find_offers(entry_points).items()}
        for record in self._records.values():
            self._settle(record)

    def names(self) -> tuple[str, ...]:
        """Names that can be asked for: all but the blocked, the conflicting and those that failed."""
        return tuple(
            name
            for name, record in self._records.items()
            if record.spec is not None or record.state == "found"
        )

    def entries(self) -> tuple[Entry, ...]:
        """Every offer with its state, sorted by name; a conflict shows once for each distribution."""
        return tuple(
            Entry(
                name=record.name,
                distribution=offer.distribution,
                version=offer.version,
                state=record.state,
                error=record.error,
            )
            for record in self._records.values()
            for offer in record.offers
        )

    def offers(self, name: str) -> tuple[Offer, ...]:
        """Return who offers backend `name`, without importing a plugin; several where they conflict.

        Raises:
            UnknownBackendError: nobody offers it.
        """
        return self._record(name).offers

    def spec(self, name: str) -> BackendSpec:
        """Return the declaration of backend `name`, importing its plugin on first use.

        Raises:
            BackendError: unknown, blocked or conflicting name, or a plugin that fails to declare.
        """
        record = self._record(name)
        if record.spec is None:
            if record.error is not None:
                raise record.error.with_traceback(None)
            self._declare(record)
        assert record.spec is not None
        return record.spec

    def generator(
        self,
        name: str,
        *,
        device: torch.device,
        dtype: torch.dtype,
        options: Mapping[str, Any] | None = None,
    ) -> Generator:
        """Build the native generator of backend `name`; options are checked against its declaration.

        A failed build is tried again on the next call: the user may have supplied the missing file.

        Raises:
            InputError: an option that the backend does not know or refuses.
            BackendError: the backend is not usable.
        """
        spec = self.spec(name)
        record = self._records[name]
        self._check_files(record, spec)
        assert record.manager is not None
        with _isolated(record, "build"):
            checked = checked_options(spec, options or {})
            generator = record.manager.hook.soma_generator(
                spec=spec, device=device, dtype=dtype, options=checked
            )
            if not callable(getattr(generator, "rest", None)):
                raise _broken(
                    record,
                    "build",
                    f"soma_generator returned {type(generator).__name__} without a rest method",
                )
        record.state, record.error = "built", None
        return generator

    def checks(self, name: str) -> tuple[Check, ...]:
        """Return the further conformance checks that the plugin of backend `name` gives; often none.

        Raises:
            BackendError: the backend is not usable, or what it gives are no checks.
        """
        self.spec(name)
        record = self._records[name]
        assert record.manager is not None
        with _isolated(record, "hooks"):
            found = tuple(check for given in record.manager.hook.soma_checks() for check in given)
            problem = checks_problem(found)
            if problem is not None:
                raise _broken(record, "hooks", problem)
        return found

    def config_dirs(self) -> tuple[tuple[str, Path], ...]:
        """Return (distribution, folder) of each plugin that ships hydra configs, importing none of them."""
        found: dict[Path, str] = {}
        for record in self._records.values():
            offer = record.offers[0]
            if record.state in ("blocked", "conflict") or offer.package == CORE_PACKAGE:
                continue
            folder = config_folder(offer)
            if folder is not None:
                found.setdefault(folder, offer.distribution)
        return tuple((distribution, folder) for folder, distribution in found.items())

    def _settle(self, record: _Record) -> None:
        """Set aside what cannot be used whatever its plugin says."""
        if self._allowed and record.name not in self._allowed:
            record.state = "blocked"
            record.error = BackendDisabledError(
                who=record.who,
                stage="lookup",
                cause=f"SOMA_BACKENDS allows only {', '.join(sorted(self._allowed))}",
                fix=f"Add {record.name} to SOMA_BACKENDS, or unset it",
            )
        elif len(record.offers) > 1:
            record.state = "conflict"
            record.error = BackendConflictError(
                who=record.who,
                stage="lookup",
                cause=f"{len(record.offers)} distributions offer this name, so none of them is loaded",
                fix=f"Keep one: pip uninstall {record.offers[-1].distribution}",
            )

    def _record(self, name: str) -> _Record:
        if name in self._records:
            return self._records[name]
        cause = f"no installed distribution offers it; installed are: {', '.join(self._records) or 'none'}"
        line = install_line(name)
        if line is None:
            fix = did_you_mean(name, [*self._records, *KNOWN_BACKENDS]) or "See: soma backends list"
        else:
            cause, fix = f"{cause} ({publication(name)})", f"Run: {line}"
        raise UnknownBackendError(who=f'backend "{name}"', stage="lookup", cause=cause, fix=fix)

    def _declare(self, record: _Record) -> None:
        """Import the plugin, register its hooks with a manager of its own, and check its declaration."""
        manager = pluggy.PluginManager(hookspecs.PROJECT)
        manager.add_hookspecs(hookspecs)
        with _isolated(record, "import"):
            plugin = record.offers[0].load()
        with _isolated(record, "hooks"):
            manager.register(plugin, name=record.name)
            manager.check_pending()
            for hook in (manager.hook.soma_backend, manager.hook.soma_generator):
                if not hook.get_hookimpls():
                    raise _broken(record, "hooks", f"the plugin does not implement the hook {hook.name}")
        with _isolated(record, "hooks"):
            spec = manager.hook.soma_backend()
        with _isolated(record, "spec"):
            problem = spec_problem(spec, record.name)
            if problem is not None:
                raise _broken(record, "spec", problem)
            _check_api(record, spec)
        record.manager, record.spec, record.state = manager, spec, "declared"

    def _check_files(self, record: _Record, spec: BackendSpec) -> None:
        for needed in spec.files:
            if not needed.path.exists():
                source = f" Get it from {needed.url}" if needed.url else ""
                raise _broken(
                    record,
                    "files",
                    f"{needed.description or 'a file'} is missing at {needed.path}",
                    fix=f"Put the file there.{source}",
                )
        for path in (spec.wrap.native, spec.wrap.wrap) if spec.wrap else ():
            if not path.is_file():
                raise _broken(record, "wrap", f"the wrap pair names {path}, which does not exist")


def _reinstall(record: _Record) -> str:
    distribution = record.offers[0].distribution
    return f"Run: pip install --upgrade {distribution} (SOMA_STRICT=1 shows the whole traceback)"


def _broken(record: _Record, stage: Stage, cause: str, *, fix: str = "") -> BrokenBackendError:
    """Mark `record` as broken at `stage` and return the error that says so."""
    error = BrokenBackendError(
        who=record.who, stage=stage, cause=cause.rstrip(". "), fix=fix or _reinstall(record)
    )
    record.state, record.error = "broken", error
    return error


@contextmanager
def _isolated(record: _Record, stage: Stage) -> Iterator[None]:
    """Turn whatever the plugin raises at `stage` into an error of this backend.

    Ctrl-C stays Ctrl-C, and an InputError while building passes: it is about what the user asked for.
    """
    try:
        yield
    except (KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:
        ours = error is record.error or (stage == "build" and isinstance(error, InputError))
        if ours or os.environ.get("SOMA_STRICT") == "1":
            raise
        raise _broken(record, stage, f"{type(error).__name__}: {error}") from error


def _check_api(record: _Record, spec: BackendSpec) -> None:
    """Accept the contract versions that this core speaks; warn about the older ones."""
    spoken = f"this core speaks {OLDEST_API_VERSION} to {API_VERSION}"
    if spec.api > API_VERSION:
        cause = f"written for plugin api {spec.api}, {spoken}"
        raise _broken(record, "spec", cause, fix="Run: pip install --upgrade soma-body-core")
    if spec.api < OLDEST_API_VERSION:
        raise _broken(record, "spec", f"written for plugin api {spec.api}, {spoken}")
    if spec.api < API_VERSION:
        warnings.warn(
            f"{record.who}: written for plugin api {spec.api}, {spoken}. {_reinstall(record)}",
            BackendWarning,
            stacklevel=5,
        )


def default_registry() -> Registry:
    """Return the registry of this process; it is read once for each value of SOMA_BACKENDS."""
    return _registry_for(os.environ.get("SOMA_BACKENDS", ""))


@functools.cache
def _registry_for(allowed: str) -> Registry:
    return Registry(allowed=[name.strip() for name in allowed.split(",") if name.strip()])
