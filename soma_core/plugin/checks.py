"""What a check of a backend is, and how it says that a backend fails it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

from soma_core.errors import InputError, SomaError

__all__ = ["Check", "CheckFailedError", "CheckNotRunError", "Level", "check"]

Level = Literal["core", "full"]
"""core: seconds, what every change should run; full: everything."""

Body: TypeAlias = Callable[[Any], None]
"""Takes the :class:`soma_core.testing.Context` of a backend."""

_KEBAB = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")


class CheckFailedError(SomaError, AssertionError):
    """A backend fails a check.

    The text reads ``<where>: got <got>, expected <expected>. <fix>``; `where` names the file, vertex,
    parameter or joint.
    """

    def __init__(self, where: str, *, got: object, expected: object, fix: str) -> None:
        self.where, self.got, self.expected, self.fix = where, str(got), str(expected), fix
        super().__init__(f"{where}: got {got}, expected {expected}. {fix}")


class CheckNotRunError(SomaError):
    """A check cannot tell here whether the backend holds what it asks; the text says why."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing that a backend must do.

    Attributes:
        id: stable name in kebab case; the checks of a plugin appear as ``<backend>/<id>``.
        level: ``core`` or ``full``.
        summary: one line: what holds when the check passes.
        run: passes by returning; fails by raising, best :class:`CheckFailedError`.
        needs: ids of checks that must have passed before; this one is not run otherwise.
        unless: gives the reason why the check does not apply to a backend, or an empty text.
        mend: what to do where it fails, in a few words.
    """

    id: str
    level: Level
    summary: str
    run: Body
    needs: tuple[str, ...] = ()
    unless: Callable[[Any], str] | None = None
    mend: str = ""

    def __post_init__(self) -> None:
        if not _KEBAB.fullmatch(self.id.rpartition("/")[2]):
            raise InputError(
                "Check.id",
                got=repr(self.id),
                expected="lower-case words joined by -",
                fix="Rename the check.",
            )
        if self.level not in get_args(Level):
            raise InputError(
                f"level of the check {self.id}",
                got=repr(self.level),
                expected=f"one of {', '.join(get_args(Level))}",
                fix="Choose core for a check that takes less than a second.",
            )


def check(
    check_id: str,
    *,
    level: Level = "full",
    needs: tuple[str, ...] = (),
    unless: Callable[[Any], str] | None = None,
    mend: str = "",
) -> Callable[[Body], Check]:
    """Turn a function into a :class:`Check`; the first line of its docstring is the summary."""

    def made(run: Body) -> Check:
        summary = (run.__doc__ or "").strip().partition("\n")[0].rstrip(".")
        return Check(
            id=check_id, level=level, summary=summary, run=run, needs=needs, unless=unless, mend=mend
        )

    return made
