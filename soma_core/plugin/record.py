"""What the registry knows of one backend; whatever its plugin does becomes an error of that backend alone."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from soma_core.errors import InputError
from soma_core.paths import expanded
from soma_core.plugin.causes import cause_and_fix, remedy
from soma_core.plugin.discovery import CORE_DISTRIBUTION, Damaged, Offer
from soma_core.plugin.errors import (
    BackendConflictError,
    BackendDisabledError,
    BackendError,
    BrokenBackendError,
    PluginError,
    Stage,
)
from soma_core.plugin.installation import reinstall_command
from soma_core.plugin.spec import BackendSpec

__all__ = [
    "Entry",
    "Record",
    "State",
    "damaged_entry",
    "isolated",
    "option_in_error",
    "refuse_rival",
    "settle",
]

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
class Record:
    """What the registry knows of one name; it only ever moves forward."""

    name: str
    offers: tuple[Offer, ...]
    state: State = "found"
    error: BackendError | None = None
    manager: Any = None
    spec: BackendSpec | None = None
    who: str = field(init=False)

    def __post_init__(self) -> None:
        self.who = f'backend "{self.name}" ({" and ".join(offer.source for offer in self.offers)})'

    @property
    def entries(self) -> tuple[Entry, ...]:
        """One for each offer."""
        return tuple(
            Entry(
                name=self.name,
                distribution=offer.distribution,
                version=offer.version,
                state=self.state,
                error=self.error,
            )
            for offer in self.offers
        )


def settle(record: Record, allowed: Collection[str]) -> None:
    """Set aside what cannot be used whatever its plugin says; `allowed` is empty where everything is."""
    if allowed and record.name not in allowed:
        record.state = "blocked"
        record.error = BackendDisabledError(
            who=record.who,
            stage="lookup",
            cause=f"SOMA_BACKENDS allows only {', '.join(sorted(allowed))}",
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


def damaged_entry(damaged: Damaged) -> Entry:
    """The row of a distribution whose metadata cannot be read: it may offer a backend, or nothing of ours."""
    again = reinstall_command(damaged.name).replace("--upgrade", "--force-reinstall") if damaged.name else ""
    error = BrokenBackendError(
        who=f"{damaged.distribution} in {damaged.folder}",
        stage="lookup",
        cause=f"its metadata is damaged ({damaged.cause})",
        fix=f"{again or 'Install its package again'}, or remove it",
    )
    return Entry(name="-", distribution=damaged.distribution, version="", state="broken", error=error)


def refuse_rival(record: Record) -> None:
    """Refuse a distribution that offers a backend under a name of the core's own; the core's goes on."""
    record.state = "conflict"
    record.error = BackendConflictError(
        who=record.who,
        stage="lookup",
        cause=f"{CORE_DISTRIBUTION} itself offers this name, so this one is not loaded",
        fix=f"Run: pip uninstall {record.offers[0].distribution}",
    )


@contextmanager
def isolated(record: Record, stage: Stage) -> Iterator[None]:
    """Turn whatever is raised at `stage` into the error of this record; see ``Registry.isolated``."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        if error is record.error:
            raise
        about_the_call = isinstance(error, InputError) and stage in ("build", "rest")
        own_words = isinstance(error, PluginError)
        if about_the_call or (os.environ.get("SOMA_STRICT") == "1" and not own_words):
            raise
        cause, fix = cause_and_fix(error, record.offers[0])
        if stage != "files":  # a plugin is not to blame for what its user has yet to supply
            record.state = "broken"
        record.error = BrokenBackendError(
            who=record.who,
            stage=stage,
            cause=cause.rstrip(". "),
            fix=fix or remedy(record.name, record.offers[0].distribution, stage),
        )
        raise record.error from (None if own_words else error)


@contextmanager
def option_in_error(options: Mapping[str, Any]) -> Iterator[None]:
    """Refuse the option that names a file, where a plugin fails at that very file: the user named it.

    Raises:
        InputError: the option, and what is wrong with its file.
    """
    try:
        yield
    except Exception as error:
        place = getattr(error, "filename", None) or getattr(error, "path", None)
        if isinstance(error, InputError) or not isinstance(place, str | os.PathLike):
            raise
        for name, value in options.items():
            if isinstance(value, str | Path) and str(value) and _same(place, value):
                why = getattr(error, "strerror", None) or getattr(error, "cause", type(error).__name__)
                raise InputError(
                    f"backend.options.{name}", got=f"{value} ({why})", expected="a file that it can read",
                    fix="Correct the path.",
                ) from error  # fmt: skip
        raise


def _same(place: str | os.PathLike[str], value: str | Path) -> bool:
    return os.path.abspath(place) in (os.path.abspath(value), os.path.abspath(expanded(value)))
