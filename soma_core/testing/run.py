"""Running the checks of one backend: each alone, each once, each after what it needs."""

from __future__ import annotations

import fnmatch
import json
import time
import traceback
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from soma_core.errors import AssetError, InputError
from soma_core.plugin.checks import Check, CheckFailedError, CheckNotRunError, Level
from soma_core.plugin.declaration import did_you_mean
from soma_core.plugin.errors import BackendError, BrokenBackendError
from soma_core.plugin.registry import Registry, default_registry
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.testing.checks import CORE_CHECKS
from soma_core.testing.context import Context
from soma_core.testing.global_state import kept
from soma_core.testing.report import Outcome, Report, State

__all__ = ["ConformanceRun", "check_backend", "plugin_checks"]


def check_backend(
    name: str,
    *,
    level: Level = "full",
    only: Sequence[str] = (),
    expected_failures: Mapping[str, str] | None = None,
    options: Mapping[str, Any] | None = None,
    registry: Registry | None = None,
    canonical: tuple[CanonicalMesh, Rig] | None = None,
) -> Report:
    """Check backend `name` and report; nothing that the backend does ends the run.

    Args:
        name: an installed backend.
        level: ``core`` (seconds) or ``full``.
        only: ids, or patterns such as ``wrap-*``; what they need is run as well.
        expected_failures: id -> physical reason why this backend cannot pass that check.
        options: the backend's options that are checked; by default its defaults.
        registry, canonical: where backends are looked up, and another mesh and rig than the shipped ones,
            such as :func:`soma_core.testing.synthetic.synthetic_canonical`.

    Raises:
        BackendError: the backend is not installed, blocked by SOMA_BACKENDS, or offered twice.
        InputError: an unknown id, or an expected failure without a reason.
    """
    run = ConformanceRun(
        name, level=level, only=only, expected_failures=expected_failures, options=options,
        registry=registry, canonical=canonical,
    )  # fmt: skip
    return run.report()


class ConformanceRun:
    """The checks of one backend; an outcome is made when it is first asked for. See :func:`check_backend`."""

    def __init__(
        self,
        name: str,
        *,
        level: Level = "full",
        only: Sequence[str] = (),
        expected_failures: Mapping[str, str] | None = None,
        options: Mapping[str, Any] | None = None,
        registry: Registry | None = None,
        canonical: tuple[CanonicalMesh, Rig] | None = None,
    ) -> None:
        self.name, self.level = name, level
        self.registry = registry or default_registry()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what the import says is for a check to judge
            with suppress(BrokenBackendError):  # so is this; any other error means: not to be checked
                self.registry.spec(name)
            known = {check.id: check for check in (*CORE_CHECKS, *plugin_checks(self.registry, name))}
        self._expected = _checked_expectations(expected_failures or {}, known)
        self.checks = _selected(known, level, only)
        self._outcomes: dict[str, Outcome] = {}
        self._context: Context | None = None
        self._given: dict[str, Any] = {"options": options, "registry": self.registry, "canonical": canonical}

    @property
    def context(self) -> Context:
        """What the checks look at; made on first use."""
        if self._context is None:
            self._context = Context(self.name, **self._given)
        return self._context

    def close(self) -> None:
        """Forget what was built, which may be large; outcomes stay."""
        self._context = None

    def take(self, outcome: Outcome) -> None:
        """Take over an outcome that is known already."""
        self._outcomes[outcome.check.id] = outcome

    def known(self, check_id: str) -> bool:
        """Whether the outcome of a check is known."""
        return check_id in self._outcomes

    def outcome(self, check_id: str) -> Outcome:
        """Outcome of one check, after those that it needs."""
        if check_id not in self._outcomes:
            found = self._run(self.checks[check_id])
            self._outcomes[check_id] = _as_expected(found, self._expected.get(check_id, ""))
        return self._outcomes[check_id]

    def report(self) -> Report:
        """Run every check that has not been run."""
        outcomes = tuple(self.outcome(check_id) for check_id in self.checks)
        return Report(
            backend=self.name, distribution=self.distribution, level=self.level, outcomes=outcomes,
            missing_files=self.missing_files(),
        )  # fmt: skip

    @property
    def distribution(self) -> str:
        """Name and version of the distribution that offers the backend."""
        return self.registry.offers(self.name)[0].source

    def missing_files(self) -> tuple[Path, ...]:
        """Declared files that are not there."""
        try:
            spec = self.registry.spec(self.name)
        except BackendError:
            return ()
        return tuple(needed.path for needed in spec.files if not needed.path.exists())

    def _run(self, check: Check) -> Outcome:
        for need in check.needs:
            if self.outcome(need).state not in ("passed", "fixed", "not applicable"):
                return Outcome(check=check, state="not run", reason=f"needs {need}")
        start = time.perf_counter()
        with kept(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # all three fronts see the same, whatever their filters
            found = self._isolated(check)
        return replace(found, seconds=time.perf_counter() - start)

    def _isolated(self, check: Check) -> Outcome:
        """Run one check; whatever it raises, SystemExit included, is its failure."""
        try:
            reason = check.unless(self.context) if check.unless else ""
            if reason:
                return Outcome(check=check, state="not applicable", reason=reason)
            check.run(self.context)
        except (KeyboardInterrupt, GeneratorExit):
            raise
        except BaseException as error:
            if isinstance(error, CheckNotRunError):
                return Outcome(check=check, state="not run", reason=str(error))
            if isinstance(error, BackendError) and error.stage == "files":
                return Outcome(check=check, state="not run", reason=f"{error.cause}. {error.fix}")
            where, got, expected, fix = _told(error, check, self.registry.offers(self.name)[0].package)
            return Outcome(
                check=check, state="failed", where=where, got=got, expected=expected, fix=fix, error=error
            )
        return Outcome(check=check, state="passed")


def _told(error: BaseException, check: Check, package: str) -> tuple[str, str, str, str]:
    """Where, got, expected and fix of whatever a check raised."""
    promise = "that " + check.summary[:1].lower() + check.summary[1:]
    if isinstance(error, CheckFailedError):
        return error.where, error.got, error.expected, error.fix
    if isinstance(error, InputError):
        return error.argument, str(error.got), str(error.expected), error.fix
    if isinstance(error, BackendError):
        return error.who, f"{error.stage}: {error.cause}", promise, error.fix
    if isinstance(error, AssetError):
        return error.path, error.cause, promise, error.fix
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if package in Path(frame.filename).parts]
    place = (own or frames)[-1]
    got = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return f"{place.filename}:{place.lineno}", got, promise, "Mend what raises it."


