"""Named points of the canonical mesh, for landmarks of a registration and for measurements."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

__all__ = ["canonical_landmarks"]


@functools.cache
def canonical_landmarks() -> Mapping[str, int]:
    """Vertex id of each named point, ``LeftIndexTip`` and the like; ids hold at the LODs mid and low.

    ``soma assets landmarks FILE.png`` draws them. Tips of fingers and toes are their ends, knuckles lie on
    the back of the hand, over the joint where a finger begins; Left and Right are the body's own.
    """
    return MappingProxyType(json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8")))
