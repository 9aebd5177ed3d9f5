"""Inputs that every implementation is given: drawn once, from one seed, as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["PHENOTYPES", "forward_inputs"]

PHENOTYPES = ("gender", "age", "muscle", "weight", "height", "proportions")


def forward_inputs(joint_names: Sequence[str], batch: int, seed: int) -> dict[str, np.ndarray]:
    """Poses (batch, 77, 3) [rad], translations (batch, 3) [m], shape (batch, 128), phenotypes (batch, 6)."""
    from soma_core.evaluation.random_poses import random_axis_angles

    random = np.random.default_rng([seed, batch])
    return {
        "poses": random_axis_angles(joint_names, batch, random).astype(np.float32),
        "translation": (0.3 * random.standard_normal((batch, 3))).astype(np.float32),
        "shape": (0.5 * random.standard_normal((batch, 128))).astype(np.float32),
        "phenotypes": random.uniform(0, 1, (batch, len(PHENOTYPES))).astype(np.float32),
    }
