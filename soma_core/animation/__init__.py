"""Animation (paper, section 3.5.1): forward kinematics and linear blend skinning."""

from __future__ import annotations

__all__: list[str] = []
