"""Angles between rotations, and how far joints turn from frame to frame beyond what was true."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from soma_core.evaluation.anny_rig import BONES_OF, AnnyClip
from soma_core.layer import SomaLayer

__all__ = ["TurnExcess", "angles_between", "bone_turns", "own_turns", "turn_excess", "world_turns"]


@dataclass(frozen=True, kw_only=True, eq=False)
class TurnExcess:
    """The joint and frame that turn farthest beyond the truth.

    Attributes:
        joint: its name.
        excess: how far it turned beyond the truth [degrees].
        true: the true turn [degrees].
    """

    joint: str
    excess: float
    true: float


def angles_between(first: Tensor, second: Tensor) -> np.ndarray:
    """Angles (...) [degrees] between rotations (..., 3, 3)."""
    difference = first.detach().cpu().double() - second.detach().cpu().double()
    chord = difference.square().sum((-1, -2)).sqrt() / (2 * 2**0.5)
    return np.degrees(2 * np.arcsin(chord.clamp(max=1).numpy()))


def world_turns(layer: SomaLayer, rotations: Tensor) -> Tensor:
    """Turns (F, J - 1, 3, 3) in the world from the T-pose, of T-pose-relative rotations of the same shape."""
    found: list[Tensor] = []
    for joint, parent in enumerate(layer.rig.parents[1:]):
        own = rotations[:, joint]
        found.append(own if parent <= 0 else found[parent - 1] @ own)
    return torch.stack(found, 1)


def own_turns(layer: SomaLayer, rotations: Tensor) -> dict[str, np.ndarray]:
    """Body joint -> how far it turns in the world between frames (F - 1,) [degrees]."""
    turns = world_turns(layer, rotations)
    numbers = {joint: layer.joint_names.index(joint) for joint in BONES_OF}
    return {joint: angles_between(turns[1:, number], turns[:-1, number]) for joint, number in numbers.items()}


def bone_turns(clip: AnnyClip) -> dict[str, np.ndarray]:
    """Body joint -> how far the bone of Anny that carries its skin turns between frames (F - 1,) [degrees].

    Of several bones the one that turns most.
    """
    turned = angles_between(clip.bones[1:], clip.bones[:-1])
    return {
        joint: turned[:, [clip.names.index(bone) for bone in bones]].max(axis=1)
        for joint, bones in BONES_OF.items()
    }


def turn_excess(layer: SomaLayer, rotations: Tensor, true: Mapping[str, np.ndarray]) -> TurnExcess:
    """Compare the turns of fitted rotations (F, J - 1, 3, 3) with true ones, of body joints in the world."""
    worst = TurnExcess(joint="", excess=-np.inf, true=0.0)
    for joint, own in own_turns(layer, rotations).items():
        beyond = own - true[joint]
        frame = int(beyond.argmax())
        if beyond[frame] > worst.excess:
            worst = TurnExcess(joint=joint, excess=float(beyond[frame]), true=float(true[joint][frame]))
    return worst
