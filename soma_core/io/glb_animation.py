"""The animation of a GLB: transforms of its nodes and weights of its morph targets at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.io.glb_file import GlbFile

__all__ = ["NodeTracks"]

_MOST_MOVED = 10_000
"""Nodes that a body may hang on."""

_REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Track:
    """One animated value: times [s] and the value at each."""

    times: np.ndarray
    values: np.ndarray
    step: bool

    def at(self, times: np.ndarray) -> np.ndarray:
        """Values at `times`, held before the first key and after the last."""
        after = np.clip(np.searchsorted(self.times, times, side="right"), 1, max(len(self.times) - 1, 1))
        before = after - 1
        if len(self.times) == 1:
            return np.repeat(self.values, len(times), axis=0)
        share = (times - self.times[before]) / (self.times[after] - self.times[before])
        share = np.clip(share, 0, 1).reshape(-1, *[1] * (self.values.ndim - 1))
        share = np.floor(share) if self.step else share
        first, second = self.values[before], self.values[after]
        if self.values.shape[-1] == 4 and self.values.ndim == 2:  # quaternions: the shorter way round
            second = np.where((first * second).sum(-1, keepdims=True) < 0, -second, second)
        return (1 - share) * first + share * second


class NodeTracks:
    """Node transforms and morph weights of the file's only animation.

    Args:
        file: the file. At most one animation, keys interpolated linearly or in steps; else ValueError.
    """

    def __init__(self, file: GlbFile) -> None:
        document = file.document
        self._nodes: list[dict[str, Any]] = document.get("nodes", [])
        self._read: dict[int, np.ndarray] = {}
        self._tracks: dict[tuple[int, str], _Track] = {}
        animations = document.get("animations", [])
        if len(animations) > 1:
            raise ValueError(f"it holds {len(animations)} animations, expected one")
        for channel in animations[0]["channels"] if animations else ():
            sampler = animations[0]["samplers"][channel["sampler"]]
            self._add(file, channel["target"], sampler)
        self._order, self._parents = _top_down(self._nodes)

    def _add(self, file: GlbFile, target: dict[str, Any], sampler: dict[str, Any]) -> None:
        kind = sampler.get("interpolation", "LINEAR")
        if kind not in ("LINEAR", "STEP"):
            raise ValueError(f"it interpolates by {kind}, expected LINEAR or STEP")
        if "node" not in target:
            return
        times = self._numbers(file, sampler["input"])
        values = self._numbers(file, sampler["output"])
        if target["path"] == "weights":
            values = values.reshape(len(times), -1)
        if len(values) != len(times) or np.any(np.diff(times) <= 0):
            raise ValueError(f"the keys of node {target['node']} are out of order or incomplete")
        track = _Track(times=times, values=values, step=kind == "STEP")
        self._tracks[target["node"], target["path"]] = track

    def _numbers(self, file: GlbFile, index: int) -> np.ndarray:
        """Values of an accessor, which many tracks may share."""
        if index not in self._read:
            self._read[index] = file.fractions(index).astype(np.float64)
        return self._read[index]

    @property
    def times(self) -> np.ndarray:
        """Times [s] of the track with the most keys; empty without an animation."""
        return max((track.times for track in self._tracks.values()), key=len, default=np.empty(0))

    @property
    def turning(self) -> bool:
        """Whether the rotation of a node is animated."""
        return any(path == "rotation" for _, path in self._tracks)

    def moves(self, node: int) -> bool:
        """Whether the morph weights of a node are animated."""
        return (node, "weights") in self._tracks

    def weights(self, node: int, times: np.ndarray, count: int) -> np.ndarray:
        """Weights (times, count) of the morph targets of a node."""
        if self.moves(node):
            return self._tracks[node, "weights"].at(times)[:, :count]
        rest = np.asarray(self._nodes[node].get("weights", np.zeros(count)), np.float64)
        return np.tile(rest, (len(times), 1))

    def worlds(self, times: np.ndarray, nodes: Sequence[int] | None = None) -> np.ndarray:
        """World transforms (times, nodes, 4, 4) float64 of some nodes, in their order; None: of all."""
        wanted = range(len(self._nodes)) if nodes is None else nodes
        place = {node: row for row, node in enumerate(self._with_ancestors(wanted))}
        worlds = np.empty((len(times), len(place), 4, 4))
        for node, row in place.items():
            local, parent = self._local(node, times), self._parents[node]
            worlds[:, row] = local if parent < 0 else worlds[:, place[parent]] @ local
        return worlds[:, [place[node] for node in wanted]]

    def _with_ancestors(self, nodes: Sequence[int]) -> list[int]:
        """The nodes and all above them, parents before children."""
        needed: set[int] = set()
        for node in nodes:
            while node >= 0 and node not in needed:
                needed.add(node)
                node = self._parents[node]
        if len(needed) > _MOST_MOVED:
            raise ValueError(f"its body hangs on {len(needed)} nodes, more than {_MOST_MOVED}")
        return [node for node in self._order if node in needed]

    def _local(self, node: int, times: np.ndarray) -> np.ndarray:
        if "matrix" in self._nodes[node]:
            return np.tile(np.reshape(self._nodes[node]["matrix"], (4, 4)).T, (len(times), 1, 1))
        parts = {}
        for path, rest in _REST.items():
            track = self._tracks.get((node, path))
            still = np.asarray(self._nodes[node].get(path, rest), np.float64)[None]
            parts[path] = track.at(times) if track else np.repeat(still, len(times), axis=0)
        local = np.tile(np.eye(4), (len(times), 1, 1))
        local[:, :3, :3] = Rotation.from_quat(parts["rotation"]).as_matrix() * parts["scale"][:, None]
        local[:, :3, 3] = parts["translation"]
        return local


def _top_down(nodes: list[dict[str, Any]]) -> tuple[list[int], list[int]]:
    """Nodes with parents before children, and the parent of each (-1 for none)."""
    parents = [-1] * len(nodes)
    for index, node in enumerate(nodes):
        for child in node.get("children", ()):
            if child < 0:
                raise ValueError(f"node {index} has the child {child}")
            parents[child] = index
    order = [node for node, parent in enumerate(parents) if parent < 0]
    for parent in order:  # grows while it is walked
        order.extend(nodes[parent].get("children", ()))
        if len(order) > len(nodes):
            raise ValueError("a node has two parents")
    if len(order) < len(nodes):
        raise ValueError("nodes form a circle")
    return order, parents
