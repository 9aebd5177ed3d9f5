"""Pose correctives (paper, section 3.5.2): displacements of the rest shape that depend on the pose."""

from __future__ import annotations

__all__: list[str] = []
