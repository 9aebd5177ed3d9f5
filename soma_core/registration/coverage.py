"""Whether a wrap covers a body, part by part and both ways, and each finger and toe one of the body's."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from soma_core.geometry.mesh import triangle_sides, unique_edges, vertex_areas, vertex_normals
from soma_core.registration.digits import DIGITS, LIMBS, DigitGuide, Digits
from soma_core.registration.surface import Surface
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["COVERED", "MATCHED", "Share", "coverage", "faults", "lost", "matches", "slid", "without_digits"]

_NEAR = 0.0025
"""Distance between wrap and skin, of the body's diagonal, up to which they lie on each other: 5 mm of 2 m.
A coarse wrap stands off a round body by up to half an edge."""

_EDGE, _AT_MOST = 0.25, 2.0
"""Share of the edges at a skin vertex by which it may stand out of the wrap, and how many times the distance
above that may be: corners of a coarse mesh do, on whose flats a wrap lies."""

COVERED = 0.9
"""Share of a segment that lies on the other surface, either way; nostrils, lips and the skin between fingers
do not."""

MATCHED = 0.8
"""Share of a finger that lies on one and the same finger, either way; of two that touch, seams may not."""

_MITTEN = 2
"""Extremities up to which a hand has no fingers: a mitten with its thumb, a fist with two knuckles."""

_HELD = 0.6
"""Share of what lies around the fingers in a hand without any that a wrap has to cover: mittens have 0.9,
balls in place of hands 0.3, within which the fingers hang."""

_OUTER = 0.3
"""Share of a digit's length from its base that may lie on its neighbour: where fingers begin is not sharp."""

_COARSE, _UNTOLD = 0.25, 0.75
"""Edges of the skin at a digit, of its length, from which on less of it is asked for, and nothing: where one
ends is known to an edge, and a toe of three vertices has no shape."""

_FUSED = 0.6
"""Share of a digit's length up to which it may lie where the skin has no digits: those of scans, and of hands
whose fingers touch, are one as far as that."""

_STRETCHED, _SLID = 2.0, 0.01
"""Stretch of an edge of the head, of their median, and the share of edges beyond it that makes a wrap unfit.
Wraps of people, artists' too, have 0.1 to 0.4 %; a face that lies 40 mm too low has 2 %."""

_LOST, _SOLE = 0.5, 0.75
"""Share of a segment, and of a foot, that may lie over holes: armpits and soles of scans do. A foot without
its lowest 12 mm has 0.66, a hand that is cut off 1."""

