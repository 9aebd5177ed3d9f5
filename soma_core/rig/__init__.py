"""The canonical mesh and skeleton (paper, section 3.1): where they come from and how they load."""

from __future__ import annotations

from typing import TYPE_CHECKING

from soma_core._lazy import lazy_names

if TYPE_CHECKING:
    from soma_core.rig.canonical import load_canonical
    from soma_core.rig.mesh import CanonicalMesh, Lod
    from soma_core.rig.skeleton import Rig

__all__ = ["CanonicalMesh", "Lod", "Rig", "load_canonical"]

_HOMES = {
    "soma_core.rig.canonical": ["load_canonical"],
    "soma_core.rig.mesh": ["CanonicalMesh", "Lod"],
    "soma_core.rig.skeleton": ["Rig"],
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
