"""A motion on the canonical skeleton, independent of any identity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

__all__ = ["Convention", "Motion"]

Convention = Literal["t_pose_relative", "absolute_local"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Joint rotations over time.

    Attributes:
        rotations: (frames, 77, 3, 3) float32 matrices, user-joint order (Hips first).
        translation: (frames, 3) float32 Hips world position [m], +Y up; it replaces the rest position.
        fps: frames per second.
        joint_names: 77 names.
        convention: ``t_pose_relative`` (zero is the T-pose) or ``absolute_local``.
        rig_revision: revision of the rig the rotations were made for, empty if unknown.
        source: where the motion came from.
        identity: optional backend name and parameters it was recorded with.
    """

    rotations: np.ndarray
    translation: np.ndarray
    fps: float
    joint_names: tuple[str, ...]
    convention: Convention = "t_pose_relative"
    rig_revision: str = ""
    source: str = ""
    identity: Mapping[str, object] = field(default_factory=dict)

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.rotations)
