"""Pictures of posed bodies: a contact sheet of one motion, and a gallery of several identities."""

from __future__ import annotations

import colorsys
import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soma_core.cache import atomic_write
from soma_core.io.eyeballs import EYES, eyeball, eyeball_places
from soma_core.rig.skeleton import Rig
from soma_core.view.stage import AZIMUTH, PAPER, VIEW_ANGLE, Body, camera_axes, open_stage

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["backend_colour", "contact_sheet", "framing", "gallery", "sheet_width", "with_eyes"]

# The paper's figures: SOMA green, MHR blue, SMPL pink, Anny yellow.
_COLOURS = {
    "soma": (0.55, 0.74, 0.52),
    "mhr": (0.47, 0.65, 0.84),
    "smpl": (0.90, 0.60, 0.66),
    "smplx": (0.80, 0.56, 0.76),
    "anny": (0.93, 0.78, 0.45),
    "garment": (0.66, 0.62, 0.86),
}
_INK = (70, 70, 72)
_GALLERY_AZIMUTH = 8.0
"""Less than in a contact sheet: there the pose that identities share hides one leg behind the other."""
_MARGIN, _SIDE = 1.13, 1.17
"""Height and width of a view in units of the body in it: more than what fades at the edges of a cell."""


def backend_colour(name: str) -> tuple[float, float, float]:
    """Return the sRGB colour of a backend: the paper's, else a steady one derived from the name."""
    if name in _COLOURS:
        return _COLOURS[name]
    hue = hashlib.sha256(name.encode()).digest()[0] / 255
    return colorsys.hls_to_rgb(hue, 0.68, 0.42)


def sheet_width(count: int, width: int) -> int:
    """Width of a contact sheet of `count` frames: a single one would stand three times as tall as a row."""
    return width if count > 1 else width // 3


def contact_sheet(
    path: Path, bodies: Sequence[Body], *, width: int = 1600, columns: int = 5, legend: Image | None = None
) -> None:
    """Write frames of one motion as a grid of cells, all at one scale, the camera following the body.

    The floor lies under the lowest of all frames, so that a jump is seen.

    Args:
        path: the PNG.
        bodies: one a frame.
        width: width of the picture in pixels; a single frame takes a third of it.
        columns: cells in a row.
        legend: a picture of the same width to put below.

    Raises:
        InputError: pyvista is not installed.
    """
    columns = min(columns, len(bodies))
    boxes = np.array([[body.vertices.min(axis=0), body.vertices.max(axis=0)] for body in bodies])
    floor = boxes[:, 0, 1].min()
    feet = boxes.mean(axis=1)
    feet[:, 1] = floor
    reach = max(float((boxes[:, 1, axis] - boxes[:, 0, axis]).max()) for axis in (0, 2)) * 1.1
    tall = (boxes[:, 1, 1].max() - floor) * 1.12
    wide = sheet_width(len(bodies), width) // columns
    cell = (wide, int(wide * max(tall / reach, 0.9)))
    rise, height = framing(bodies, feet, cell[0] / cell[1])
    cells = []
    with open_stage(cell) as stage:
        for body, place in zip(bodies, feet + np.array([0, rise, 0]), strict=True):
            cells.append(_faded(stage.shot([body], focus=place, height=height, floor=floor)))
    sheet = _grid(cells, bodies, columns)
    sheet = _stacked([sheet, legend]) if legend is not None else sheet
    atomic_write(path, lambda target: sheet.save(target, "PNG"))


def framing(bodies: Sequence[Body], feet: np.ndarray, aspect: float) -> tuple[float, float]:
    """Aim the camera so that it sees every body whole, with a margin in which shadows may fade.

    A hand near the camera is seen lower than where it is, so the sides of the bodies do not tell.

    Args:
        bodies: one a frame.
        feet: (frames, 3) [m], the point of the floor below each.
        aspect: width of a cell by its height.

    Returns:
        Height of the focus above the floor and height of the view there, both in metres.
    """
    side, up, towards = camera_axes(AZIMUTH)
    points = [body.vertices - place for body, place in zip(bodies, feet, strict=True)]
    across, above, near = (np.concatenate([part @ axis for part in points]) for axis in (side, up, towards))
    rise, height = 0.0, 2 * float(np.ptp(above))
    for _ in range(8):  # the nearer the camera, the wider the body: settles within a millimetre
        distance = height / 2 / np.tan(np.radians(VIEW_ANGLE / 2))
        scale = distance / (distance - near + rise * towards[1])
        shown = (above - rise * up[1]) * scale
        low, high = shown.min(), shown.max()
        rise += float(low + high) / 2
        height = max(float(high - low) * _MARGIN, 2 * float(np.abs(across * scale).max()) * _SIDE / aspect)
    return rise, height


def gallery(path: Path, bodies: Sequence[Body], *, width: int = 1600, columns: int = 8) -> None:
    """Write several identities side by side, standing on one floor at one scale.

    Args:
        path: the PNG.
        bodies: one an identity.
        width: width of the picture in pixels.
        columns: at most so many bodies in a row; rows are filled evenly.

    Raises:
        InputError: pyvista is not installed.
    """
    columns = math.ceil(len(bodies) / math.ceil(len(bodies) / columns))
    top = max(float(body.vertices[:, 1].max()) for body in bodies) * 1.14
    distance = top / 2 / np.tan(np.radians(VIEW_ANGLE / 2))
    rows = [_line(bodies[start : start + columns], distance) for start in range(0, len(bodies), columns)]
    span = max(*(width for _, _, width in rows), 1.5 * top)
    pictures = []
    with open_stage((width, int(width * top / span))) as stage:
        for line, centres, _ in rows:
            picture = stage.shot(line, focus=(0, top * 0.45, 0), height=top, flat=True)
            pictures.append(_captioned(picture, line, (centres / span + 0.5) * width, columns))
    atomic_write(path, lambda target: _stacked(pictures).save(target, "PNG"))


