"""How a posed mesh is strained against a rest shape, without a pose: clouds of skin that hang on a joint."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["MEAN_OF_NOISE", "CloudStrain", "SkinClouds"]

_PURE = 0.6
"""Least weight of a joint on the vertices of its cloud: more bends, less leaves few vertices."""

_LEAST_VERTICES, _LEAST_EXTENT = 20, 0.1
"""A cloud has this many vertices, and this extent over that of the body: 20 mm of noise drowns a finger."""

_RIDGE = 0.02
"""Of a cloud's mean variance, added to each direction: a tube of skin says little across itself."""

_APART, _APART_NOISE, _MOST_NOISE = 0.25, 7.0, 0.12
"""A vertex is apart whose edges are longer than at rest by these shares of the body's size or the noise. What
looks like noise of more than 0.12 of the size is none: 20 mm on a newborn are 0.1."""

_TRUNK = ("Hips", "Spine1", "Spine2", "Chest")
MEAN_OF_NOISE = 1.596
"""Mean length of a vector of three standard normal numbers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudStrain:
    """What is seen of F frames in S clouds.

    Attributes:
        stretch: change of each cloud's shape, (F, S, 3, 3) [m], in the axes of the rest shape: its Frobenius
            norm is the root mean square length by which the best affine map departs from a turn.
        mirrored: share of clouds that are mirrored, (F,).
        upward: direction of the trunk that is up at rest, (F, 3), of unit length.
        noise: standard deviation of a coordinate about the affine maps [m].
        counts: vertices of the clouds, (S,).
        size: root mean square distance of the rest vertices from their centre [m].
        scale: size of the body over that of the rest shape, by its clouds.
        apart: share of vertices most of whose edges are far too long in the median frame.
        displaced: median distance of neighbours from where the affine map takes them, in the mean over the
            frames, over the length of their edge; `displaced_by_chance` is what noise would make of it,
            infinite where one frame is all there is.
    """

    stretch: np.ndarray
    mirrored: np.ndarray
    upward: np.ndarray
    noise: float
    counts: np.ndarray
    size: float
    scale: float
    apart: float
    displaced: float
    displaced_by_chance: float

    def of(self, frames: slice = slice(None)) -> float:
        """Root mean square strain of the median frame over all clouds [m], less what noise adds."""
        part = self.stretch[frames]
        return self._length(np.median(part, axis=0), len(part))

    def between(self, before: slice, after: slice) -> float:
        """Root mean square strain [m] between two ranges of frames of one length."""
        first, second = (np.median(self.stretch[part], axis=0) for part in (before, after))
        return self._length(second - first, len(self.stretch[before]) / 2)

    def _length(self, stretch: np.ndarray, frames: float) -> float:
        """Length of a change of shape (S, 3, 3) that is the median of some frames."""
        noise = 6 * self.noise**2 / self.counts / max(frames * 2 / np.pi, min(frames, 1))
        return float(np.sqrt(np.maximum((stretch**2).sum(axis=(1, 2)) - noise, 0).mean()))


class SkinClouds:
    """The clouds of a mesh: vertices that hang mostly on one joint, of large joints.

    Args:
        mesh, rig: of the layer.
    """

    def __init__(self, mesh: CanonicalMesh, rig: Rig) -> None:
        self._mesh, bind = mesh, np.asarray(rig.bind_shape, np.float64)
        self.skin = np.ones(mesh.vertex_count, bool)
        self.skin[mesh.face_interior] = False
        weights = rig.weights.toarray()
        owner, pure = weights.argmax(axis=1), (weights.max(axis=1) >= _PURE) & self.skin
        self._clouds: dict[str, np.ndarray] = {}
        for joint, name in enumerate(rig.joint_names):
            ids = np.flatnonzero(pure & (owner == joint))
            if len(ids) >= _LEAST_VERTICES and _extent(bind[ids]) >= _LEAST_EXTENT * _extent(bind):
                self._clouds[name] = ids
        if not self._clouds:
            self._clouds["all"] = np.flatnonzero(self.skin)

    @functools.cached_property
    def edges(self) -> np.ndarray:
        """Edges of the skin, (e, 2) vertex ids."""
        pairs = np.concatenate([self._mesh.triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)
        return pairs[self.skin[pairs].all(axis=1)]

    def whole(self, vertices: np.ndarray) -> np.ndarray:
        """Which frames (F, v, 3) have a value for every vertex of the skin, and some extent."""
        skin = vertices[:, self.skin]
        finite = np.isfinite(skin).all(axis=(1, 2))
        spread = np.ptp(np.where(finite[:, None, None], skin, 0), axis=1).max(axis=1)
        return finite & (spread > 0)

    def strain(self, rest: np.ndarray, vertices: np.ndarray) -> CloudStrain:
        """Compare whole frames (F, v, 3) with a rest shape (v, 3) [m]."""
        size = _extent(rest[self.skin])
        maps = [_affine(rest[ids], vertices[:, ids]) for ids in self._clouds.values()]
        stretch, turns, mirrored, scales, spread = [], [], [], [], []
        for ids, (affine, residual) in zip(self._clouds.values(), maps, strict=True):
            left, values, right = np.linalg.svd(affine)
            pure = np.einsum("fji,fj,fjk->fik", right, values, right) - np.eye(3)
            stretch.append(pure @ _root_covariance(rest[ids]))
            turns.append(left @ right)
            mirrored.append(np.linalg.det(affine) < 0)
            shrunk = np.linalg.det(_affine(rest[ids], rest[None, ids])[0])  # by the ridge alone
            scales.append((np.log(np.maximum(values, 1e-6)).sum(axis=1) - np.log(shrunk)) / 3)
            spread.append(np.linalg.norm(residual, axis=2).mean(axis=1) / np.sqrt(1 - 4 / len(ids)))
        noise = float(np.median(spread) / MEAN_OF_NOISE)
        names = list(self._clouds)
        trunk = [names.index(name) for name in _TRUNK if name in names] or range(len(names))
        upward = np.mean([turns[index][:, :, 1] for index in trunk], axis=0)
        scale = float(np.exp(np.median(scales)))
        displaced, chance = self._displacement(rest, vertices, [affine for affine, _ in maps])
        return CloudStrain(
            stretch=np.stack(stretch, axis=1),
            mirrored=np.mean(mirrored, axis=0),
            upward=upward / np.maximum(np.linalg.norm(upward, axis=1, keepdims=True), 1e-12),
            noise=noise,
            counts=np.array([len(ids) for ids in self._clouds.values()]),
            size=size,
            scale=scale,
            apart=self._apart(max(scale, 1.0) * rest, vertices, max(scale, 1.0) * size, noise),
            displaced=displaced,
            displaced_by_chance=chance,
        )

    def _apart(self, rest: np.ndarray, vertices: np.ndarray, size: float, noise: float) -> float:
        """Share of vertices most of whose edges are far too long."""
        first, second = self.edges.T
        lengths = np.median([np.linalg.norm(one[first] - one[second], axis=1) for one in vertices], axis=0)
        usual = np.linalg.norm(rest[first] - rest[second], axis=1)
        wild = lengths > usual + max(_APART * size, _APART_NOISE * min(noise, _MOST_NOISE * size))
        count = np.bincount(self.edges.ravel(), minlength=len(rest))
        far = np.bincount(self.edges[wild].ravel(), minlength=len(rest))
        return float((far > count / 2).sum() / max((count > 0).sum(), 1))

    def _displacement(
        self, rest: np.ndarray, vertices: np.ndarray, maps: list[np.ndarray]
    ) -> tuple[float, float]:
        """How far neighbours lie from where their cloud's map takes them, and by how much noise would."""
        member = np.full(len(rest), -1)
        for index, ids in enumerate(self._clouds.values()):
            member[ids] = index
        one, other = member[self.edges].T
        first, second = self.edges[(one == other) & (one >= 0)].T
        if not len(first):
            return 0.0, 0.0
        affine = np.stack(maps, axis=1)
        left, _, right = np.linalg.svd(affine)
        mapped = np.einsum("feij,ej->fei", affine[:, member[first]], rest[first] - rest[second])
        off = vertices[:, first] - vertices[:, second] - mapped
        off = np.einsum("feij,fei->fej", (left @ right)[:, member[first]], off)
        length = np.maximum(np.median(np.linalg.norm(mapped, axis=2), axis=0), 1e-9)
        found = float(np.median(np.linalg.norm(off.mean(axis=0), axis=1) / length))
        if len(off) < 2:
            return found, np.inf
        error = np.sqrt(off.var(axis=0, ddof=1).sum(axis=1) / len(off))
        return found, float(np.median(error / length))


def _extent(points: np.ndarray) -> float:
    """Root mean square distance of points (n, 3) from their centre."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _root_covariance(points: np.ndarray) -> np.ndarray:
    """Symmetric square root (3, 3) of the covariance of points (n, 3)."""
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T


def _affine(rest: np.ndarray, posed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Best affine maps (F, 3, 3) of a cloud (n, 3) to its posed frames (F, n, 3), and what they leave."""
    source, target = rest - rest.mean(axis=0), posed - posed.mean(axis=1, keepdims=True)
    own = source.T @ source
    own = own + _RIDGE * np.trace(own) / 3 * np.eye(3)
    maps = np.einsum("fva,vb->fab", target, source) @ np.linalg.inv(own)
    return maps, target - source @ maps.transpose(0, 2, 1)
