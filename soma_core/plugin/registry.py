"""The registry: finds backends, loads each one alone, and keeps a broken one from hurting the others."""

from __future__ import annotations

import functools
import os
import shlex
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from soma_core._version import __version__
from soma_core.errors import InputError
from soma_core.plugin.causes import cause_and_fix, remedy, supply
from soma_core.plugin.checks import Check
from soma_core.plugin.configs import PluginConfigs, find_configs
from soma_core.plugin.declaration import checks_problem, did_you_mean, spec_problem
from soma_core.plugin.discovery import CORE_DISTRIBUTION, EntryPointLike, Offer, find_offers
from soma_core.plugin.errors import (
    BackendConflictError,
    BackendDisabledError,
    BackendError,
    BackendWarning,
    BrokenBackendError,
    PluginError,
    Stage,
    UnknownBackendError,
)
from soma_core.plugin.hooks import hook_manager
from soma_core.plugin.installation import core_requirement, reinstall_command
from soma_core.plugin.known import KNOWN_BACKENDS, install_line, publication
from soma_core.plugin.options import checked_options
from soma_core.plugin.spec import API_VERSION, OLDEST_API_VERSION, BackendSpec, Generator, WrapPair

if TYPE_CHECKING:
    import pluggy
    import torch


__all__ = ["Entry", "Registry", "State", "WrapMaker", "default_registry"]

_CORE = f"{CORE_DISTRIBUTION} {__version__}"

WrapMaker = Callable[[str, Mapping[str, Any]], None]
"""Makes the wrap pair of a backend where its declaration names it."""

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
        self.who = f'backend "{self.name}" ({" and ".join(offer.source for offer in self.offers)})'


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
        self._wrap_maker: WrapMaker | None = None
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
        wrapped: bool = True,
    ) -> Generator:
        """Build the native generator of backend `name`; options are checked against its declaration.

        Without `wrapped` its wrap pair may be missing: a pair is made from the neutral mesh. A failed build
        is tried again on the next call: the user may have supplied the missing file.

        Raises:
            InputError: an option that the backend does not know or refuses.
            BackendError: the backend is not usable.
        """
        spec = self.spec(name)
        record = self._records[name]
        if wrapped:
            self.wrap(name, options)
        self._check_files(record, spec, wrapped=wrapped)
        assert record.manager is not None
        with _isolated(record, "build"):
            checked = checked_options(spec, options or {})
            generator = record.manager.hook.soma_generator(
                spec=spec, device=device, dtype=dtype, options=checked
            )
            if not callable(getattr(generator, "rest", None)):
                raise PluginError(f"soma_generator returned {type(generator).__name__} without a rest method")
        record.state, record.error = "built", None
        return generator

    @contextmanager
    def making_wraps(self, maker: WrapMaker) -> Iterator[None]:
        """Within the context, wrap pairs that users have yet to make are made when they are needed.

        `maker` is given the backend's name and options; registration takes minutes and belongs to no
        constructor, so nothing is made outside of such a context.
        """
        before, self._wrap_maker = self._wrap_maker, maker
        try:
            yield
        finally:
            self._wrap_maker = before

    def wrap(self, name: str, options: Mapping[str, Any] | None = None) -> WrapPair | None:
        """Return the wrap pair of backend `name`, made first where it is missing and can be made.

        Raises:
            BackendError: the backend is not usable, or its pair cannot be made.
        """
        spec, record = self.spec(name), self._records[name]
        pair = spec.wrap
        ours_to_make = pair is not None and pair.wrap in {needed.path for needed in spec.files}
        if self._wrap_maker is not None and pair and ours_to_make and not pair.wrap.is_file():
            self._check_files(record, spec, wrapped=False)
            with _isolated(record, "wrap"):
                self._wrap_maker(name, options or {})
        return pair

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
                raise PluginError(problem)
        return found

    def convert(self, name: str, source: Path, output: Path | None = None) -> tuple[Path, ...]:
        """Let backend `name` turn a file of its model's makers into what it reads; return what it wrote.

        Raises:
            BackendError: the backend is not usable, converts nothing, or refuses the file.
        """
        self.spec(name)
        record = self._records[name]
        assert record.manager is not None
        with _isolated(record, "files"):
            if not record.manager.hook.soma_convert.get_hookimpls():
                raise PluginError("it reads its model as it is", fix=f"See: soma backends show {name}")
            return tuple(record.manager.hook.soma_convert(source=source, output=output))

    def isolated(self, name: str, stage: Stage) -> AbstractContextManager[None]:
        """Return a context that turns whatever is raised inside into an error of backend `name`.

        For the stages that lie outside the registry: ``wrap`` and ``rest``. Ctrl-C passes, and so does an
        InputError at ``build`` and ``rest``, which is about what the caller asked for. SOMA_STRICT=1 lets
        everything pass as it is.
        """
        return _isolated(self._record(name), stage)

    def config_dirs(self) -> tuple[tuple[str, Path], ...]:
        """Return (distribution, folder) of each plugin that ships hydra configs, importing none of them.

        Left out are blocked and conflicting backends, and plugins that ship a file of the same name.
        """
        return tuple((offer.distribution, folder) for folder, offer in self.config_offers().items())

    def config_offers(self) -> Mapping[Path, Offer]:
        """Return the same folders, each with the offer that it comes from."""
        return self._configs.folders

    def config_clashes(self) -> Mapping[str, BackendConflictError]:
        """Return why a config such as ``backend/acme.yaml`` is not among :meth:`config_dirs`."""
        return self._configs.clashes

    def missing_config(self, name: str) -> BackendError:
        """Return why hydra finds no ``backend/<name>.yaml``: no backend, or a package without the file."""
        try:
            self.spec(name)
        except BackendError as reason:
            return reason
        return BrokenBackendError(
            who=self._records[name].who,
            stage="config",
            cause=f"its package ships no configs/backend/{name}.yaml",
            fix="Add the file to the plugin (keys: name, params, options) and install it again",
        )

    @functools.cached_property
    def _configs(self) -> PluginConfigs:
        usable = [record for record in self._records.values() if record.state not in ("blocked", "conflict")]
        return find_configs((record.offers[0] for record in usable), core=_CORE)

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
        with _isolated(record, "import"):
            plugin = record.offers[0].load()
        with _isolated(record, "hooks"):
            manager = hook_manager(plugin, record.name)
            spec = manager.hook.soma_backend()
        with _isolated(record, "spec"):
            problem = spec_problem(spec, record.name)
            if problem is not None:
                raise PluginError(problem)
            _check_api(record.offers[0], spec)
        record.manager, record.spec, record.state = manager, spec, "declared"
        if spec.api < API_VERSION:
            fix = f"Run: {reinstall_command(record.offers[0].distribution)}"
            warnings.warn(f"{record.who}: spec: {_spoken(spec)}. {fix}", BackendWarning, stacklevel=3)

    def _check_files(self, record: _Record, spec: BackendSpec, *, wrapped: bool) -> None:
        pair = (spec.wrap.native, spec.wrap.wrap) if spec.wrap else ()
        for needed in spec.files:
            if needed.path in pair and not wrapped:
                continue
            with _isolated(record, "files"):
                if not needed.path.exists():
                    raise PluginError(
                        f"{needed.description or 'a file'} is missing at {needed.path}", fix=supply(needed)
                    )
        for path in pair if wrapped else ():
            with _isolated(record, "wrap"):
                if not path.is_file():
                    raise PluginError(f"the wrap pair names {path}, which does not exist")


