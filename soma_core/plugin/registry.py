"""The registry: finds backends, loads each one alone, and keeps a broken one from hurting the others."""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soma_core._version import __version__
from soma_core.errors import InputError, check_type
from soma_core.plugin.causes import supply
from soma_core.plugin.checks import Check
from soma_core.plugin.configs import PluginConfigs, find_configs
from soma_core.plugin.declaration import checks_problem, did_you_mean, formats_problem, spec_problem
from soma_core.plugin.discovery import (
    CORE_DISTRIBUTION,
    EntryPointLike,
    Offer,
    find_offers,
    read_installed,
)
from soma_core.plugin.errors import (
    BackendConflictError,
    BackendError,
    BackendWarning,
    BrokenBackendError,
    PluginError,
    Stage,
    UnknownBackendError,
)
from soma_core.plugin.hooks import hook_manager
from soma_core.plugin.installation import newer_core, reinstall_command
from soma_core.plugin.known import KNOWN_BACKENDS, publication
from soma_core.plugin.options import checked_options, options_by_name
from soma_core.plugin.record import (
    Entry,
    Record,
    State,
    damaged_entry,
    isolated,
    option_in_error,
    refuse_rival,
    settle,
)
from soma_core.plugin.spec import (
    API_VERSION,
    OLDEST_API_VERSION,
    BackendSpec,
    Generator,
    MotionFormat,
    WrapPair,
)

if TYPE_CHECKING:
    import torch


__all__ = ["Entry", "Registry", "State", "WrapMaker", "default_registry"]

_OPTIONS_SINCE = 2
"""The api from which on options are the declared dataclass."""

_CORE = f"{CORE_DISTRIBUTION} {__version__}"

