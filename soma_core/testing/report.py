"""What a run of the checks found: as text for people, as JSON for programs."""

from __future__ import annotations

import json
from collections import Counter
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
        lines = [f'backend "{self.backend}" ({self.distribution}), level {self.level}', ""]
        for outcome in self.outcomes:
            shown = _SHOWN.get(outcome.state, outcome.state)
            said = outcome.check.summary if outcome.failed else outcome.reason or outcome.check.summary
            lines.append(f"  {shown:<14}  {outcome.check.id:<{width}}  {said}".rstrip())
        for outcome in self.failed:
            lines += ["", f"{outcome.check.id}:", f"  {outcome.sentence}"]
        return "\n".join([*lines, "", self._total()])

    def _total(self) -> str:
        counts = Counter(outcome.state for outcome in self.outcomes)
        parts = [f"{count} {_SUMMED.get(state, state)}" for state, count in counts.items()]
        return f"{', '.join(parts)} in {sum(outcome.seconds for outcome in self.outcomes):.1f} s"

    def json(self) -> str:
        """The same as one JSON object."""
        document: dict[str, Any] = {
            "backend": self.backend,
            "distribution": self.distribution,
            "level": self.level,
            "passed": not self.failed and not self.missing_files,
            "missing_files": [str(path) for path in self.missing_files],
            "checks": [
                {
                    "id": outcome.check.id,
                    "level": outcome.check.level,
                    "summary": outcome.check.summary,
                    "state": outcome.state,
                    "where": outcome.where,
                    "got": outcome.got,
                    "expected": outcome.expected,
                    "fix": outcome.fix,
                    "reason": outcome.reason,
                    "seconds": round(outcome.seconds, 3),
                }
                for outcome in self.outcomes
            ],
        }
        return json.dumps(document, indent=2)
