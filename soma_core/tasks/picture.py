"""Pictures of posed bodies: a contact sheet of one motion, and a gallery of several identities."""

from __future__ import annotations

import colorsys
import hashlib
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.ndimage

from soma_core.cache import atomic_write
from soma_core.errors import SomaError
from soma_core.io.clip import vertex_normals

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["Body", "backend_colour", "contact_sheet", "gallery"]

# The paper's figures: SOMA green, MHR blue, SMPL pink, Anny yellow.
_COLOURS = {
    "soma": (0.55, 0.74, 0.52),
    "mhr": (0.47, 0.65, 0.84),
    "smpl": (0.90, 0.60, 0.66),
    "smplx": (0.80, 0.56, 0.76),
    "anny": (0.93, 0.78, 0.45),
    "garment": (0.66, 0.62, 0.86),
}
_PAPER = (0.965, 0.965, 0.96)
_INK = (70, 70, 72)
_OVERSAMPLING = 3
_VIEW_ANGLE = 18.0
# A longer lens would be nearer to the paper's figures, but VTK keeps positions for its ambient occlusion in
# half precision: seen from further away, skin shows rings like those of wood.
_AZIMUTH, _ELEVATION = 24.0, 7.0
_GALLERY_AZIMUTH = 8.0
"""Less than in a contact sheet: there the pose that identities share hides one leg behind the other."""
_MARGIN, _SIDE = 1.13, 1.17
"""Height and width of a view in units of the body in it: more than what fades at the edges of a cell."""
_SKIN = {"ambient": 0.24, "diffuse": 0.86, "specular": 0.16, "specular_power": 14}
_SUN = np.array([0.05, -0.15])
"""Horizontal shift of a shadow for each metre above the floor (x, z)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """One posed body to draw.

    Attributes:
        vertices: (v, 3) [m], +Y up.
        triangles: (t, 3) vertex ids.
        colour: sRGB in 0..1.
        caption: text below the body; a second line is drawn smaller.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    colour: tuple[float, float, float]
    caption: str = ""


def backend_colour(name: str) -> tuple[float, float, float]:
    """Return the sRGB colour of a backend: the paper's, else a steady one derived from the name."""
    if name in _COLOURS:
        return _COLOURS[name]
    hue = hashlib.sha256(name.encode()).digest()[0] / 255
    return colorsys.hls_to_rgb(hue, 0.68, 0.42)


