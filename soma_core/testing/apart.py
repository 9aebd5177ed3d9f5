"""The checks of a backend in child processes: one that ends its process is one failure, the others go on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from soma_core.errors import InputError, SomaError
from soma_core.plugin.checks import Level
from soma_core.plugin.child import EndedError, Say, run_in_child
from soma_core.testing.report import Outcome, Report

__all__ = ["check_apart", "check_one", "make_what_is_shared"]


def check_apart(name: str, *, level: Level, only: Sequence[str], seconds: float) -> Report:
    """Check an installed backend as :func:`soma_core.testing.check_backend` does, but not in this process.

    Args:
        name: the backend.
        level: ``core`` or ``full``.
        only: ids, or patterns.
        seconds: longest that a check may take; one that takes longer fails.

    Raises:
        EndedError: the import of the plugin ends the process.
        InputError: an unknown check.
    """
    found: list[Outcome] = []
    plan: dict[str, Any] = {}
    while "missing" not in plan:
        found += _checked(plan, name, level, list(only), [each.document() for each in found], seconds)
    order = plan["order"]
    return Report(
        backend=name, distribution=plan["distribution"], level=level,
        outcomes=tuple(sorted(found, key=lambda each: order.index(each.check.id))),
        missing_files=tuple(map(Path, plan["missing"])),
    )  # fmt: skip


def _checked(
    plan: dict[str, Any], name: str, level: Level, only: list[str], done: list[dict[str, Any]], seconds: float
) -> list[Outcome]:
    """The outcomes of one child; the last is that of the check that ended it."""
    found: list[Outcome] = []
    plan.pop("begun", None)
    said = run_in_child(
        f"{__name__}:check_one", name, level, only, done, seconds=seconds,
        prepare=f"{__name__}:make_what_is_shared", preload=("soma_core.testing.run",),
    )  # fmt: skip
    try:
        for document in said:
            if "refused" in document:
                raise InputError(**document["refused"])
            plan |= document
            found += [Outcome.of_document(document["outcome"])] if "outcome" in document else []
    except EndedError as ended:
        if "begun" not in plan:
            raise
        found.append(_unanswered(plan["begun"], ended))
    return found


def _unanswered(begun: Mapping[str, Any], ended: EndedError) -> Outcome:
    """The failure of a check that did not come back."""
    told = {
        "state": "failed", "where": "the process of the check", "got": str(ended),
        "expected": "an outcome", "fix": "Mend what ends or stops it.",
    }  # fmt: skip
    return Outcome.of_document({**begun, **told})


def make_what_is_shared() -> None:
    """In a child: make what the first body of any backend waits for and the disk keeps from then on."""
    from soma_core.rig import load_canonical
    from soma_core.skeleton.joints import joint_regressor

    with suppress(SomaError):  # told where a backend meets it
        joint_regressor(*load_canonical("mid"))


def check_one(
    say: Say, name: str, level: Level, only: Sequence[str], done: Sequence[Mapping[str, Any]]
) -> None:
    """In a child: run the checks of backend `name` but those that are done, and say each as it ends."""
    from soma_core.testing.run import ConformanceRun

    try:
        run = ConformanceRun(name, level=level, only=only)
    except InputError as error:
        named = ("argument", "got", "expected", "fix")
        say({"refused": {key: str(vars(error)[key]) for key in named}})
        return
    for document in done:
        run.take(Outcome.of_document(document))
    say({"order": list(run.checks), "distribution": run.distribution})
    for check_id, check in run.checks.items():
        if not run.known(check_id):
            say({"begun": {"id": check_id, "level": check.level, "summary": check.summary}})
            say({"outcome": run.outcome(check_id).document()})
    say({"missing": [str(path) for path in run.missing_files()]})