@contextmanager
def _isolated(record: _Record, stage: Stage) -> Iterator[None]:
    """Turn whatever is raised at `stage` into the error of this record; see :meth:`Registry.isolated`."""
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
        cause, fix = cause_and_fix(error)
        if stage != "files":  # a plugin is not to blame for what its user has yet to supply
            record.state = "broken"
        record.error = BrokenBackendError(
            who=record.who,
            stage=stage,
            cause=cause.rstrip(". "),
            fix=fix or remedy(record.name, record.offers[0].distribution, stage),
        )
        raise record.error from (None if own_words else error)


def _spoken(spec: BackendSpec) -> str:
    versions = f"{OLDEST_API_VERSION} to {API_VERSION}" if OLDEST_API_VERSION < API_VERSION else API_VERSION
    return f"written for plugin api {spec.api}; {_CORE} speaks {versions}"


def _check_api(offer: Offer, spec: BackendSpec) -> None:
    """Accept the contract versions that this core speaks."""
    if spec.api > API_VERSION:
        requirement = core_requirement(offer.distribution)
        raise PluginError(_spoken(spec), fix=f"Run: pip install --upgrade {shlex.quote(requirement)}")
    if spec.api < OLDEST_API_VERSION:
        raise PluginError(_spoken(spec), fix=f"Run: {reinstall_command(offer.distribution)}")


def default_registry() -> Registry:
    """Return the registry of this process; it is read once for each value of SOMA_BACKENDS and SOMA_DATA_DIR.

    A declaration names the files that it needs, which lie in the latter.
    """
    return _registry_for(os.environ.get("SOMA_BACKENDS", ""), os.environ.get("SOMA_DATA_DIR", ""))


@functools.cache
def _registry_for(allowed: str, data: str) -> Registry:  # noqa: ARG001 - what declarations depend on
    return Registry(allowed=[name.strip() for name in allowed.split(",") if name.strip()])
