"""Fingers and toes of a surface: its extremities beyond wrist and instep, each given to one of the body's.

Extremities are the maxima of the geodesic distance from a cut across the limb. Their persistence, how far
the distance falls before one joins a higher one, tells them from knuckles and noise. Closest points cannot
tell a finger from its neighbour; bases and tips, fitted one to one, can.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from soma_core.geometry.mesh import triangle_sides, unique_edges
from soma_core.paths import shipped_assets
from soma_core.registration.surface import Surface
from soma_core.rig import load_canonical

__all__ = ["DIGITS", "LIMBS", "DigitGuide", "Digits", "Marks", "digit_guide"]

DIGITS = {
    "Hand": ("Thumb", "Index", "Middle", "Ring", "Pinky"),
    "Foot": ("BigToe", "SecondToe", "MiddleToe", "FourthToe", "LittleToe"),
}
LIMBS = ("LeftHand", "RightHand", "LeftFoot", "RightFoot")

_STANDS_OUT = 0.12
"""Persistence of an extremity, of the longest way from the cut: toes and fingers have 0.2, those of a fist
0.15, knuckles, noise and merged fingers up to 0.11."""

_RAMP = 0.3
"""Share of a digit's length from its base on which it becomes its own: bases are found less sharply."""

_PARTS = ((0.0, 0.3), (0.3, 0.6), (0.6, 0.85), (0.85, 1.01))
"""Parts of a digit, shares of its length, whose middles are fitted to each other."""

_TURN = 0.05
"""What a right angle between a hand and the fitted body's costs, of the size of the hand."""

_LINK = 0.15
"""What a pair of neighbours costs that have no web between them, of the size of the hand."""

_LENGTH = len("Hand")

Marks = tuple[np.ndarray, np.ndarray] | None
"""Landmarks: vertex ids (m,) and positions (m, 3)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Limb:
    """What lies beyond a cut.

    Attributes:
        root: (3,) [m] the middle of the cut.
        tips: (k,) ids of the vertices at the ends of its extremities.
        along: (k, n) of each extremity, 0 at its base and off it, 1 at its tip.
        links: pairs of extremities with a web between them.
    """

    root: np.ndarray
    tips: np.ndarray
    along: np.ndarray
    links: Set[frozenset[int]]

    def taken(self, order: Sequence[int]) -> _Limb:
        """The same with the extremities in an order."""
        place = {old: new for new, old in enumerate(order)}
        links = {frozenset(place[each] for each in pair) for pair in self.links}
        return _Limb(root=self.root, tips=self.tips[order], along=self.along[order], links=links)

    def rings(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (5 x 4, m) of the parts of each digit among the first `count`, and their shares."""
        found: list[np.ndarray] = []
        for tip, along in zip(self.tips, self.along[:, :count], strict=True):
            last = np.array([tip if tip < count else along.argmax()])
            rings = []
            for low, high in _PARTS[::-1]:  # a part without a vertex is where the next one is
                inside = np.flatnonzero((along > low) & (along <= high))
                last = inside if len(inside) else last
                rings.append(last)
            found += rings[::-1]
        ids = np.zeros((len(found), max(map(len, found))), np.int64)
        shares = np.zeros(ids.shape)
        for row, ring in enumerate(found):
            ids[row, : len(ring)], shares[row, : len(ring)] = ring, 1 / len(ring)
        return ids, shares

    def middles(self, points: np.ndarray) -> np.ndarray:
        """Middles (5 x 4, 3) of the parts of each digit, of vertices at `points` (n, 3)."""
        ids, shares = self.rings(len(points))
        return np.einsum("mk,mkc->mc", shares, points[ids])


@dataclass(frozen=True, kw_only=True, eq=False)
class Digits:
    """Which vertices of a surface belong to which finger or toe.

    Attributes:
        labels: (n, 5) how far a vertex belongs to the first, ... fifth digit of its limb, 0 to 1.
        own: (v, 5) the same of the canonical mesh, where both are known.
        tips: limb -> (5,) vertex ids, thumb or big toe first; only limbs whose digits were told apart.
        counts: limb -> how many extremities it has; None where the limb could not be cut off.
        middles: limb -> (5 x 4, 3) [m] middles of the parts of each digit.
        along: limb -> (5, n), 0 at the base of a digit and off it, 1 at its tip.
    """

    labels: np.ndarray
    own: np.ndarray
    tips: Mapping[str, np.ndarray]
    counts: Mapping[str, int | None]
    middles: Mapping[str, np.ndarray]
    along: Mapping[str, np.ndarray]

    def released(self) -> Digits:
        """The same without the middles that hold fingers."""
        return replace(self, middles={})

    def least(self, limb: str) -> int:
        """Vertices of the part with the fewest of all digits of a limb."""
        parts = [(along > low) & (along <= high) for along in self.along[limb] for low, high in _PARTS]
        return int(np.sum(parts, 1).min())


