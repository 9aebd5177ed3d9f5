"""What a run of the checks found: as text for people, as JSON for programs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from soma_core.plugin.checks import Check, Level

__all__ = ["Outcome", "Report", "State"]

State = Literal["passed", "failed", "expected", "fixed", "not run", "not applicable"]
"""expected: fails, as the suite says it does; fixed: passes although the suite expects a failure, which fails
the run; not run: something that the check needs did not pass."""

_SHOWN = {"failed": "FAILED", "fixed": "FIXED"}
_SUMMED = {"expected": "failed as expected"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """The result of one check.

    Attributes:
        check: which one.
        state: how it ended.
        where, got, expected, fix: what is wrong and how to mend it, where it failed.
        reason: why it was not run, does not apply, or is expected to fail.
        seconds: how long it took, with what it built for those that follow.
        error: the exception behind a failure, with its traceback.
    """

    check: Check
    state: State
    where: str = ""
    got: str = ""
    expected: str = ""
    fix: str = ""
    reason: str = ""
    seconds: float = 0.0
    error: BaseException | None = field(default=None, repr=False)

    def document(self) -> dict[str, Any]:
        """The outcome as plain values, without the exception."""
        return {
            "id": self.check.id, "level": self.check.level, "summary": self.check.summary,
            "state": self.state, "where": self.where, "got": self.got, "expected": self.expected,
            "fix": self.fix, "reason": self.reason, "seconds": round(self.seconds, 3),
        }  # fmt: skip

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> Outcome:
        """The outcome of a check that ran elsewhere."""
        told = dict(document)
        check = Check(id=told.pop("id"), level=told.pop("level"), summary=told.pop("summary"), run=_elsewhere)
        return cls(check=check, **told)

    @property
    def failed(self) -> bool:
        """Whether this outcome fails the run."""
        return self.state in ("failed", "fixed")

    @property
    def sentence(self) -> str:
        """What to tell the author; empty where the check passed."""
        if self.state == "failed":
            return f"{self.where}: got {self.got}, expected {self.expected}. {self.fix}"
        if self.state == "fixed":
            return (
                f"{self.check.id}: got a pass, expected a failure ({self.reason}). "
                "Take the id out of expected_failures."
            )
        return self.reason


def _elsewhere(context: Any) -> None:
    """Stand for a check that ran in another process."""
    raise NotImplementedError


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """The outcomes of one run, in order.

    Attributes:
        backend: name of the backend.
        distribution: name and version of the distribution that offers it.
        level: which checks were run.
        outcomes: one for each check.
        missing_files: declared files that are not there, so that part of the checks could not run.
    """

    backend: str
    distribution: str
    level: Level
    outcomes: tuple[Outcome, ...]
    missing_files: tuple[Path, ...] = ()

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """Outcomes that fail the run: failures, and expected failures that no longer fail."""
        return tuple(outcome for outcome in self.outcomes if outcome.failed)

    def text(self) -> str:
        """One line a check, then a sentence for each failure, then the count."""
        width = max((len(outcome.check.id) for outcome in self.outcomes), default=0)
        lines = [self.heading, ""]
        for outcome in self.outcomes:
            shown = _SHOWN.get(outcome.state, outcome.state)
            said = outcome.check.summary if outcome.failed else outcome.reason or outcome.check.summary
            lines.append(f"  {shown:<14}  {outcome.check.id:<{width}}  {said}".rstrip())
        return "\n".join([*lines, *self._failures(), "", self.total])

    def brief(self) -> str:
        """One line for the backend, then a sentence for each failure."""
        return "\n".join([f"{self.heading}: {self.total}", *self._failures()])

    def _failures(self) -> list[str]:
        return [line for each in self.failed for line in ("", f"{each.check.id}:", f"  {each.sentence}")]

    @property
    def heading(self) -> str:
        """Whose checks, and which."""
        return f'backend "{self.backend}" ({self.distribution}), level {self.level}'

    @property
    def total(self) -> str:
        """How many checks ended in each way, and the time."""
        counts = Counter(outcome.state for outcome in self.outcomes)
        parts = [f"{count} {_SUMMED.get(state, state)}" for state, count in counts.items()]
        return f"{', '.join(parts)} in {sum(outcome.seconds for outcome in self.outcomes):.1f} s"

    def json(self) -> str:
        """The same as one JSON object."""
        return json.dumps(self.document(), indent=2)

    def document(self) -> dict[str, Any]:
        """The same as plain values."""
        return {
            "backend": self.backend,
            "distribution": self.distribution,
            "level": self.level,
            "passed": not self.failed and not self.missing_files,
            "missing_files": [str(path) for path in self.missing_files],
            "checks": [outcome.document() for outcome in self.outcomes],
        }
