"""The canonical mesh and skeleton (paper, section 3.1): where they come from and how they load."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from soma_core.rig.canonical import load_canonical
    from soma_core.rig.mesh import CanonicalMesh, Lod
    from soma_core.rig.skeleton import Rig

__all__ = ["CanonicalMesh", "Lod", "Rig", "load_canonical"]

_HOMES = {
    "CanonicalMesh": "soma_core.rig.mesh",
    "Lod": "soma_core.rig.mesh",
    "Rig": "soma_core.rig.skeleton",
    "load_canonical": "soma_core.rig.canonical",
}


def __getattr__(name: str) -> object:
    """Load a public name on first use, so that importing a part stays cheap."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
