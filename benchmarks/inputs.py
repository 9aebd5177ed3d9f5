"""Inputs that every implementation is given: drawn once, from one seed, as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["PHENOTYPES", "forward_inputs", "own_motion", "own_rig_meshes"]

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


def _phenotypes(who: str) -> np.ndarray:
    """Values (1, 6) of one of the bodies of the experiments."""
    from soma_core.evaluation.inversion_sequences import ANNY_IDENTITIES

    return np.array([[ANNY_IDENTITIES[who][name] for name in PHENOTYPES]], np.float32)


def own_motion(count: int, seed: int) -> dict[str, np.ndarray]:
    """A smooth motion: poses (count, 77, 3) [rad], translations (count, 3) [m], phenotypes (1, 6)."""
    from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
    from soma_core.rig import load_canonical

    random = np.random.default_rng([seed, 1])
    names = load_canonical("mid")[1].user_joint_names
    drift = np.cumsum(0.01 * random.standard_normal((count, 3)), axis=0)
    return {
        "poses": smooth_axis_angles(joint_spread(names), count, random).astype(np.float32),
        "translation": (np.array([0.1, 0.95, 0.0]) + drift).astype(np.float32),
        "phenotypes": _phenotypes("man"),
    }


def own_rig_meshes(count: int, seed: int) -> dict[str, dict[str, np.ndarray]]:
    """Meshes posed by the anny package's own rig, on the canonical mesh: vertices (count, v, 3) [m]."""
    import torch

    from soma_core.evaluation.inversion_sequences import anny_meshes
    from soma_core.plugin.registry import default_registry
    from soma_core.rig import load_canonical
    from soma_core.topology.correspondence import load_correspondence
    from soma_core.topology.transfer import make_transfer

    mesh, _ = load_canonical("mid")
    spec = default_registry().spec("anny")
    correspondence = load_correspondence(spec.wrap, mesh)
    transfer = make_transfer(spec, mesh, correspondence, dtype=torch.float32, device="cpu")
    found = {}
    for moving in anny_meshes(count, seed):
        who = moving.name.rpartition(" ")[2]
        found[who] = {"vertices": transfer(moving.vertices).numpy(), "phenotypes": _phenotypes(who)}
    return found
