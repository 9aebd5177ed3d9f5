"""Procedural joints: joints that no pose controls, placed and turned by the joints that it does."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import scipy.sparse

__all__ = [
    "MODES",
    "ProceduralDefinition",
    "ProceduralRig",
    "TwistMode",
    "TwistSegment",
    "effective_weights",
    "fold_weights",
]

_LEAST_WEIGHT = 2.0**-24
"""Half of the spacing of float32 above one."""

TwistMode = Literal["local_x_euler", "local_x_swing_twist", "aligned_x_swing_twist"]
"""How a twist angle is read from a posed joint; see :mod:`soma_core.animation.twist`."""

MODES: tuple[TwistMode, ...] = get_args(TwistMode)


@dataclass(frozen=True, kw_only=True)
class TwistSegment:
    """A bone whose skin twists along it.

    Attributes:
        start, end: joints at its two ends; the helpers are children of `start`.
        helpers: names of its procedural joints, from start to end.
        reverse: the helpers also undo the twist that `start` itself makes against `parent`.
        parent: joint against which the twist of `start` is measured; None where it is not needed.
        axis: 0, 1 or 2, the axis of the joints' own frames that the segment twists about.
        sign: 1 or -1, the direction of a positive twist about that axis.
    """

    start: str
    end: str
    helpers: tuple[str, ...]
    reverse: bool = False
    parent: str | None = None
    axis: int = 0
    sign: int = 1


@dataclass(frozen=True, kw_only=True)
class ProceduralDefinition:
    """What ``SOMA_procedural_transforms.json`` says, checked.

    Attributes:
        main_joints: names of the public joints, in the order of a pose.
        segments: the twisting bones.
        modes: how the twist of each helper is read.
        rotation: helper -> {public joint -> factor of its twist channel in the helper's angle}.
        translation: helper -> {public joint or helper -> share of its bind position}; shares sum to 1.
        joint_count: number of joints of the skeleton it was made for, where it says so.
    """

    main_joints: tuple[str, ...]
    segments: tuple[TwistSegment, ...]
    modes: Mapping[str, TwistMode]
    rotation: Mapping[str, Mapping[str, float]]
    translation: Mapping[str, Mapping[str, float]]
    joint_count: int | None = None

    @property
    def helpers(self) -> tuple[str, ...]:
        """Names of all procedural joints, segment by segment."""
        return tuple(name for segment in self.segments for name in segment.helpers)

    def segment_of(self, helper: str) -> TwistSegment:
        """The segment that a helper belongs to."""
        return next(segment for segment in self.segments if helper in segment.helpers)

    def place(self, joint_names: tuple[str, ...]) -> np.ndarray:
        """Matrix (H, J) that makes the helpers' bind positions of those of the public joints.

        Rows are in the order of `helpers`, columns in that of `joint_names`. A helper placed by another
        helper is followed to the public joints.
        """
        names = self.helpers
        public = np.zeros((len(names), len(joint_names)))
        chained = np.zeros((len(names), len(names)))
        for row, helper in enumerate(names):
            for column, share in self.translation.get(helper, {}).items():
                if column in names:
                    chained[row, names.index(column)] = share
                else:
                    public[row, joint_names.index(column)] = share
        total = public
        for _ in names:  # as long as the longest chain can be
            total = public + chained @ total
        return total


def fold_weights(weights: scipy.sparse.csr_array, target: np.ndarray, count: int) -> scipy.sparse.csr_array:
    """Add each column of skin weights (v, n) to its target column: (v, count)."""
    moves = (np.ones(len(target)), (np.arange(len(target)), target))
    folded = scipy.sparse.csr_array(weights @ scipy.sparse.csr_array(moves, shape=(len(target), count)))
    folded.sort_indices()
    return folded


def effective_weights(weights: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Drop the skin weights that float32 rounds away beside one; rows sum to one again.

    Painting tools store weights down to 1e-45: a fifth of this rig's, in two fifths of the pairs of joints
    that a fit sums over. All that a vertex loses moves it by less than a micrometre.
    """
    kept = weights.copy()
    kept.data[kept.data < _LEAST_WEIGHT] = 0.0
    kept.eliminate_zeros()
    return scipy.sparse.csr_array(scipy.sparse.diags_array(1.0 / kept.sum(axis=1)) @ kept)


@dataclass(frozen=True, kw_only=True, eq=False)
class ProceduralRig:
    """Procedural joints of a rig and the skin weights that include them.

    Attributes:
        joint_names: H names, those of `definition.helpers`.
        start_joints: (H,) int32, the public joint that carries each helper.
        bind_world: (H, 4, 4) float64 world transforms of the bind pose [m].
        weights: (v, J + H) scipy CSR float64, columns in the order public joints, helpers; summed back onto
            the start joints they are the rig's own weights.
        definition: what drives the helpers.
    """

    joint_names: tuple[str, ...]
    start_joints: np.ndarray
    bind_world: np.ndarray
    weights: scipy.sparse.csr_array
    definition: ProceduralDefinition

    @functools.cached_property
    def skin(self) -> scipy.sparse.csr_array:
        """The weights that move a vertex, (v, J + H) CSR; see :func:`effective_weights`."""
        return effective_weights(self.weights)
