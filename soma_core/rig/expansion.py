"""Between a skeleton with procedural joints and the public one: adding helpers, and folding them away."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from soma_core.rig.procedural import ProceduralDefinition, ProceduralRig
from soma_core.rig.skeleton import Rig
from soma_core.rig.twist_weights import spread_weights

__all__ = ["expand_rig", "helper_transforms"]


def helper_transforms(world: np.ndarray, definition: ProceduralDefinition) -> np.ndarray:
    """Place helpers on their segments, turned as their start joints: (H, 4, 4).

    Args:
        world: (J, 4, 4) world transforms of the public joints, in the order of `main_joints`.
    """
    names = definition.main_joints
    starts = [names.index(definition.segment_of(helper).start) for helper in definition.helpers]
    placed = world[starts].copy()
    placed[:, :3, 3] = definition.place(names) @ world[:, :3, 3]
    return placed


def expand_rig(rig: Rig, definition: ProceduralDefinition) -> ProceduralRig:
    """Add the helpers of a definition to a rig without any, its weights spread over them.

    Args:
        rig: its joints are the definition's `main_joints`, in that order.
    """
    names = definition.main_joints
    assert rig.joint_names == names
    single = scipy.sparse.csr_array(rig.weights, dtype=np.float32).astype(np.float64)
    spread = spread_weights(single, rig.bind_shape, rig.bind_world[:, :3, 3], definition)
    starts = [names.index(definition.segment_of(helper).start) for helper in definition.helpers]
    return ProceduralRig(
        joint_names=definition.helpers,
        start_joints=np.array(starts, np.int32),
        bind_world=helper_transforms(rig.bind_world, definition),
        weights=spread,
        definition=definition,
    )
