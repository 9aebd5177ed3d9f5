"""Body regions by which errors of a fit are reported (paper, table 3 and section 4.2)."""

from __future__ import annotations

import re

import numpy as np

from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["REGIONS", "body_regions", "shoulder_region"]

REGIONS = ("body", "hands", "feet", "head")
"""Regions of the paper's table 3; together they are the whole skin."""

_JOINTS = {
    "hands": r"(Left|Right)Hand\w*",
    "feet": r"(Left|Right)(Foot|Toe\w+)",
    "head": r"Head(End)?|Jaw|(Left|Right)Eye",
}
"""Joints that carry a region; every other joint carries the body."""

_SHOULDER_SHARE = 0.25
"""Least skin weight of a shoulder joint on the vertices that its rotation visibly moves."""


def body_regions(mesh: CanonicalMesh, rig: Rig) -> dict[str, np.ndarray]:
    """Vertex ids of each region and of ``face_interior``; every vertex is in one of them.

    A vertex belongs to the region whose joints carry most of its skin weight, except the mouth and eye bags,
    which a fit is not asked to explain. Regions without a vertex are left out.
    """
    shares = np.zeros((mesh.vertex_count, len(REGIONS)))
    for joint, name in enumerate(rig.joint_names):
        region = next((key for key, pattern in _JOINTS.items() if re.fullmatch(pattern, name)), "body")
        shares[:, REGIONS.index(region)] += rig.weights[:, [joint]].toarray()[:, 0]
    owner = shares.argmax(axis=1)
    owner[mesh.face_interior] = len(REGIONS)
    names = (*REGIONS, "face_interior")
    found = {name: np.flatnonzero(owner == index) for index, name in enumerate(names)}
    return {name: ids for name, ids in found.items() if len(ids)}


def shoulder_region(rig: Rig) -> np.ndarray:
    """Ids of the skin that moves with either shoulder joint, where a bad fit pops (section 4.2)."""
    joints = [joint for joint, name in enumerate(rig.joint_names) if name.endswith("Shoulder")]
    if not joints:
        return np.empty(0, np.int64)
    return np.flatnonzero(rig.weights[:, joints].toarray().max(axis=1) >= _SHOULDER_SHARE)
