"""Make the shipped assets: ``python -m assets.make`` in a checkout. Not part of the package."""

from __future__ import annotations

__all__: list[str] = []