def contact_sheet(path: Path, bodies: Sequence[Body], *, width: int = 1600, columns: int = 5) -> None:
    """Write frames of one motion as a grid of cells, all at one scale, the camera following the body.

    Args:
        path: the PNG.
        bodies: one a frame.
        width: width of the picture in pixels.
        columns: cells in a row.

    Raises:
        SomaError: pyvista is not installed.
    """
    columns = min(columns, len(bodies))
    boxes = np.array([[body.vertices.min(axis=0), body.vertices.max(axis=0)] for body in bodies])
    floor = boxes[:, 0, 1].min()
    feet = boxes.mean(axis=1)
    feet[:, 1] = floor
    reach = max(float((boxes[:, 1, axis] - boxes[:, 0, axis]).max()) for axis in (0, 2)) * 1.1
    tall = (boxes[:, 1, 1].max() - floor) * 1.12
    cell = (width // columns, int(width / columns * max(tall / reach, 0.9)))
    rise, height = _framing(bodies, feet, cell[0] / cell[1])
    cells = []
    with _stage(cell) as stage:
        for body, place in zip(bodies, feet + np.array([0, rise, 0]), strict=True):
            cells.append(_faded(stage.shot([body], focus=place, height=height)))
    atomic_write(path, lambda target: _grid(cells, bodies, columns).save(target, "PNG"))


def _framing(bodies: Sequence[Body], feet: np.ndarray, aspect: float) -> tuple[float, float]:
    """Aim the camera so that it sees every body whole, with a margin in which shadows may fade.

    A hand near the camera is seen lower than where it is, so the sides of the bodies do not tell.

    Args:
        bodies: one a frame.
        feet: (frames, 3) [m], the point of the floor below each.
        aspect: width of a cell by its height.

    Returns:
        Height of the focus above the floor and height of the view there, both in metres.
    """
    side, up, towards = _camera_axes(_AZIMUTH)
    points = [body.vertices - place for body, place in zip(bodies, feet, strict=True)]
    across, above, near = (np.concatenate([part @ axis for part in points]) for axis in (side, up, towards))
    rise, height = 0.0, 2 * float(np.ptp(above))
    for _ in range(8):  # the nearer the camera, the wider the body: settles within a millimetre
        distance = height / 2 / np.tan(np.radians(_VIEW_ANGLE / 2))
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
        columns: bodies in a row.

    Raises:
        SomaError: pyvista is not installed.
    """
    top = max(float(body.vertices[:, 1].max()) for body in bodies) * 1.14
    distance = top / 2 / np.tan(np.radians(_VIEW_ANGLE / 2))
    rows = [_line(bodies[start : start + columns], distance) for start in range(0, len(bodies), columns)]
    span = max(*(width for _, _, width in rows), 1.5 * top)
    pictures = []
    with _stage((width, int(width * top / span))) as stage:
        for line, centres, _ in rows:
            picture = stage.shot(line, focus=(0, top * 0.45, 0), height=top, flat=True)
            pictures.append(_captioned(picture, line, (centres / span + 0.5) * width))
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


@contextmanager
def _stage(size: tuple[int, int]) -> Iterator[_Stage]:
    """Off-screen renderer that is closed at the end."""
    try:
        import pyvista
    except ImportError as error:
        raise SomaError(
            "pictures need pyvista, which is not installed. Run: pip install 'soma-body-core[render]' "
            "(or leave png out of write=[...])."
        ) from error
    with _quiet_display():
        stage = _Stage(pyvista, (size[0] * _OVERSAMPLING, size[1] * _OVERSAMPLING))
    try:
        yield stage
    finally:
        stage.close()


@contextmanager
def _quiet_display() -> Iterator[None]:
    """VTK warns on stderr before it falls back from a missing X server to EGL or software: silence that."""
    from vtkmodules.vtkCommonCore import vtkLogger

    without_display = sys.platform.startswith("linux") and not os.environ.get("DISPLAY")
    before = vtkLogger.GetCurrentVerbosityCutoff()
    if without_display:
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(before)


class _Stage:
    """Lights, floor and camera; draws one set of bodies after another."""

    def __init__(self, pyvista: Any, size: tuple[int, int]) -> None:
        self._pv, self._size = pyvista, size
        self._plotter = pyvista.Plotter(off_screen=True, window_size=size, lighting="none")
        self._plotter.set_background(_PAPER)
        for position, strength, colour in (
            ((-2.2, 3.4, 3.2), 0.88, (1.0, 0.97, 0.93)),
            ((3.4, 1.6, 2.2), 0.38, (0.90, 0.95, 1.0)),
            ((0.6, 2.6, -3.4), 0.5, (1.0, 1.0, 1.0)),
        ):
            light = pyvista.Light(
                position=position, focal_point=(0, 0.9, 0), color=colour, intensity=strength
            )
            light.positional = False
            self._plotter.add_light(light)
        self._plotter.enable_ssao(radius=0.12, bias=0.004, kernel_size=48)
        self._plotter.show(auto_close=False)  # a plotter that was never shown keeps its first picture

    def close(self) -> None:
        """Free the renderer."""
        self._plotter.close()

    def shot(
        self, bodies: Sequence[Body], *, focus: Sequence[float], height: float, flat: bool = False
    ) -> Image:
        """Draw `bodies` with `height` metres of the plane through `focus` filling the picture."""
        from PIL import Image

        actors = [self._add_body(body) for body in bodies]
        actors.append(self._add_floor(bodies))
        self._aim(np.asarray(focus, float), height, azimuth=0.0 if flat else _AZIMUTH)
        with _quiet_display():
            self._plotter.render()
            pixels = self._plotter.screenshot(return_img=True)
        for actor in actors:
            self._plotter.remove_actor(actor, render=False)
        picture = Image.fromarray(np.ascontiguousarray(pixels[..., :3]))
        return picture.resize([side // _OVERSAMPLING for side in self._size], Image.Resampling.LANCZOS)

    def _add_body(self, body: Body) -> Any:
        faces = np.insert(body.triangles, 0, 3, axis=1).reshape(-1)
        mesh = self._pv.PolyData(body.vertices.astype(np.float32), faces)
        mesh.point_data.active_normals = vertex_normals(body.vertices, body.triangles).astype(np.float32)
        return self._plotter.add_mesh(mesh, color=body.colour, smooth_shading=True, render=False, **_SKIN)

    def _add_floor(self, bodies: Sequence[Body]) -> Any:
        """A floor of the colour of the background that shows nothing but the soft shadow of the bodies."""
        shadow, low, high, level = _shadow(bodies)
        points = np.array([[x, level - 0.002, z] for z in (low[1], high[1]) for x in (low[0], high[0])])
        plane = self._pv.PolyData(points, [4, 0, 1, 3, 2])
        plane.active_texture_coordinates = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
        tint = (1 - shadow[..., None] * np.array([0.44, 0.43, 0.41])) * np.array(_PAPER) * 255
        texture = self._pv.Texture(np.ascontiguousarray(np.flipud(np.round(tint).astype(np.uint8))))
        texture.interpolate = True
        return self._plotter.add_mesh(plane, texture=texture, lighting=False, render=False)

    def _aim(self, focus: np.ndarray, height: float, *, azimuth: float) -> None:
        distance = height / 2 / np.tan(np.radians(_VIEW_ANGLE / 2))
        direction = _camera_axes(azimuth)[2]
        camera = self._plotter.camera
        camera.view_angle = _VIEW_ANGLE
        camera.focal_point, camera.position, camera.up = focus, focus + distance * direction, (0, 1, 0)
        self._plotter.renderer.ResetCameraClippingRange()


def _camera_axes(azimuth: float) -> np.ndarray:
    """Rows: what the camera sees as rightwards and as upwards, and the direction towards it."""
    side, up = np.radians(azimuth), np.radians(_ELEVATION)
    return np.array(
        [
            [np.cos(side), 0, -np.sin(side)],
            [-np.sin(side) * np.sin(up), np.cos(up), -np.cos(side) * np.sin(up)],
            [np.sin(side) * np.cos(up), np.sin(up), np.cos(side) * np.cos(up)],
        ]
    )


def _shadow(bodies: Sequence[Body], pixel: float = 0.01) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Shadow on the floor in 0..1 (rows z, columns x), its corners (x, z) and the height of the floor."""
    points = np.concatenate([body.vertices for body in bodies])
    level = float(points[:, 1].min())
    above = points[:, 1] - level
    cast = points[:, [0, 2]] + above[:, None] * _SUN
    low = np.minimum(cast.min(axis=0), points[:, [0, 2]].min(axis=0)) - 0.8
    high = np.maximum(cast.max(axis=0), points[:, [0, 2]].max(axis=0)) + 0.8
    counts = np.ceil((high - low) / pixel).astype(int)
    high = low + counts * pixel

    def soft(where: np.ndarray, weight: np.ndarray, blur: float) -> np.ndarray:
        cells = ((where - low) / pixel).astype(int)
        image = np.zeros(counts[::-1])
        np.add.at(image, (cells[:, 1], cells[:, 0]), weight)
        return 1 - np.exp(-scipy.ndimage.gaussian_filter(image, blur / pixel))

    broad = soft(cast, np.full(len(points), 0.9), 0.05)
    contact = soft(points[:, [0, 2]], 1.6 * np.exp(-above / 0.06), 0.018)
    return np.clip(0.42 * broad + 0.62 * contact, 0, 1), low, high, level


def _faded(cell: Image) -> Image:
    """Let shadows run out before the edge of a cell; the framing keeps the body itself inside."""
    from PIL import Image

    wide, tall = cell.size
    across = np.minimum(np.arange(wide), np.arange(wide)[::-1]) / (0.07 * wide)
    below = np.arange(tall)[::-1] / (0.035 * tall)
    ramp = np.clip(np.minimum(across[None], below[:, None]), 0, 1)
    mask = Image.fromarray((255 * ramp**2 * (3 - 2 * ramp)).astype(np.uint8))
    return Image.composite(cell, Image.new("RGB", cell.size, _rgb(_PAPER)), mask)


def _grid(cells: Sequence[Image], bodies: Sequence[Body], columns: int) -> Image:
    """Tile cells with their captions."""
    from PIL import Image, ImageDraw

    wide, tall = cells[0].size
    size, band = _caption_sizes(wide)
    rows = -(-len(cells) // columns)
    sheet = Image.new("RGB", (wide * columns, (tall + band) * rows), _rgb(_PAPER))
    draw = ImageDraw.Draw(sheet)
    for index, (cell, body) in enumerate(zip(cells, bodies, strict=True)):
        x, y = index % columns * wide, index // columns * (tall + band)
        sheet.paste(cell, (x, y))
        _write_caption(draw, body.caption, x + wide / 2, y + tall, size)
    return sheet


def _captioned(picture: Image, bodies: Sequence[Body], places: np.ndarray) -> Image:
    """Add a band with one caption below each body."""
    from PIL import Image, ImageDraw

    size, band = _caption_sizes(picture.width // max(len(bodies), 4))
    lines = max(body.caption.count("\n") + 1 for body in bodies)
    sheet = Image.new("RGB", (picture.width, picture.height + band + (lines - 1) * size), _rgb(_PAPER))
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

    sheet = Image.new("RGB", (pictures[0].width, sum(p.height for p in pictures)), _rgb(_PAPER))
    y = 0
    for picture in pictures:
        sheet.paste(picture, (0, y))
        y += picture.height
    return sheet


def _rgb(colour: Sequence[float]) -> tuple[int, ...]:
    return tuple(round(255 * c) for c in colour)
