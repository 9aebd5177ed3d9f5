"""Identity backends of the core, and what every backend's parameters go through."""

from __future__ import annotations

__all__: list[str] = []