def _as_expected(outcome: Outcome, reason: str) -> Outcome:
    """Turn a failure that has a reason into an expected one, and a pass into a failure."""
    changed: dict[str, State] = {"failed": "expected", "passed": "fixed"}
    if not reason or outcome.state not in changed:
        return outcome
    return replace(outcome, state=changed[outcome.state], reason=reason)


def explained(check_id: str, *, as_json: bool = False) -> str:
    """Say of a check of the core what must hold, when it runs, and how to mend what it finds.

    Raises:
        InputError: no check of that id.
    """
    known = {check.id: check for check in CORE_CHECKS}
    if check_id not in known:
        raise _unknown("ID", check_id, known)
    check = known[check_id]
    facts = {
        "id": check.id, "holds": check.summary, "mend": check.mend, "level": check.level,
        "needs": list(check.needs),
    }  # fmt: skip
    if as_json:
        return json.dumps(facts, indent=2)
    lines = [f"{check.id} ({check.level})", f"holds: {check.summary}", f"where it fails: {check.mend}"]
    return "\n  ".join([*lines, f"needs: {', '.join(check.needs) or 'nothing'}"])


def plugin_checks(registry: Registry, name: str) -> tuple[Check, ...]:
    """Checks that the plugin gives, under ids ``<backend>/<id>``; none where it is broken.

    Raises:
        InputError: two checks under one id, or one that needs what does not exist.
    """
    try:
        given = registry.checks(name)
    except BackendError:
        return ()  # the check own-checks says so
    own = [check.id for check in given]
    twice = sorted({check_id for check_id in own if own.count(check_id) > 1})
    if twice:
        raise InputError(
            f"soma_checks of backend {name!r}",
            got=f"{twice[0]} {own.count(twice[0])} times",
            expected="each id once",
            fix="Rename one of the checks.",
        )
    core = {check.id for check in CORE_CHECKS}
    return tuple(_prefixed(check, name, own, core) for check in given)


def _prefixed(check: Check, name: str, own: Iterable[str], core: Iterable[str]) -> Check:
    needs = []
    for need in check.needs:
        if need not in (*own, *core):
            raise InputError(
                f"needs of the check {name}/{check.id}",
                got=repr(need),
                expected="the id of another check",
                fix=did_you_mean(need, [*own, *core]) or "Leave it out.",
            )
        needs.append(f"{name}/{need}" if need in own else need)
    return replace(check, id=f"{name}/{check.id}", needs=tuple(needs))


def _checked_expectations(expected: Mapping[str, str], known: Mapping[str, Check]) -> dict[str, str]:
    for check_id, reason in expected.items():
        if check_id not in known:
            raise _unknown("expected_failures", check_id, known)
        if not (isinstance(reason, str) and reason.strip()):
            raise InputError(
                f"expected_failures[{check_id!r}]",
                got=repr(reason),
                expected="the physical reason why the backend cannot pass",
                fix="Write it down, or take the id out.",
            )
    return dict(expected)


def _unknown(argument: str, check_id: str, known: Iterable[str]) -> InputError:
    return InputError(
        argument,
        got=repr(check_id),
        expected="the id of a check, such as wrap-order",
        fix=did_you_mean(check_id, known) or f"The ids are {', '.join(known)}.",
    )


def _selected(known: Mapping[str, Check], level: Level, only: Sequence[str]) -> dict[str, Check]:
    """The checks of a level, or those that `only` names, with all that they need, in the order of `known`."""
    if level not in ("core", "full"):
        raise InputError("level", got=repr(level), expected="'core' or 'full'", fix="Choose one of the two.")
    for pattern in only:
        if not fnmatch.filter(known, pattern):
            raise _unknown("only", pattern, known)
    wanted = [
        check.id
        for check in known.values()
        if (any(fnmatch.fnmatchcase(check.id, pattern) for pattern in only) if only else True)
        and (only or level == "full" or check.level == "core")
    ]
    for check_id in wanted:  # grows while it is walked
        wanted += [need for need in known[check_id].needs if need not in wanted]
    return {check_id: check for check_id, check in known.items() if check_id in wanted}