WrapMaker = Callable[[str, Mapping[str, Any]], None]
"""Makes the wrap pair of a backend where its declaration names it."""


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
        self._points = None if entry_points is None else tuple(entry_points)
        self._wrap_maker: WrapMaker | None = None
        points, self._damaged = read_installed() if self._points is None else (self._points, ())
        self._records: dict[str, Record] = {}
        self._rivals: list[Record] = []
        for name, offers in find_offers(points).items():
            own = tuple(offer for offer in offers if offer.of_core)
            self._records[name] = Record(name, own or offers)
            self._rivals += [Record(name, (offer,)) for offer in offers if own and not offer.of_core]
        for record in self._records.values():
            settle(record, self._allowed)
        for record in self._rivals:
            refuse_rival(record)

    def __reduce__(self) -> tuple[object, ...]:
        """Read what is installed anew where the registry is unpickled, or take the given entry points."""
        return _registry_of, (self._points, tuple(sorted(self._allowed)))

    def names(self) -> tuple[str, ...]:
        """Names that can be asked for: all but the blocked, the conflicting and those that failed."""
        return tuple(
            name
            for name, record in self._records.items()
            if record.spec is not None or record.state == "found"
        )

    def entries(self) -> tuple[Entry, ...]:
        """Every offer with its state, sorted by name; a conflict shows once for each distribution.

        Distributions whose metadata cannot be read come last, under no name.
        """
        records = sorted((*self._records.values(), *self._rivals), key=lambda record: record.name)
        found = [entry for record in records for entry in record.entries]
        return (*found, *map(damaged_entry, self._damaged))

    def tell(self, name: str, state: State, error: BackendError | None = None) -> None:
        """Take over how far backend `name` came in another process, for :meth:`entries`."""
        self._record(name).state, self._record(name).error = state, error

    def offers(self, name: str) -> tuple[Offer, ...]:
        """Return who offers backend `name`, without importing a plugin; several where they conflict.

        Raises:
            UnknownBackendError: nobody offers it.
        """
        return self._record(name).offers

    def usable(self, name: str) -> None:
        """Refuse a name that no plugin needs to be imported to refuse.

        Raises:
            BackendError: unknown, blocked, conflicting, or failed before.
        """
        record = self._record(name)
        if record.error is not None and record.spec is None:
            raise record.error.with_traceback(None)

    def spec(self, name: str) -> BackendSpec:
        """Return the declaration of backend `name`, importing its plugin on first use.

        Raises:
            BackendError: unknown, blocked or conflicting name, or a plugin that fails to declare.
        """
        record = self._record(name)
        if record.spec is None:
            self.usable(name)
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
        with isolated(record, "build"), option_in_error(options or {}):
            checked = checked_options(spec, options or {})
            given = options_by_name(checked) if spec.api < _OPTIONS_SINCE else checked
            generator = record.manager.hook.soma_generator(
                spec=spec, device=device, dtype=dtype, options=given
            )
            if isinstance(generator, type) or not callable(getattr(generator, "rest", None)):
                kind = f"{generator!r:.60}" if isinstance(generator, type) else type(generator).__name__
                raise PluginError(f"soma_generator returned {kind}, no object with a rest method")
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
            with isolated(record, "wrap"):
                self._wrap_maker(name, options or {})
        return pair

    def checks(self, name: str) -> tuple[Check, ...]:
        """Return the further conformance checks that the plugin of backend `name` gives; often none.

        Raises:
            BackendError: the backend is not usable, or what it gives are no checks.
        """
        return self._given(name, "soma_checks", checks_problem)

    def convert(self, name: str, source: Path, output: Path | None = None) -> tuple[Path, ...]:
        """Let backend `name` turn a file of its model's makers into what it reads; return what it wrote.

        Raises:
            BackendError: the backend is not usable, converts nothing, or refuses the file.
        """
        self.spec(name)
        record = self._records[name]
        assert record.manager is not None
        if not source.exists():
            raise InputError(
                "FILE", got=str(source), expected="a file that is there", fix="Correct the path."
            )
        with isolated(record, "files"):
            if not record.manager.hook.soma_convert.get_hookimpls():
                raise PluginError("it reads its model as it is", fix=f"See: soma backends show {name}")
            return tuple(record.manager.hook.soma_convert(source=source, output=output))

    def motion_formats(self) -> dict[str, tuple[str, MotionFormat]]:
        """Return the files of motions that plugins read or write: name -> backend and format.

        Plugins are imported for it; one that fails has none. The first backend of a name keeps it.
        """
        found: dict[str, tuple[str, MotionFormat]] = {}
        for name in self.names():
            with suppress(BackendError):  # said by whoever asks for the backend
                for each in self.formats(name):
                    found.setdefault(each.name, (name, each))
        return found

    def formats(self, name: str) -> tuple[MotionFormat, ...]:
        """Return the motion files of backend `name`.

        Raises:
            BackendError: the backend is not usable, or what it gives are no formats.
        """
        return self._given(name, "soma_motions", formats_problem)

    def _given(self, name: str, hook: str, problem_of: Callable[[Iterable[object]], str | None]) -> Any:
        """What the optional hook of a backend lists, found to be sound."""
        self.spec(name)
        record = self._records[name]
        with isolated(record, "hooks"):
            found = tuple(each for given in getattr(record.manager.hook, hook)() for each in given)
            problem = problem_of(found)
            if problem is not None:
                raise PluginError(problem)
        return found

    def isolated(self, name: str, stage: Stage) -> AbstractContextManager[None]:
        """Return a context that turns whatever is raised inside into an error of backend `name`.

        For the stages that lie outside the registry: ``wrap`` and ``rest``. Ctrl-C passes, and so does an
        InputError at ``build`` and ``rest``, which is about what the caller asked for. SOMA_STRICT=1 lets
        everything pass as it is.
        """
        return isolated(self._record(name), stage)

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

    def _record(self, name: str) -> Record:
        check_type("backend", name, str, fix="Name one: `soma backends` lists them.")
        if name in self._records:
            return self._records[name]
        cause = f"no installed distribution offers it; installed are: {', '.join(self._records) or 'none'}"
        known = KNOWN_BACKENDS.get(name)
        if known is not None:
            fix = publication(known.distribution)
        else:
            fix = did_you_mean(name, [*self._records, *KNOWN_BACKENDS]) or "See: soma backends list"
        raise UnknownBackendError(who=f'backend "{name}"', stage="lookup", cause=cause, fix=fix)

    def _declare(self, record: Record) -> None:
        """Import the plugin, register its hooks with a manager of its own, and check its declaration."""
        with isolated(record, "import"):
            plugin = record.offers[0].load()
        with isolated(record, "hooks"):
            manager = hook_manager(plugin, record.name)
            spec = manager.hook.soma_backend()
        with isolated(record, "spec"):
            problem = spec_problem(spec, record.name)
            if problem is not None:
                raise PluginError(problem)
            _check_api(record.offers[0], spec)
        record.manager, record.spec, record.state = manager, spec, "declared"
        if spec.api < _OPTIONS_SINCE and spec.options is not None:  # what uses nothing that changed is as new
            fix = reinstall_command(record.offers[0].distribution)
            warnings.warn(f"{record.who}: spec: {_spoken(spec)}. {fix}", BackendWarning, stacklevel=3)

    def _check_files(self, record: Record, spec: BackendSpec, *, wrapped: bool) -> None:
        pair = (spec.wrap.native, spec.wrap.wrap) if spec.wrap else ()
        for needed in spec.files:
            if needed.path in pair and not wrapped:
                continue
            with isolated(record, "files"):
                if not needed.path.exists():
                    raise PluginError(
                        f"{needed.description or 'a file'} is missing at {needed.path}", fix=supply(needed)
                    )
        for path in pair if wrapped else ():
            with isolated(record, "wrap"):
                if not path.is_file():
                    raise PluginError(f"the wrap pair names {path}, which does not exist")


def _spoken(spec: BackendSpec) -> str:
    versions = f"{OLDEST_API_VERSION} to {API_VERSION}" if OLDEST_API_VERSION < API_VERSION else API_VERSION
    return f"written for plugin api {spec.api}; {_CORE} speaks {versions}"


def _check_api(offer: Offer, spec: BackendSpec) -> None:
    """Accept the contract versions that this core speaks."""
    if spec.api > API_VERSION:
        raise PluginError(_spoken(spec), fix=newer_core(offer.distribution))
    if spec.api < OLDEST_API_VERSION:
        raise PluginError(_spoken(spec), fix=reinstall_command(offer.distribution))


def default_registry() -> Registry:
    """Return the registry of this process; it is read once for each value of SOMA_BACKENDS and SOMA_DATA_DIR.

    A declaration names the files that it needs, which lie in the latter.
    """
    return _registry_for(os.environ.get("SOMA_BACKENDS", ""), os.environ.get("SOMA_DATA_DIR", ""))


@functools.cache
def _registry_for(allowed: str, data: str) -> Registry:  # noqa: ARG001 - what declarations depend on
    return Registry(allowed=[name.strip() for name in allowed.split(",") if name.strip()])


def _registry_of(points: tuple[EntryPointLike, ...] | None, allowed: tuple[str, ...]) -> Registry:
    """Make a registry again, as pickle does."""
    return Registry(points, allowed=allowed)
