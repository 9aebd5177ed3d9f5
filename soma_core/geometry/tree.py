"""Trees of joints, given by the parent of each: -1 for a root."""

from __future__ import annotations

import numpy as np

__all__ = ["depth_order", "descendants", "joint_levels"]


def _depths(parents: np.ndarray) -> np.ndarray:
    """Steps from each joint (J,) up to its root; parents may come after their children."""
    above = parents.astype(np.int64)
    depths = np.zeros(len(parents), np.int64)
    while (above >= 0).any():
        depths += above >= 0
        above = np.where(above >= 0, parents[above], -1)
    return depths


def depth_order(parents: np.ndarray) -> np.ndarray:
    """Return the stable order of joints by depth, so that parents come before children."""
    return np.argsort(_depths(parents), kind="stable")


def joint_levels(parents: np.ndarray) -> list[np.ndarray]:
    """Joint ids by depth below the root, root left out; every parent lies on the level before."""
    depths = _depths(parents)
    return [np.flatnonzero(depths == level) for level in range(1, depths.max() + 1)]


def descendants(parents: np.ndarray) -> np.ndarray:
    """(J, J) booleans: row j marks joint j and all below it; parents come before children."""
    below = np.eye(len(parents), dtype=bool)
    for joint in range(len(parents) - 1, -1, -1):
        if parents[joint] >= 0:
            below[parents[joint]] |= below[joint]
    return below
