"""What can go wrong with a backend plugin: each error says who, at which stage, why, and the fix."""

from __future__ import annotations

from typing import Literal

from soma_core.errors import SomaError

__all__ = [
    "BackendConflictError",
    "BackendDisabledError",
    "BackendError",
    "BackendWarning",
    "BrokenBackendError",
    "Stage",
    "UnknownBackendError",
]

Stage = Literal["lookup", "import", "hooks", "spec", "files", "build", "wrap", "config"]
"""How far the backend came: found by name, imported, hooks read, declaration checked, files there, built."""


class BackendError(SomaError):
    """A backend cannot be used.

    The text reads ``<who>: <stage>: <cause>. <fix>``, where `who` names the backend and the
    distribution that it comes from, and `fix` is one thing to do.
    """

    def __init__(self, *, who: str, stage: Stage, cause: str, fix: str) -> None:
        self.who, self.stage, self.cause, self.fix = who, stage, cause, fix
        super().__init__(f"{who}: {stage}: {cause}. {fix}")


class UnknownBackendError(BackendError):
    """No installed distribution offers a backend of this name."""


class BackendConflictError(BackendError):
    """Two distributions offer the same name; neither is loaded."""


class BackendDisabledError(BackendError):
    """The allow-list in SOMA_BACKENDS leaves this backend out."""


class BrokenBackendError(BackendError):
    """The plugin failed at one of its stages; every other backend keeps working."""


class BackendWarning(UserWarning):
    """A backend works but should be updated."""