_SEGMENTS = (
    ("head", "Head|Neck|Jaw|Eye"),
    (r"\1\2", "(Left|Right)Hand(Thumb|Index|Middle|Ring|Pinky).*"),
    (r"\1Hand", "(Left|Right)Hand"),
    (r"\1Foot", "(Left|Right)(Foot|Toe).*"),
    (r"\1Leg", "(Left|Right)(Leg|Shin|UpLeg).*"),
    (r"\1Arm", "(Left|Right)(Arm|ForeArm|Shoulder).*"),
    ("torso", ".*"),
)
"""Names of segments, and the joints whose skin they are; the first that fits."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """How much of two things lies on each other, 0 to 1.

    Attributes:
        wrap: of the wrap's part, on the native one.
        native: of the native part, on the wrap's.
        asked: that either has to have; less of a digit on a coarse mesh.
    """

    wrap: float
    native: float
    asked: float = COVERED

    @property
    def least(self) -> float:
        """The worse way."""
        return min(self.wrap, self.native)

    def as_dict(self) -> dict[str, float]:
        """Numbers for a report."""
        return {"wrap": round(self.wrap, 4), "native": round(self.native, 4)}


def _segments(rig: Rig) -> tuple[list[str], np.ndarray]:
    """Names of the segments of a body, and the place in them of each vertex, (v,)."""
    names = []
    for joint in rig.joint_names:
        name, pattern = next(pair for pair in _SEGMENTS if re.fullmatch(pair[1], joint))
        names.append(re.sub(f"^{pattern}$", name, joint))
    known = list(dict.fromkeys(names))
    places = np.array([known.index(name) for name in names])
    return known, places[np.asarray(rig.weights.argmax(1)).ravel()]


def coverage(
    wrap: np.ndarray, surface: Surface, mesh: CanonicalMesh, rig: Rig, filled: np.ndarray
) -> dict[str, Share]:
    """How much of each segment lies on the native skin and how much of that on the wrap.

    Args:
        wrap: (v, 3) [m].
        surface: the native skin [m].
        mesh, rig: canonical.
        filled: (v,) vertices that do not count, nor what is nearest to them.
    """
    triangles = mesh.triangles.astype(np.int64)
    sides = np.linalg.norm(np.diff(wrap[triangle_sides(triangles)], axis=1)[:, 0], axis=1)
    near = max(_NEAR * float(np.linalg.norm(np.ptp(wrap, axis=0))), float(np.median(sides)) / 2)
    names, place = _segments(rig)
    contact = surface.closest(wrap)
    # Toes lie folded on a foot or a shoe without any, seen from both sides; `matches` tells them apart.
    feet = np.array([name.endswith("Foot") for name in names])[place]
    # What lies within a closed mouth is no skin, and a native face may be covered by folds: eyelids, lips.
    inside = filled.copy()
    inside[mesh.face_interior] = True
    sense = (vertex_areas(wrap, triangles) * surface.face_normals[contact.faces]).sum(1)
    turned = np.bincount(contact.faces, np.where(inside, 0, sense), len(surface.triangles)) >= 0
    on = (np.linalg.norm(contact.points - wrap, axis=1) <= near) & (turned[contact.faces] | feet)
    counted = ~(inside | contact.open)
    back = Surface(wrap, triangles).closest(surface.vertices)
    corner = np.clip(_EDGE * _edges_at(surface), near, _AT_MOST * near)
    under = np.linalg.norm(back.points - surface.vertices, axis=1) <= corner
    corners = triangles[back.faces]
    part = place[np.take_along_axis(corners, back.shares.argmax(1)[:, None], 1)[:, 0]]
    # What lies within the wrap is no skin: teeth, eyeballs, the ends of limbs that are set into a trunk.
    within = ((surface.vertices - back.points) * back.normals).sum(1) < 0
    seen = ~filled[corners].any(1) & (under | ~within)
    return {
        name: Share(wrap=_mean(on[counted & (place == i)]), native=_mean(under[seen & (part == i)]))
        for i, name in enumerate(names)
        if (counted & (place == i)).any()
    }


def _edges_at(surface: Surface) -> np.ndarray:
    """Mean length (n,) of the edges at each vertex."""
    ends = unique_edges(triangle_sides(surface.triangles))
    lengths = np.linalg.norm(np.diff(surface.vertices[ends], axis=1)[:, 0], axis=1)
    count = len(surface.vertices)
    return np.bincount(ends.ravel(), np.repeat(lengths, 2), count) / np.maximum(
        np.bincount(ends.ravel(), minlength=count), 1
    )


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else 1.0


def _digit_name(limb: str, digit: int) -> str:
    """``LeftIndex``, ``RightBigToe``, ..."""
    kind = "Hand" if limb.endswith("Hand") else "Foot"
    return limb[: -len(kind)] + DIGITS[kind][digit]


def matches(wrap: np.ndarray, surface: Surface, digits: Digits, guide: DigitGuide) -> dict[str, Share]:
    """How much of each finger and toe lies on the one of the skin that it was given, and the other way.

    Args:
        wrap: (v, 3) [m].
        surface: the native skin [m].
        digits: of that skin.
        guide: of the canonical mesh.
    """
    triangles = guide.mesh.triangles.astype(np.int64)
    there = surface.facing(wrap, vertex_normals(wrap, triangles))
    here = Surface(wrap, triangles).facing(surface.vertices, surface.normals)
    found, edges = {}, _edges_at(surface)
    for limb in (each for each in LIMBS if each in digits.tips):
        own, native = guide.along[limb], digits.along[limb]
        on = _most(native[:, surface.triangles[there.faces]], there.shares)
        by = _most(own[:, triangles[here.faces]], here.shares)
        for digit in range(len(own)):
            part = wrap[own[digit] > 0]
            length = np.linalg.norm(part - wrap[guide.tips[limb][digit]], axis=1).max()
            coarse = edges[native[digit] > 0].mean() / max(length, 1e-12)
            right = (on == digit) | ((on == len(own)) & (own[digit] < _FUSED))
            found[_digit_name(limb, digit)] = Share(
                wrap=_mean(right[own[digit] > _OUTER]),
                native=_mean(by[native[digit] > _OUTER] == digit),
                asked=MATCHED * float(np.clip((_UNTOLD - coarse) / (_UNTOLD - _COARSE), 0, 1)),
            )
    return found


def _most(along: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Digit (m,) on which points lie that have `shares` (m, 3) of corners with (5, m, 3); 5 where on none."""
    value = np.einsum("dmk,mk->dm", along, shares)
    return np.where(value.max(0) > 0, value.argmax(0), len(along))


