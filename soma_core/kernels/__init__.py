"""Warp twins of the hot functions: same names and signatures as the torch reference."""

from __future__ import annotations

__all__: list[str] = []
