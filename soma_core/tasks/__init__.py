"""Jobs that a user runs: each module offers ``run(config, output)``."""

from __future__ import annotations

__all__: list[str] = []
