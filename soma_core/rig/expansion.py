"""Between a skeleton with procedural joints and the public one: placing helpers, and folding them away."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError
from soma_core.rig.procedural import ProceduralDefinition, ProceduralRig
from soma_core.rig.skeleton import Rig
from soma_core.rig.stored import StoredRig

__all__ = ["helper_transforms", "public_rig", "with_helpers"]


def helper_transforms(world: np.ndarray, definition: ProceduralDefinition) -> np.ndarray:
    """Place helpers on their segments, turned as their start joints: (H, 4, 4).

    Args:
        world: (J, 4, 4) world transforms of the public joints, in the order of `main_joints`.
        definition: says where they sit.
    """
    names = definition.main_joints
    starts = [names.index(definition.segment_of(helper).start) for helper in definition.helpers]
    placed = world[starts].copy()
    placed[:, :3, 3] = definition.place(names) @ world[:, :3, 3]
    return placed


def public_rig(path: Path, stored: StoredRig, definition: ProceduralDefinition) -> StoredRig:
    """Fold every joint that no pose controls into its nearest public ancestor.

    Raises:
        AssetError: the skeleton lacks a public joint or a twist joint of the definition.
    """
    missing = [
        name for name in (*definition.main_joints, *definition.helpers) if name not in stored.joint_names
    ]
    if missing:
        cause = f"the skeleton lacks {len(missing)} joints of the procedural definition, first {missing[0]}"
        raise AssetError(path, cause=cause, fix="Use the definition that was made for this rig")
    return stored.keep(definition.main_joints)


def with_helpers(rig: Rig, stored: StoredRig, definition: ProceduralDefinition) -> Rig:
    """Give a rig the twist joints of the skeleton it was folded from.

    Joints that are neither public nor twist joints, as old templates have, stay folded away.

    Args:
        rig: made from :func:`public_rig`.
        stored: the skeleton with all its joints.
        definition: names the twist joints.
    """
    helpers = definition.helpers
    whole = stored.keep((*definition.main_joints, *helpers)).metric("")
    order = [whole.joint_names.index(name) for name in (*rig.joint_names, *helpers)]
    starts = [rig.joint_names.index(definition.segment_of(helper).start) for helper in helpers]
    weights = whole.weights[:, order]
    weights.sort_indices()
    procedural = ProceduralRig(
        joint_names=helpers,
        start_joints=np.array(starts, np.int32),
        bind_world=whole.bind_world[order[rig.joint_count :]],
        weights=weights,
        definition=definition,
    )
    return replace(rig, procedural=procedural)
