"""The forward pose in two kernels, for CUDA and where no gradient is asked (paper, section 3.5)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.engine import Animation, ProceduralAnimation
from soma_core.animation.posed import Posed
from soma_core.animation.twist import Twist
from soma_core.correctives.model import Correctives
from soma_core.kernels._posing_text import BODY_INTS, BODY_REALS, JOINT_LIMIT
from soma_core.kernels.patches import Patches, side_by_side
from soma_core.skeleton.identity import Identity

__all__ = ["FusedPose"]


class FusedPose(torch.nn.Module):
    """Poses bodies as ``ProceduralAnimation`` with ``Correctives`` does, without their derivative.

    Args:
        posing: joint tree, skin weights and twist joints.
        correctives: added on the way to the skin, or None.
        dtype, device: of constants and results.

    Attributes:
        fits: whether the rig and the correctives fit into the kernels' shared memory.
    """

    def __init__(
        self,
        posing: Animation,
        correctives: Correctives | None,
        *,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        twist = posing.twist if isinstance(posing, ProceduralAnimation) else None
        second = None if correctives is None else correctives.second.scipy()
        weights = posing.posed_skinning.weights.scipy()
        self.helper_count = 0 if twist is None else len(twist.start)
        self.activation_count = 0 if correctives is None else correctives.first.shape[0]
        ints, reals = _body_tables(posing, twist, correctives)
        self.register_buffer("ints", torch.as_tensor(ints).to(device, torch.int32), persistent=False)
        self.register_buffer("reals", torch.as_tensor(reals).to(device, dtype), persistent=False)
        self.patches = Patches(weights, second, dtype=dtype, device=device)
        channels = 0 if twist is None else len(twist.joint)
        self.fits = self.patches.fits and max(posing.kinematics.joint_count, channels) <= JOINT_LIMIT

    def forward(
        self,
        identity: Identity,
        rotations: Tensor,
        translation: Tensor,
        *,
        absolute: bool,
        bone_scale: Tensor | None = None,
    ) -> Posed:
        """Posed bodies; what is given is already checked.

        Args:
            identity: of batch 1 or B.
            rotations: axis-angle [rad] (B, J - 1, 3) or matrices (B, J - 1, 3, 3); a batch of 1 or an
                expanded one is not copied.
            translation: Hips positions (B, 3) [m]; B is the batch that comes out.
            absolute: `rotations` are local rotations of the rig's own axes.
            bone_scale: (1 or B, J - 1).
        """
        from soma_core.kernels.fused_pose_wp import pose_bodies, skin_patches

        world, joints, skin, active = pose_bodies(
            rotations, translation, identity.bind_world, bone_scale, self.ints, self.reals,
            batch=len(translation), helpers=self.helper_count, activations=self.activation_count,
            absolute=absolute,
        )  # fmt: skip
        tables = self.patches
        vertices = skin_patches(
            identity.rest, skin, active if self.activation_count else None, tables.ints, tables.shorts,
            tables.reals, patches=tables.count,
        )  # fmt: skip
        return Posed(vertices=vertices, joints=joints, transforms=world)


def _body_tables(
    posing: Animation, twist: Twist | None, correctives: Correctives | None
) -> tuple[np.ndarray, np.ndarray]:
    """Constants of the first kernel: integers, behind a header that says where each begins; numbers."""
    kinematics = posing.kinematics
    tables = dict.fromkeys((*BODY_INTS, *BODY_REALS), np.zeros(0))
    sizes = kinematics.level_sizes
    tables |= {
        "order": _host(kinematics.order)[1:],
        "level_start": np.concatenate(([0], np.cumsum(sizes))),
        "parents": _host(kinematics.tree),
        "orient": _host(kinematics.orient),
        "parent_orient": _host(kinematics.parent_orient),
        "bone_length": np.ones(1),
    }
    channels = 0
    if twist is not None:
        channels = len(twist.joint)
        tables |= _twist_tables(twist)
    activations, bounded = 0, False
    if correctives is not None:
        activations, bounded = correctives.first.shape[0], correctives.use_tanh
        first = correctives.first.scipy()
        rows = np.concatenate((np.arange(activations), np.full(-activations % 32, -1)))
        start, ids, values = side_by_side(first.indptr.astype(np.int64), first.indices, first.data, rows)
        tables |= {
            "left": _host(correctives.features.left),
            "right": _host(correctives.features.right),
            "first_start": start,
            "first_id": ids,
            "first_value": values,
            "bone_length": np.array([correctives.length]),
        }
    helpers = 0 if twist is None else len(twist.start)
    counts = (kinematics.joint_count, helpers, channels, activations, len(sizes), int(bounded))
    header = len(counts) + len(BODY_INTS) + len(BODY_REALS)
    starts = [
        first + np.cumsum([0, *(tables[name].size for name in names)])[:-1]
        for names, first in ((BODY_INTS, header), (BODY_REALS, 0))
    ]
    ints = (counts, *starts, *(tables[name].ravel() for name in BODY_INTS))
    return np.concatenate(ints).astype(np.int64), np.concatenate([tables[n].ravel() for n in BODY_REALS])


def _twist_tables(twist: Twist) -> dict[str, np.ndarray]:
    aligned, swing, euler = twist.counts
    tables = {
        name: _host(getattr(twist, name))
        for name in ("start", "end_user", "axis", "joint", "reference", "low", "high", "source_axis")
    }
    tables["mode"] = np.repeat([0, 1, 2], twist.counts)
    # Tables of Euler channels alone are as long as those of all.
    tables["euler_axis"] = np.concatenate((np.zeros(aligned + swing), _host(twist.euler_axis)))
    tables["euler_sign"] = np.concatenate((np.ones(aligned + swing), _host(twist.euler_sign)))
    assert len(tables["euler_axis"]) == aligned + swing + euler
    for name in ("place", "mix"):
        dense = _host(getattr(twist, name))
        row, column = np.nonzero(dense)
        counts = np.bincount(row, minlength=len(dense))
        tables[f"{name}_start"] = np.concatenate(([0], np.cumsum(counts)))
        tables[f"{name}_id"], tables[f"{name}_value"] = column, dense[row, column]
    return tables


def _host(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