def _spin(degrees: float) -> np.ndarray:
    """Rotation about +Y, (3, 3)."""
    turn = np.radians(degrees)
    return np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])


def _line(
    bodies: Sequence[Body], distance: float, *, gap: float = 0.16
) -> tuple[list[Body], np.ndarray, float]:
    """Turn bodies a little and line them up along x.

    Each is turned by its bearing as well, so that a camera at `distance` [m] sees all from one side.

    Returns:
        The bodies, the x under which each carries most of its mass, and the width of the line [m].
    """
    widths = np.array([np.ptp((body.vertices @ _spin(-_GALLERY_AZIMUTH).T)[:, 0]) + gap for body in bodies])
    places = np.cumsum(widths) - widths / 2 - widths.sum() / 2
    bearings = np.degrees(np.arctan2(places, distance))
    turned = [
        body.vertices @ _spin(-_GALLERY_AZIMUTH - bearing).T
        for body, bearing in zip(bodies, bearings, strict=True)
    ]
    moved = []
    for body, vertices, place in zip(bodies, turned, places, strict=True):
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        shift = np.array([place - middle[0], 0, -middle[2]])
        moved.append(replace(body, vertices=vertices + shift))
    centres = np.array([np.median(body.vertices[:, 0]) for body in moved])
    return moved, centres, float(widths.sum() + gap)


def _faded(cell: Image) -> Image:
    """Let shadows run out before the edge of a cell; the framing keeps the body itself inside."""
    from PIL import Image

    wide, tall = cell.size
    across = np.minimum(np.arange(wide), np.arange(wide)[::-1]) / (0.07 * wide)
    below = np.arange(tall)[::-1] / (0.035 * tall)
    ramp = np.clip(np.minimum(across[None], below[:, None]), 0, 1)
    mask = Image.fromarray((255 * ramp**2 * (3 - 2 * ramp)).astype(np.uint8))
    return Image.composite(cell, Image.new("RGB", cell.size, _rgb(PAPER)), mask)


def _grid(cells: Sequence[Image], bodies: Sequence[Body], columns: int) -> Image:
    """Tile cells with their captions."""
    from PIL import Image, ImageDraw

    wide, tall = cells[0].size
    size, band = _caption_sizes(wide)
    rows = -(-len(cells) // columns)
    sheet = Image.new("RGB", (wide * columns, (tall + band) * rows), _rgb(PAPER))
    draw = ImageDraw.Draw(sheet)
    for index, (cell, body) in enumerate(zip(cells, bodies, strict=True)):
        x, y = index % columns * wide, index // columns * (tall + band)
        sheet.paste(cell, (x, y))
        _write_caption(draw, body.caption, x + wide / 2, y + tall, size)
    return sheet


def _captioned(picture: Image, bodies: Sequence[Body], places: np.ndarray, columns: int) -> Image:
    """Add a band with one caption below each body, in the size for a row of so many."""
    from PIL import Image, ImageDraw

    size, band = _caption_sizes(picture.width // max(columns, 4))
    lines = max(body.caption.count("\n") + 1 for body in bodies)
    sheet = Image.new("RGB", (picture.width, picture.height + band + (lines - 1) * size), _rgb(PAPER))
    sheet.paste(picture, (0, 0))
    for body, place in zip(bodies, places, strict=True):
        _write_caption(ImageDraw.Draw(sheet), body.caption, place, picture.height, size)
    return sheet


def _caption_sizes(cell: int) -> tuple[int, int]:
    """Font size and height of the caption band for a cell of this width."""
    size = int(np.clip(cell // 17, 11, 26))
    return size, 2 * size


def _write_caption(draw: Any, caption: str, x: float, y: float, size: int) -> None:
    from PIL import ImageFont

    for index, line in enumerate(caption.splitlines()):
        scale = size if index == 0 else int(size * 0.8)
        font = ImageFont.load_default(scale)
        draw.text((x, y + index * size * 1.15), line, fill=_INK, font=font, anchor="ma")


def _stacked(pictures: Sequence[Image]) -> Image:
    from PIL import Image

    sheet = Image.new("RGB", (pictures[0].width, sum(p.height for p in pictures)), _rgb(PAPER))
    y = 0
    for picture in pictures:
        sheet.paste(picture, (0, y))
        y += picture.height
    return sheet


def _rgb(colour: Sequence[float]) -> tuple[int, ...]:
    return tuple(round(255 * c) for c in colour)


def with_eyes(body: Body, transforms: np.ndarray, rig: Rig) -> Body:
    """The same body to draw, with eyeballs that look where their joints do.

    Args:
        body: a posed canonical body.
        transforms: (78, 4, 4) world transforms of its joints [m].
        rig: of the body.
    """
    turns = transforms[1:, :3, :3] @ rig.t_pose_world[1:, :3, :3].transpose(0, 2, 1)
    ball, faces, shades = eyeball()
    radius, centres = eyeball_places(transforms[1:, :3, 3], turns)
    count = len(body.vertices)
    skin = np.tile(body.colour, (count, 1)) if body.shades is None else body.shades
    balls = [radius * ball @ turns[eye].T + centre for eye, centre in zip(EYES, centres, strict=True)]
    return replace(
        body,
        vertices=np.concatenate([body.vertices, *balls]),
        triangles=np.concatenate([body.triangles, faces + count, faces + count + len(ball)]),
        shades=np.concatenate([skin, shades / 255, shades / 255]),
    )
