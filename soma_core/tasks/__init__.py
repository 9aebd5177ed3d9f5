"""Jobs that a user runs, and the exit codes that say how one ended.

A task that hydra configures offers ``run(config, output)``.
"""

from __future__ import annotations

from soma_core.errors import InputError, SomaError

__all__ = ["EXIT_BACKEND", "EXIT_FAILED", "EXIT_OK", "EXIT_USAGE", "exit_code"]

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_BACKEND = 0, 1, 2, 3
"""Done; a check failed; the command was wrong; a backend is not usable."""


def exit_code(error: SomaError) -> int:
    """Exit code that an error means."""
    from soma_core.plugin.errors import BackendError

    if isinstance(error, BackendError):
        return EXIT_BACKEND
    return EXIT_USAGE if isinstance(error, InputError) else EXIT_FAILED
