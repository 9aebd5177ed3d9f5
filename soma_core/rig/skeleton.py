"""The canonical rig: joints, bind pose, T-pose and skin weights (paper, sections 3.1 and 3.4)."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from soma_core.rig.procedural import ProceduralRig, effective_weights, fold_weights

__all__ = ["Rig"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A skeleton bound to the canonical mesh. Joint 0 is the virtual Root.

    Attributes:
        joint_names: J names; parents come before children.
        parents: (J,) int32, -1 for the root.
        bind_world: (J, 4, 4) float64 world transforms of the bind pose, translation in metres,
            rotations in SO(3) to rounding.
        t_pose_world: (J, 4, 4) float64 world transforms of the T-pose [m].
        bind_shape: (v, 3) float64 [m].
        weights: (v, J) scipy CSR float64, rows sum to 1, every non-zero influence kept.
        revision: first 16 hex digits of the rig hash (with ``-low`` for a derived LOD).
        procedural: twist joints that no pose controls, where the rig has any; the fields above are those
            of the rig without them.
    """

    joint_names: tuple[str, ...]
    parents: np.ndarray
    bind_world: np.ndarray
    t_pose_world: np.ndarray
    bind_shape: np.ndarray
    weights: scipy.sparse.csr_array
    revision: str
    procedural: ProceduralRig | None = None

    @property
    def joint_count(self) -> int:
        """Number of joints, Root included."""
        return len(self.joint_names)

    @property
    def user_joint_names(self) -> tuple[str, ...]:
        """Names of the joints that a pose controls: all but Root."""
        return self.joint_names[1:]

    @functools.cached_property
    def skin(self) -> scipy.sparse.csr_array:
        """The weights that move a vertex, (v, J) CSR; those of twist joints go to their start joints."""
        if self.procedural is None:
            return effective_weights(self.weights)
        places = np.append(np.arange(self.joint_count), self.procedural.start_joints)
        return fold_weights(self.procedural.skin, places, self.joint_count)
