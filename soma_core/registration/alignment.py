"""Which way a body stands and looks: every axis choice is tried with our own mean body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import cast

import numpy as np

from soma_core.errors import InputError
from soma_core.plugin.spec import Axis, Unit
from soma_core.registration.body_model import BodyModel, BodyPose
from soma_core.registration.surface import Surface
from soma_core.registration.target import Frame, Skin, find_unit

__all__ = ["Start", "find_starts"]

_ARMS = (0.0, 0.5, 1.0, 1.4, 1.8)
"""Poses that are tried, on the way from the T-pose (0) to the bind pose (1) and on to hanging arms."""

_UNSURE = 0.7
"""Cost of the best start with both arms alike, from which on arms that differ are tried too."""

_ROUGHLY, _LEFT = 200, 12
"""Samples in a first look at all starts, and how many of these are looked at well."""

_SAMPLES = 1200
_SOFT = 0.08
"""Distance [m] at which a sample counts half."""

_FAR = 1.3
"""Factor of the mean body's height beyond which a fit may take the neck for the head, or end beside the body;
nearer ones it reaches from the mean body, whose shape pulls least."""

_AXES: tuple[Axis, ...] = ("+y", "+z", "-z", "+x", "-x", "-y")


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """A frame of the native mesh and a pose of the mean body in it; a lower cost fits better."""

    frame: Frame
    pose: BodyPose
    cost: float


def find_starts(
    skin: Skin, model: BodyModel, *, unit: Unit | None, up: Axis | None, forward: Axis | None, count: int
) -> list[Start]:
    """The `count` best ways to stand the mean body into the mesh, best first.

    Raises:
        InputError: no unit gives a person's size, or `up` and `forward` are parallel.
    """
    extent = np.ptp(skin.vertices, axis=0)
    unit = unit or find_unit(float(extent.max()))
    centre = cast("tuple[float, float, float]", tuple((skin.vertices.max(0) + skin.vertices.min(0)) / 2))
    axes = product([up] if up else _AXES, [forward] if forward else _AXES)
    frames = [
        Frame(unit=unit, up=high, forward=ahead, centre=centre) for high, ahead in axes if high[1] != ahead[1]
    ]
    if not frames:
        raise InputError(
            "forward", got=repr(forward), expected=f"an axis across up={up!r}", fix="Correct one of the two."
        )
    surfaces = [skin.surface(frame) for frame in frames]
    placed = [*zip(surfaces, frames, strict=True)]
    found = _best_starts(placed, [(share, share) for share in _ARMS], model, count)
    if found[0][0].cost > _UNSURE:
        found += _best_starts(placed, [*permutations(_ARMS, 2)], model, count)
    found = sorted(found, key=lambda start: start[0].cost)[:count]
    return [_sized(start, size, model) for start, size in found]


def _best_starts(
    placed: list[tuple[Surface, Frame]], arms: list[tuple[float, float]], model: BodyModel, count: int
) -> list[tuple[Start, float]]:
    """The best starts with arms so far from the T-pose, left and right, best first, and how large each is."""
    bodies = [(pose := model.start(*each), _mean_body(model, pose)) for each in arms]
    tried = [(*each, *body) for each in placed for body in bodies]
    costs = [_start(*each, model, _ROUGHLY).cost for each in tried]
    best = [tried[index] for index in np.argsort(costs, kind="stable")[: max(_LEFT, count)]]
    starts = [
        (_start(surface, frame, pose, body, model, _SAMPLES), _size(surface, body))
        for surface, frame, pose, body in best
    ]
    return sorted(starts, key=lambda start: start[0].cost)[:count]


def _mean_body(model: BodyModel, pose: BodyPose) -> Surface:
    return Surface(model.evaluate(pose)[0], model.triangles)


def _sized(start: Start, size: float, model: BodyModel) -> Start:
    """The same start with a body of the mesh's size, where the mean body is far from it."""
    if 1 / _FAR < size < _FAR:
        return start
    return replace(start, pose=model.sized(start.pose, size))


def _size(surface: Surface, body: Surface) -> float:
    return float(np.ptp(surface.vertices[:, 1]) / np.ptp(body.vertices[:, 1]))


def _start(
    surface: Surface, frame: Frame, pose: BodyPose, body: Surface, model: BodyModel, samples: int
) -> Start:
    """Place the mean body by its box, scaled to the mesh's height, and measure both ways."""
    size = _size(surface, body)
    middle = (body.vertices.max(0) + body.vertices.min(0)) / 2
    ids = model.skin[:: max(1, len(model.skin) // samples)]
    placed = size * (body.vertices[ids] - middle)
    gap = surface.facing(placed, body.normals[ids]).points - placed
    chosen = np.arange(0, len(surface.vertices), max(1, len(surface.vertices) // samples))
    seen = surface.vertices[chosen] / size + middle
    back = size * (body.facing(seen, surface.normals[chosen]).points - seen)
    squared = [(offset**2).sum(1) for offset in (gap, back)]
    cost = sum(float((each / (each + _SOFT**2)).mean()) for each in squared)
    return Start(frame=frame, pose=pose.at(pose.hips - middle), cost=cost)