def faults(
    covered: Mapping[str, Share],
    matched: Mapping[str, Share],
    extremities: Mapping[str, int | None],
    *,
    told: Collection[str] = (),
    gone: Collection[str] = (),
) -> tuple[str, ...]:
    """What makes a wrap unfit for use, one sentence each.

    Hands without fingers, mittens and fists, are none; their fingers cannot be asked to cover anything.

    Args:
        covered: of :func:`coverage`.
        matched: of :func:`matches`.
        extremities: limb -> how many stand out of the native skin.
        told: limbs whose fingers a user told by landmarks.
        gone: segments that lie over holes, of :func:`lost`.
    """
    found = [
        f"{limb}: it touches another part of the mesh, so that no finger can be told"
        if count is None
        else f"{limb}: {count} fingers stand out of the mesh, not 5, so that none can be told from another"
        for limb, count in extremities.items()
        if limb.endswith("Hand") and limb not in {*told, *gone}
        if count != 5 and (count is None or count > _MITTEN)
    ]
    found += [
        f"{name}: {1 - share.wrap:.0%} lies beside its own, of which {1 - share.native:.0%} is without it"
        for name, share in matched.items()
        if share.least < share.asked and name not in gone
    ]
    blunt = {
        limb: [_digit_name(limb, i) for i in range(5)]
        for limb in LIMBS
        if (extremities[limb] or 0) <= _MITTEN
    }
    for limb, names in blunt.items():
        seen = np.mean([covered[name].native for name in names if name in covered] or [1.0])
        if limb.endswith("Hand") and limb not in {*told, *gone} and seen < _HELD:
            found.append(f"{limb}: no fingers stand out of the mesh, of which {1 - seen:.0%} is bare there")
    bare = {name for names in blunt.values() for name in names}
    found += [
        f"{name}: {1 - share.wrap:.0%} is off the mesh, {1 - share.native:.0%} of the mesh there is bare"
        for name, share in covered.items()
        if share.least < share.asked and name not in bare and name not in gone
    ]
    return tuple(found)


def slid(wrap: np.ndarray, mesh: CanonicalMesh, rig: Rig, filled: np.ndarray) -> tuple[str, ...]:
    """What is said of a head whose face slid over it: it lies on the surface, drawn out above or below.

    Args:
        wrap: (v, 3) in any unit and axes.
        mesh, rig: canonical.
        filled: (v,) vertices that do not count.
    """
    names, place = _segments(rig)
    counted = (place == names.index("head")) & ~filled
    counted[mesh.face_interior] = False
    edges = unique_edges(triangle_sides(mesh.triangles.astype(np.int64)))
    edges = edges[counted[edges].all(1)]
    now, before = (np.linalg.norm(np.diff(at[edges], axis=1)[:, 0], axis=1) for at in (wrap, mesh.vertices))
    ratio = now / np.maximum(before, 1e-12)
    share = _mean(ratio > _STRETCHED * np.median(ratio))
    if share <= _SLID:
        return ()
    return (f"head: {share:.1%} of its edges are stretched more than {_STRETCHED:g} times: the face slid",)


def lost(wrap: np.ndarray, surface: Surface, rig: Rig) -> dict[str, float]:
    """Segments most of which lie over holes of the skin, such as a hand that is cut off, with their share.

    Args:
        wrap: (v, 3) [m].
        surface: the native skin [m].
        rig: canonical.
    """
    names, place = _segments(rig)
    share = np.bincount(place, surface.closest(wrap).open) / np.bincount(place)
    return {
        name: float(part)
        for name, part in zip(names, share, strict=True)
        if part > (_SOLE if name.endswith("Foot") else _LOST)
    }


def without_digits(extremities: Mapping[str, int | None]) -> list[str]:
    """What is said of hands and feet whose fingers or toes do not stand apart."""
    return [
        f"{limb}: no separate {'fingers' if limb.endswith('Hand') else 'toes'}, {count or 'no'} stand out"
        for limb, count in extremities.items()
        if count != 5 and (limb.endswith("Foot") or count in range(_MITTEN + 1))
    ]
