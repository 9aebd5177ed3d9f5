"""The toy's shape: a jointed figure of tapered capsules, in centimetres, +Z up, facing -Y.

Each vertex is a point on the axis of its capsule plus a radius times a fixed direction. It is therefore
linear in the ends and the radii of the capsules, and these are linear in the proportions of the figure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["SEGMENTS", "Segment", "figure", "figure_triangles"]

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Segment:
    """One capsule [cm]: its ends, its radius at either end, and its depth as a share of its width."""

    part: str
    start: Point
    end: Point
    radii: tuple[float, float]
    depth: float = 1.0

    def mirrored(self) -> Segment:
        """The same capsule on the right side of the body."""
        (ax, ay, az), (bx, by, bz) = self.start, self.end
        return Segment(self.part, (-ax, ay, az), (-bx, by, bz), self.radii, self.depth)

    def frame(self) -> np.ndarray:
        """Rows: along the axis, across the body, and perpendicular to both."""
        along = np.subtract(self.end, self.start)
        along /= np.linalg.norm(along)
        across = np.array([1.0, 0, 0]) - along[0] * along
        across /= np.linalg.norm(across)
        return np.stack([along, across, np.cross(along, across)])


SHOULDER, ELBOW, WRIST = (16.1, 6.3, 140.1), (34.2, 5.1, 117.6), (53.0, -6.4, 102.0)
HIP, KNEE, ANKLE = (10.0, 3.0, 91.5), (13.0, 0.3, 48.4), (15.7, 10.0, 7.2)
NECK = (0.0, 2.0, 158.0)

_MIDDLE = (
    Segment("trunk", (0, 4.0, 96), (0, 4.5, 108), (15.5, 13.0), 0.68),
    Segment("trunk", (0, 4.0, 108), (0, 5.5, 132), (12.5, 14.0), 0.75),
    Segment("trunk", (0, 6.0, 141), NECK, (6.0, 5.5)),
    Segment("head", (0, 0.6, 160.5), (0, 0.6, 167), (8.2, 8.6), 1.15),
)
_LEFT = (
    Segment("shoulder", (3.0, 6.0, 138.0), SHOULDER, (8.0, 6.5)),
    Segment("arm", SHOULDER, ELBOW, (5.8, 4.2)),
    Segment("arm", ELBOW, WRIST, (4.3, 2.7)),
    Segment("leg", HIP, KNEE, (9.0, 6.0)),
    Segment("leg", KNEE, ANKLE, (6.0, 3.7)),
    Segment("foot", (16.2, 11.5, 3.6), (18.5, -2.0, 2.8), (3.8, 4.6), 0.85),
    Segment("foot", (18.8, -1.0, 2.4), (19.0, -6.5, 1.6), (4.7, 3.8), 0.5),
)
_FINGERS = (
    # knuckle, tip, radii at the wrist, at the knuckle and at the tip
    ((52.6, -13.0, 99.0), (53.6, -18.5, 95.5), (1.9, 1.4, 0.8)),
    ((57.5, -13.5, 96.9), (61.3, -17.8, 91.4), (1.8, 1.1, 0.7)),
    ((58.2, -11.2, 96.3), (61.4, -15.0, 88.6), (1.8, 1.1, 0.7)),
    ((58.0, -9.6, 95.5), (60.2, -12.8, 88.1), (1.8, 1.0, 0.7)),
    ((57.1, -7.9, 94.4), (58.5, -9.6, 88.6), (1.8, 1.0, 0.6)),
)
_HAND = tuple(
    Segment("hand", start, end, radii)
    for knuckle, tip, (wrist, middle, last) in _FINGERS
    for start, end, radii in ((WRIST, knuckle, (wrist, middle)), (knuckle, tip, (middle, last)))
)
SEGMENTS = (*_MIDDLE, *_LEFT, *_HAND, *(segment.mirrored() for segment in (*_LEFT, *_HAND)))

_SECTORS = 16
_RINGS = np.array(
    # where on the axis, and the latitude [degrees]: half a ball, the tapered tube, half a ball
    [(0, -60), (0, -30), (0, 0), (1 / 3, 0), (2 / 3, 0), (1, 0), (1, 30), (1, 60)]
)


def figure(
    *, girth: float = 1.0, legs: float = 1.0, arms: float = 1.0, shoulders: float = 1.0, head: float = 1.0
) -> np.ndarray:
    """Vertices (n, 3) [cm] of the figure; every argument is a factor, and 1 is the default figure."""
    thickness = {"head": head, "hand": 1.0, "foot": 1.0}
    return np.concatenate([
        _capsule(segment, _ends(segment, legs, arms, shoulders, head), thickness.get(segment.part, girth))
        for segment in SEGMENTS
    ])  # fmt: skip


def _ends(segment: Segment, legs: float, arms: float, shoulders: float, head: float) -> np.ndarray:
    """Both ends (2, 3) of a capsule in a figure of other proportions; the soles stay on the ground."""
    ends = np.array([segment.start, segment.end], float)
    mirror = np.array([np.sign(segment.end[0]), 1, 1])
    wider = (shoulders - 1) * mirror * [SHOULDER[0], 0, 0]
    if segment.part in ("leg", "foot"):
        ends += (legs - 1) * (ends - mirror * HIP)
    elif segment.part in ("arm", "hand"):
        ends += (arms - 1) * (ends - mirror * SHOULDER) + wider
    elif segment.part == "shoulder":
        ends[1] += wider
    elif segment.part == "head":
        ends += (head - 1) * (ends - NECK)
    return ends + (legs - 1) * np.array([0, 0, HIP[2]])


def _capsule(segment: Segment, ends: np.ndarray, thickness: float) -> np.ndarray:
    """Vertices of one capsule: the pole at the start, ring after ring, the pole at the end."""
    along, across, front = segment.frame()
    where, latitude = np.hstack([[[0], [-90]], _RINGS.T, [[1], [90]]])
    turn = 2 * np.pi * np.arange(_SECTORS) / _SECTORS
    circle = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * segment.depth * front
    latitude = np.radians(latitude)[:, None, None]
    direction = np.cos(latitude) * circle + np.sin(latitude) * along
    radius = np.interp(where, [0, 1], segment.radii) * thickness
    centre = ends[0] + where[:, None] * (ends[1] - ends[0])
    points = (centre[:, None] + radius[:, None, None] * direction).reshape(-1, 3)
    return points[_SECTORS - 1 : 1 - _SECTORS]  # one vertex at either pole instead of a ring of them


def figure_triangles() -> np.ndarray:
    """Triangles (t, 3) of the figure, outward; the capsules are closed and separate."""
    rings = 1 + np.arange(len(_RINGS) * _SECTORS).reshape(len(_RINGS), _SECTORS)
    count = rings.size + 2
    here, right = rings, np.roll(rings, -1, axis=1)
    poles = [
        np.stack([np.zeros(_SECTORS, int), right[0], here[0]], 1),
        np.stack([np.full(_SECTORS, count - 1), here[-1], right[-1]], 1),
    ]
    below, above = slice(None, -1), slice(1, None)
    sides = [
        np.stack([here[below], right[below], right[above]], -1).reshape(-1, 3),
        np.stack([here[below], right[above], here[above]], -1).reshape(-1, 3),
    ]
    one = np.concatenate([*poles, *sides])
    return np.concatenate([one + count * index for index in range(len(SEGMENTS))])
