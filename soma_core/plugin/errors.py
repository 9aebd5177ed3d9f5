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
    "PluginError",
    "Stage",
    "UnknownBackendError",
]

Stage = Literal["lookup", "import", "hooks", "spec", "files", "build", "wrap", "rest", "config"]
"""How far a backend came.

lookup: found by name; import: its module loaded; hooks: its functions registered and called; spec: its
declaration checked; files: what the user must supply is there; build: the generator made; wrap: its
vertices tied to the canonical mesh; rest: a body generated; config: its hydra files composed.
"""


class PluginError(SomaError):
    """What is wrong with a plugin, said before it is known whose it is.

    The registry turns it into a :class:`BackendError`, which adds the backend, its distribution and the
    stage. Without a `fix` the registry names the usual one.
    """

    def __init__(self, cause: str, *, fix: str = "") -> None:
        self.cause, self.fix = cause, fix
        super().__init__(f"{cause}. {fix}".strip())


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
