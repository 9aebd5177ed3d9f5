"""Between a skeleton with procedural joints and the public one: placing helpers, and folding them away."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError
from soma_core.rig.procedural import ProceduralDefinition, ProceduralRig
from soma_core.rig.skeleton import Rig
from soma_core.rig.stored import StoredRig
from soma_core.rig.transforms import fused_product

__all__ = ["expanded_rig", "helper_bind", "helper_transforms", "public_rig", "with_helpers"]


def helper_transforms(world: np.ndarray, definition: ProceduralDefinition) -> np.ndarray:
    """Place helpers on their segments, turned as their start joints, bit by bit alike everywhere: (H, 4, 4).

    Args:
        world: (J, 4, 4) world transforms of the public joints, in the order of `main_joints`.
        definition: says where they sit.
    """
    names = definition.main_joints
    starts = [names.index(definition.segment_of(helper).start) for helper in definition.helpers]
    placed = world[starts].copy()
    placed[:, :3, 3] = fused_product(definition.place(names), world[:, :3, 3])
    return placed


def public_rig(path: Path, stored: StoredRig, definition: ProceduralDefinition) -> StoredRig:
    """Fold every joint that no pose controls into its nearest public ancestor.

    Raises:
        AssetError: the skeleton lacks a public joint or a twist joint of the definition, or has another
            number of joints than it was made for.
    """
    fix = "Use the definition that was made for this rig"
    count = len(stored.joint_names)
    if definition.joint_count not in (None, count):
        cause = f"the skeleton has {count} joints, the definition is for {definition.joint_count}"
        raise AssetError(path, cause=cause, fix=fix)
    missing = [
        name for name in (*definition.main_joints, *definition.helpers) if name not in stored.joint_names
    ]
    if missing:
        cause = f"the skeleton lacks {len(missing)} joints of the procedural definition, first {missing[0]}"
        raise AssetError(path, cause=cause, fix=fix)
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


def helper_bind(rig: Rig, bind_world: np.ndarray) -> np.ndarray:
    """Bind transforms (H, 4, 4) of the helpers of an identity, from those of its public joints (J, 4, 4) [m].

    Placed by the definition, turned against their start joints as in the rig.
    """
    procedural = rig.procedural
    assert procedural is not None
    starts = procedural.start_joints
    placed = bind_world[starts].copy()
    template = np.swapaxes(rig.bind_world[starts, :3, :3], -1, -2)
    placed[:, :3, :3] @= template @ procedural.bind_world[:, :3, :3]
    placed[:, :3, 3] = procedural.definition.place(rig.joint_names) @ bind_world[:, :3, 3]
    return placed


def expanded_rig(rig: Rig) -> Rig:
    """The rig with its helpers as ordinary joints after the public ones, for files that know no others."""
    procedural = rig.procedural
    assert procedural is not None
    bind, t_pose = (
        np.concatenate([world, helper_bind(rig, world)]) for world in (rig.bind_world, rig.t_pose_world)
    )
    return Rig(
        joint_names=(*rig.joint_names, *procedural.joint_names),
        parents=np.concatenate([rig.parents, procedural.start_joints]).astype(np.int32),
        bind_world=bind,
        t_pose_world=t_pose,
        bind_shape=rig.bind_shape,
        weights=procedural.weights,
        revision=rig.revision,
    )
