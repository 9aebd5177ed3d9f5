"""Skeletal abstraction (paper, section 3.4): the canonical skeleton fitted to any body shape."""

from __future__ import annotations

__all__: list[str] = []
