"""A picture of a point set on a body: where each point lies, and its name or number."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soma_core.cache import atomic_write
from soma_core.view.stage import VIEW_ANGLE, Body, camera_axes, open_stage

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["point_picture"]

_DOT, _LINE, _INK, _HALO = (196, 48, 43), (60, 96, 150), (28, 28, 28), (214, 232, 206)
_NAMED = 26
"""A panel with more points shows their numbers."""

_CROWDED = 6
"""Points on the head or a hand from which on it has a panel of its own."""

_TALL = 900
"""Height of a panel in pixels."""

_EDGE = 6
"""No label comes nearer to a panel's edge [px]."""

_SPOTS = tuple(itertools.product((8, 30, 60, 90, 120), range(-117, 118, 9), (1, -1)))
"""Where a label may be: pixels away and below its point, and to which side."""

_WIDE = 3
"""Most panels in a row; four make two rows."""


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """What one panel looks at: its middle [m], the height that fills it [m], and its points."""

    focus: np.ndarray
    height: float
    shown: np.ndarray


def point_picture(
    path: Path, body: Body, names: Sequence[str], places: np.ndarray, bones: Sequence[tuple[str, str]]
) -> None:
    """Write a picture of a body from the front with points on it, those behind its skin too.

    Where many lie on the head or a hand, a panel shows it from near. A panel of many points has their
    numbers, in the order of the set from 0, instead of their names.

    Args:
        path: the picture, WebP where its name ends so, else PNG.
        body: in a pose that hides no part, from the front.
        names, places: of the points, (P, 3) [m].
        bones: pairs of names that a line joins.

    Raises:
        InputError: pyvista is not installed.
    """
    from PIL import Image

    panels = _panels(body, places)
    with open_stage((_TALL, _TALL)) as stage:
        pictures = []
        for panel in panels:
            picture = stage.shot([body], focus=panel.focus.tolist(), height=panel.height, flat=True)
            pictures.append(_marked(picture, panel, names, places, bones))
    wide = len(pictures) if len(pictures) <= _WIDE else 2
    sheet = Image.new("RGB", (_TALL * wide, _TALL * -(-len(pictures) // wide)), "white")
    for number, picture in enumerate(pictures):
        sheet.paste(picture, (_TALL * (number % wide), _TALL * (number // wide)))
    kind = "WEBP" if path.suffix == ".webp" else "PNG"
    atomic_write(path, lambda target: sheet.save(target, kind))


def _panels(body: Body, places: np.ndarray) -> list[_Panel]:
    low, high = body.vertices.min(0), body.vertices.max(0)
    everywhere = np.arange(len(places))
    found = []
    head = places[:, 1] > high[1] - 0.16 * (high[1] - low[1])
    reach = 0.13 * (high[0] - low[0])
    hands = places[:, 0] > high[0] - reach, places[:, 0] < low[0] + reach
    near = [np.flatnonzero(part) for part in (head, *hands) if part.sum() >= _CROWDED]
    rest = np.setdiff1d(everywhere, np.concatenate([*near, everywhere[:0]]))
    if len(rest):
        span = 1.08 * float((high - low)[:2].max())
        found.append(_Panel(focus=(low + high) / 2, height=span, shown=rest))
    for ids in near:
        middle = (places[ids].min(0) + places[ids].max(0)) / 2
        span = max(float(np.ptp(places[ids], axis=0)[:2].max()) * 1.4, 0.2)
        found.append(_Panel(focus=middle, height=span, shown=ids))
    return found


def _marked(
    picture: Image,
    panel: _Panel,
    names: Sequence[str],
    places: np.ndarray,
    bones: Sequence[tuple[str, str]],
) -> Image:
    """The picture with the panel's points, their lines and their names."""
    from PIL import ImageDraw, ImageFont

    at = _projected(places, panel)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
    row, shown = {name: number for number, name in enumerate(names)}, set(panel.shown.tolist())
    for first, second in bones:
        ends = row[first], row[second]
        if shown.issuperset(ends):
            draw.line([tuple(at[end]) for end in ends], fill=_LINE, width=2)
    taken: list[tuple[float, float, float, float]] = []
    for number in panel.shown:
        x, y = at[number]
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=_DOT)
        taken.append((x - 4, y - 4, x + 4, y + 4))
    for number in panel.shown:
        text = names[number] if len(shown) <= _NAMED else str(number)
        _label(draw, font, text, at[number], taken)
    return picture


def _label(draw: Any, font: Any, text: str, at: np.ndarray, taken: list) -> None:
    """Write beside a point, at the first of some places where nothing is written yet."""
    wide, tall = draw.textlength(text, font=font), 15
    outer = 1 if at[0] >= _TALL / 2 else -1
    spots = sorted(_SPOTS, key=lambda spot: np.hypot(spot[0], spot[1]) + 8 * (spot[2] != outer))
    boxes = []
    for away, lift, side in spots:
        x, y = at[0] + (away if side > 0 else -away - wide), at[1] - tall / 2 + lift
        if _EDGE <= x <= _TALL - _EDGE - wide and _EDGE <= y <= _TALL - _EDGE - tall:
            boxes.append((x, y, x + wide, y + tall))
    beside = np.clip((at[0] + 8, at[1] - tall / 2), _EDGE, (_TALL - _EDGE - wide, _TALL - _EDGE - tall))
    boxes.append((*beside, beside[0] + wide, beside[1] + tall))
    free = (box for box in boxes if not any(_meet(box, other) for other in taken))
    box = next(free, boxes[0])
    x, y = box[:2]
    taken.append(box)
    end = (x if x > at[0] else x + wide, y + tall / 2)
    if abs(end[0] - at[0]) > 12 or abs(end[1] - at[1]) > 12:
        draw.line([tuple(at), end], fill=(150, 150, 150), width=1)
    draw.text((x, y), text, font=font, fill=_INK, stroke_width=1, stroke_fill=_HALO)


def _meet(one: tuple, other: tuple) -> bool:
    """Whether two boxes (left, top, right, bottom) overlap."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _projected(places: np.ndarray, panel: _Panel) -> np.ndarray:
    """Pixels (P, 2) of places in a panel, as the stage's camera sees them."""
    side, up, towards = camera_axes(0.0)
    away = places - panel.focus
    distance = panel.height / 2 / np.tan(np.radians(VIEW_ANGLE / 2))
    scale = _TALL / panel.height * distance / (distance - away @ towards)
    return np.stack((_TALL / 2 + scale * (away @ side), _TALL / 2 - scale * (away @ up)), 1)
