"""Mesh topology abstraction (paper, section 3.3): native vertices brought to the canonical mesh."""

from __future__ import annotations

__all__: list[str] = []
