"""Registration of the canonical mesh to any human mesh: a wrap pair without an artist (paper, 3.3)."""

from __future__ import annotations

__all__: list[str] = []
