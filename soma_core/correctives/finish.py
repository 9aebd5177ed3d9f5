"""From a trained first stage to a checkpoint: the second stage solved for every vertex, and pruned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import torch

from soma_core.correctives.data import LessonStore, Taught
from soma_core.correctives.features import local_bind_rotations
from soma_core.correctives.limb_twist import slope_changes
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.correctives.second_stage import accumulate, all_entries, pruned, to_matrix
from soma_core.correctives.weights import CorrectiveWeights
from soma_core.errors import InputError
from soma_core.rig.skeleton import Rig

__all__ = ["Masks", "entry_budget", "finished"]

_CM_PER_M = 100.0
_ENTRY_BYTES, _MASK_BYTES, _FIRST_BYTES, _REST_BYTES = 10, 5, 8, 65536
"""What a checkpoint spends: a vertex of an activation, a pair of M2, a weight of W1, everything else."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Masks:
    """Both masks on the mid LOD; see :mod:`soma_core.correctives.masks`."""

    joints: np.ndarray
    vertices: scipy.sparse.csr_array


def entry_budget(mebibytes: float, masks: Masks, channels: int) -> int:
    """How many vertices all activations together may move in a file of that size.

    Raises:
        InputError: the masks alone need more.
    """
    fixed = masks.vertices.nnz * _MASK_BYTES + int(masks.joints.sum()) * 6 * channels * _FIRST_BYTES
    left = int(mebibytes * 2**20) - fixed - _REST_BYTES
    if left < _ENTRY_BYTES:
        raise InputError(
            "mebibytes",
            got=mebibytes,
            expected=f"more than the {(fixed + _REST_BYTES) / 2**20:.2f} MiB of masks and first stage",
            fix="Raise it, or lower channels or reach.",
        )
    return left // _ENTRY_BYTES


@torch.no_grad()
def finished(
    network: CorrectivesNetwork,
    masks: Masks,
    store: LessonStore,
    clips: Sequence[Taught],
    rig: Rig,
    *,
    ridge: float,
    smoothness: float,
    budget: int,
    mirror: bool,
    meta: Mapping[str, Any],
) -> CorrectiveWeights:
    """Solve the second stage for all vertices of the mid LOD, keep what matters, and put the model together.

    Given the activations the offsets are linear in the second stage, so that its best value is known in
    closed form: gradient descent is left with the first stage, and with fewer vertices.

    Args:
        network: trained, on any level of detail.
        masks: of the mid LOD.
        store, clips: what it was trained on.
        rig: of the mid LOD.
        ridge, budget: see :func:`second_stage.pruned`.
        smoothness: weight of :func:`limb_twist.slope_changes` beside the squared error [rad^2].
        mirror: learn from mirror images as well.
        meta: what the checkpoint says about itself.
    """
    count = masks.vertices.shape[1]
    everywhere = CorrectivesNetwork(masks.joints, masks.vertices, channels=network.channels, seed=0)
    everywhere.first.copy_(network.first.cpu())
    sizes, moved = list(everywhere.sizes), everywhere.vertices
    lessons = (store.read(clip, np.arange(count), mirrored=mirror) for clip in clips)
    samples = ((everywhere.activations(lesson.features), _CM_PER_M * lesson.offsets) for lesson in lessons)
    normal = accumulate(samples, sizes, moved, network.channels)
    gram = normal.gram
    if smoothness:
        copies = 2 if mirror else 1  # as many poses as the lessons
        motions = (store.rotations(clip) for clip in clips)
        bent = slope_changes(everywhere, rig, motions, np.random.default_rng(0))
        gram = gram + smoothness * copies * bent
    strength = everywhere.strength.double().numpy()
    entries = all_entries(normal, moved.numpy(), sizes, strength, network.channels)
    entries, values = pruned(gram, entries, ridge=ridge, budget=budget)
    shape = (network.joint_count * network.channels, 3 * count)
    second = to_matrix(entries, values / _CM_PER_M, everywhere.joints, network.channels, shape)
    return CorrectiveWeights(
        channels=network.channels,
        use_tanh=True,
        bind_pose=local_bind_rotations(rig),
        first=everywhere.first_matrix(),
        second=second,
        joint_mask=scipy.sparse.csr_array(masks.joints.astype(float)),
        vertex_mask=scipy.sparse.csr_array((masks.vertices > 0).astype(float)),
        meta=meta,
    )
