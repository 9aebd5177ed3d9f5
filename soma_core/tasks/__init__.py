"""Jobs that a user runs, and the exit codes that say how one ended.

A task that hydra configures offers ``run(config, output)``.
"""

from __future__ import annotations

__all__ = ["EXIT_BACKEND", "EXIT_FAILED", "EXIT_OK", "EXIT_USAGE"]

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_BACKEND = 0, 1, 2, 3
"""Done; a check failed; the command was wrong; a backend is not usable."""
