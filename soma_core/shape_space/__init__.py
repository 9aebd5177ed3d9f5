"""Training of the native shape space: sampled identities, their mirror images, incremental PCA."""

from __future__ import annotations

__all__: list[str] = []