class DigitGuide:
    """The canonical mesh's own digits, and those of any surface that the mesh lies near."""

    def __init__(self) -> None:
        mesh, rig = load_canonical("mid", shipped_assets())
        self.mesh = mesh
        weights = rig.weights.toarray()
        share = {name: weights[:, place] for place, name in enumerate(rig.joint_names)}
        self._cuts = {limb: _cut_weights(share, limb) for limb in LIMBS}
        surface = Surface(mesh.vertices, mesh.triangles.astype(np.int64))
        self._limbs = {}
        for limb in LIMBS:
            found = _beyond(surface, *self._cut(limb, mesh.vertices))
            assert found is not None, limb
            assert len(found.tips) == 5, limb
            moved = np.array(rig.joint_names)[weights[found.tips].argmax(1)]
            order = (
                [next(i for i, name in enumerate(moved) if finger in name) for finger in DIGITS["Hand"]]
                if limb.endswith("Hand")
                else np.argsort(np.abs(mesh.vertices[found.tips, 0])).tolist()
            )
            self._limbs[limb] = found.taken(order)
        self.tips = {limb: found.tips for limb, found in self._limbs.items()}
        self.along = {limb: found.along for limb, found in self._limbs.items()}

    def find(self, surface: Surface, body: np.ndarray, *, marks: Marks = None) -> Digits:
        """Digits of a surface [m], +Y up, beside which the canonical mesh stands as `body` (v, 3) [m].

        Args:
            surface: the native skin.
            body: canonical vertices of the mid LOD, roughly in place.
            marks: canonical vertices and where they are [m], which the assignment has to keep.
        """
        tips, counts, middles, along = {}, {}, {}, {}
        for limb in LIMBS:
            found = _beyond(surface, *self._cut(limb, body))
            counts[limb] = None if found is None else len(found.tips)
            if found is None or len(found.tips) != 5:
                continue
            told = found.taken(self._order(limb, found, surface.vertices, body, marks))
            tips[limb], along[limb], middles[limb] = told.tips, told.along, told.middles(surface.vertices)
        own = _labels({limb: self.along[limb] for limb in along}, self.mesh.vertex_count)
        return Digits(
            labels=_labels(along, len(surface.vertices)), own=own, tips=tips, counts=counts, middles=middles,
            along=along,
        )  # fmt: skip

    def told(self, marked: Collection[int]) -> tuple[str, ...]:
        """Limbs with a landmark, of the canonical vertices that have one, on each finger or toe."""
        ids = np.array(list(marked), np.int64)
        return tuple(limb for limb, along in self.along.items() if (along[:, ids] > 0).any(1).all())

    def rings(self, limb: str, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Canonical vertices (5 x 4, m) of the parts of each digit of a limb, and their shares of its middle.

        Args:
            limb: one of :data:`LIMBS`.
            count: of the vertices of an LOD.
        """
        return self._limbs[limb].rings(count)

    def _cut(self, limb: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where a limb of the mesh at `points` is cut, and the direction to its end."""
        middle, above, end = (weight @ points / weight.sum() for weight in self._cuts[limb])
        return middle, (end - above) / np.linalg.norm(end - above)

    def _order(
        self, limb: str, found: _Limb, vertices: np.ndarray, body: np.ndarray, marks: Marks
    ) -> list[int]:
        """Which extremity is the thumb or big toe, ...: the assignment that needs least bending.

        All assignments are tried; hands are placed over each other as rigid bodies, by the parts of their
        digits and their roots, and a turn against the fitted body counts a little.
        """
        own = self._limbs[limb]
        rest, native = (
            np.concatenate([part.middles(points).reshape(5, -1, 3)[:, :3], np.tile(part.root, (5, 1, 1))], 1)
            for part, points in ((own, self.mesh.vertices), (found, vertices))
        )
        size = np.linalg.norm(rest - rest.mean((0, 1)), axis=2).mean()
        turned, _ = _rigid(self._points(own, self.mesh.vertices), self._points(own, body))
        kept = {} if marks is None else self._kept(own, found, vertices, *marks)
        costs: dict[tuple[int, ...], float] = {}
        for order in permutations(range(5)):
            if any(order[place] != extremity for place, extremity in kept.items()):
                continue
            turn, gap = _rigid(rest.reshape(-1, 3), native[list(order)].reshape(-1, 3))
            broken = sum(frozenset(order[each] for each in pair) not in found.links for pair in own.links)
            costs[order] = gap / size + _TURN * (3 - np.trace(turn.T @ turned)) / 2 + _LINK * broken
        return list(min(costs.items(), key=lambda item: item[1])[0])

    @staticmethod
    def _points(limb: _Limb, points: np.ndarray) -> np.ndarray:
        return points[limb.along.max(0) > 0]

    @staticmethod
    def _kept(
        own: _Limb, found: _Limb, vertices: np.ndarray, ids: np.ndarray, places: np.ndarray
    ) -> dict[int, int]:
        """Digit -> extremity, where a landmark lies on both."""
        kept = {}
        _, nearest = cKDTree(vertices).query(places)
        for canonical, native in zip(ids, nearest, strict=True):
            if own.along[:, canonical].any() and found.along[:, native].any():
                kept[int(own.along[:, canonical].argmax())] = int(found.along[:, native].argmax())
        return kept


@functools.cache
def digit_guide() -> DigitGuide:
    """The guide of the shipped mesh; takes two seconds, once."""
    return DigitGuide()


def _cut_weights(share: Mapping[str, np.ndarray], limb: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights (v,) whose means are a limb's cut, a point above it and one beyond it."""
    side, kind = limb[:-_LENGTH], limb[-_LENGTH:]
    above, beyond = (
        (share[f"{side}ForeArm"], share[limb]) if kind == "Hand" else (share[limb], share[f"{side}ToeBase"])
    )
    return above * beyond, above**2, beyond**2


def _labels(along: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    ramps = [np.clip(each / _RAMP, 0, 1).T for each in along.values()]
    return np.maximum.reduce(ramps) if ramps else np.zeros((count, 5))


def _rigid(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float]:
    """Rotation (3, 3) of the best similarity from points (m, 3) to others, and the root mean square left."""
    source, target = source - source.mean(0), target - target.mean(0)
    left, values, right = np.linalg.svd(target.T @ source)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    scale = (values * flip).sum() / (source**2).sum()
    turn = left * flip @ right
    return turn, float(np.sqrt(((target - scale * source @ turn.T) ** 2).sum(1).mean()) / scale)


def _beyond(surface: Surface, centre: np.ndarray, axis: np.ndarray) -> _Limb | None:
    """What lies beyond the cut through `centre` across `axis`; None where it is not apart from the rest."""
    vertices = surface.vertices
    _, first, place = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    same = first[place.ravel()]  # seams of a texture cut no surface
    triangles = same[surface.triangles]
    height = (vertices - centre) @ axis
    faces = _loop(vertices, triangles, height > 0, centre)
    sides = np.sort(triangle_sides(triangles[faces]), 1)
    cut = np.unique(sides[(height[sides] > 0).sum(1) == 1], axis=0)
    if not len(cut):
        return None
    sides = triangle_sides(triangles)
    edges = unique_edges(sides[sides[:, 0] != sides[:, 1]])
    keys = edges @ [len(vertices), 1]
    edges = edges[~np.isin(keys, cut @ [len(vertices), 1])]
    count = len(vertices)
    part = connected_components(_graph(edges, np.ones(len(edges)), count), directed=False)[1]
    ring = np.unique(cut)
    above, below = ring[height[ring] > 0], ring[height[ring] <= 0]
    end = np.bincount(part[above]).argmax()
    if end in part[below]:
        return None
    above = above[part[above] == end]
    edges = edges[part[edges[:, 0]] == end]
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    start = np.stack([np.full(len(above), count), above], 1)  # one more vertex, where all ways begin
    graph = _graph(np.concatenate([edges, start]), np.concatenate([lengths, height[above]]), count + 1)
    away = dijkstra(graph, directed=False, indices=count)[:count]
    tips, along, links = _extremities(np.where(part == end, away, -1.0), edges)
    return _Limb(root=vertices[ring].mean(0), tips=tips, along=along[:, same], links=links)


def _graph(edges: np.ndarray, weights: np.ndarray, count: int) -> scipy.sparse.csr_array:
    return scipy.sparse.coo_array((weights, tuple(edges.T)), shape=(count, count)).tocsr()


def _loop(vertices: np.ndarray, triangles: np.ndarray, above: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Faces of the nearest to `centre` of the loops along which a plane cuts the surface."""
    faces = np.flatnonzero(above[triangles].any(1) & ~above[triangles].all(1))
    if not len(faces):
        return faces
    sides = np.sort(triangle_sides(triangles[faces]), 1)
    crossing = above[sides].sum(1) == 1
    place = np.tile(np.arange(len(faces)), 3)[crossing]
    _, edge = np.unique(sides[crossing], axis=0, return_inverse=True)
    pairs = np.stack([place, len(faces) + edge.ravel()], 1)
    graph = _graph(pairs, np.ones(len(pairs)), len(faces) + len(pairs))
    loop = connected_components(graph, directed=False)[1][: len(faces)]
    middles = vertices[triangles[faces]].mean(1)
    away = [np.linalg.norm(middles[loop == i].mean(0) - centre) for i in np.unique(loop)]
    return faces[loop == np.unique(loop)[np.argmin(away)]]


def _extremities(height: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, set[frozenset[int]]]:
    """Vertices (k,) of the persistent maxima of `height` (n,), where vertices lie on each (k, n), neighbours.

    Vertices below zero do not count. An extremity reaches down to where it joins the first other one.
    """
    order = np.argsort(-height, kind="stable")[: int((height >= 0).sum())]
    joins = _joins(height, edges, order)
    least = _STANDS_OUT * height[order[0]]
    tips = [int(order[0])] + [each.low for each in joins if height[each.low] - height[each.at] > least]
    base: dict[int, int] = {}
    merged: dict[int, int] = {}  # a bump to what it is a bump of
    links = set()
    for each in joins:
        sides = [_followed(merged, side) for side in each.sides]
        if each.low not in tips:
            merged[each.low] = sides[1]
            continue
        links.add(frozenset(tips.index(side) for side in sides if side in tips))
        for tip in (each.low, each.high):  # of two parts that join, each carries its highest tip
            base.setdefault(tip, each.at)
    along = np.zeros((len(tips), len(height)))
    for number, tip in enumerate(tips):
        bottom = height[base[tip]] if tip in base else 0.0
        inside = height > bottom
        kept = edges[inside[edges].all(1)]
        part = connected_components(_graph(kept, np.ones(len(kept)), len(height)), directed=False)[1]
        on = inside & (part == part[tip])
        along[number, on] = (height[on] - bottom) / max(height[tip] - bottom, 1e-12)
    return np.array(tips), along, links


@dataclass(frozen=True, kw_only=True)
class _Join:
    """Two parts above a falling level become one.

    Attributes:
        low, high: their highest vertices.
        at: the vertex where they meet.
        sides: the maxima, one of each part, on whose slopes the meeting vertices lie.
    """

    low: int
    high: int
    at: int
    sides: tuple[int, int]


def _joins(height: np.ndarray, edges: np.ndarray, order: np.ndarray) -> list[_Join]:
    """All joins, from the highest down."""
    graph = _graph(np.concatenate([edges, edges[:, ::-1]]), np.ones(2 * len(edges)), len(height))
    parent: dict[int, int] = {}
    slope: dict[int, int] = {}
    joins = []
    for vertex in order.tolist():
        around = graph.indices[graph.indptr[vertex] : graph.indptr[vertex + 1]].tolist()
        touched: dict[int, int] = {}  # highest vertex of a part -> its highest vertex beside this one
        for other in sorted((i for i in around if i in parent), key=height.__getitem__):
            touched[_followed(parent, other)] = other
        high = max(touched, key=height.__getitem__, default=vertex)
        joins += [
            _Join(low=low, high=high, at=vertex, sides=(slope[touched[low]], slope[touched[high]]))
            for low in touched
            if low != high
        ]
        slope[vertex] = slope[max(touched.values(), key=height.__getitem__)] if touched else vertex
        parent |= dict.fromkeys([*touched, vertex, high], high)
    return joins


def _followed(parent: dict[int, int], vertex: int) -> int:
    """End of a chain; what is passed is shortened."""
    while (above := parent.get(vertex, vertex)) != vertex:
        parent[vertex] = parent.get(above, above)
        vertex = above
    return vertex
