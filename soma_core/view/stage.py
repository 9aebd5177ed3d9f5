"""Off-screen renderer for posed bodies: lights, a floor that shows only shadows, and a camera."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.ndimage

from soma_core._lazy import needed
from soma_core.geometry.mesh import vertex_normals

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["AZIMUTH", "PAPER", "VIEW_ANGLE", "Body", "Stage", "camera_axes", "open_stage", "quiet_display"]

PAPER = (0.965, 0.965, 0.96)
"""Colour of the background, sRGB in 0..1."""

VIEW_ANGLE = 18.0
# A longer lens would be nearer to the paper's figures, but then ambient occlusion sees less.
AZIMUTH = 24.0
"""Degrees by which the camera stands to the side of what it looks at."""

_ELEVATION = 7.0
_HALF = 2.0**-10
"""VTK keeps positions for its ambient occlusion in half precision, steps of this share of their distance at
most. What is nearer to a surface than one of them counts as the surface, or skin shows rings like those of
wood."""

_OCCLUSION = 0.12
"""Radius of ambient occlusion [m]."""

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
        shades: (v, 3) sRGB in 0..1, a colour for each vertex instead of `colour`.
        caption: text below the body; a second line is drawn smaller.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    colour: tuple[float, float, float]
    shades: np.ndarray | None = None
    caption: str = ""


@contextmanager
def open_stage(size: tuple[int, int], *, oversampling: int = 3) -> Iterator[Stage]:
    """Off-screen renderer of pictures of a size in pixels, closed at the end.

    Args:
        size: width and height.
        oversampling: pixels that are drawn for each, along a side.

    Raises:
        InputError: pyvista is not installed.
    """
    pyvista = needed("pyvista", setting="write", pip="[render]", otherwise="leave png out of it")
    with quiet_display():
        stage = Stage(pyvista, size, oversampling)
    try:
        yield stage
    finally:
        stage.close()


@contextmanager
def quiet_display() -> Iterator[None]:
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


class Stage:
    """Lights, floor and camera; draws one set of bodies after another."""

    def __init__(self, pyvista: Any, size: tuple[int, int], oversampling: int) -> None:
        self._pv, self._size, self._oversampling = pyvista, size, oversampling
        size = (size[0] * oversampling, size[1] * oversampling)
        self._distance = 0.0
        self._plotter = pyvista.Plotter(off_screen=True, window_size=size, lighting="none")
        self._plotter.set_background(PAPER)
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
        self._plotter.show(auto_close=False)  # a plotter that was never shown keeps its first picture

    def close(self) -> None:
        """Free the renderer."""
        self._plotter.close()

    def shot(
        self,
        bodies: Sequence[Body],
        *,
        focus: Sequence[float],
        height: float,
        flat: bool = False,
        floor: float | None = None,
    ) -> Image:
        """Draw `bodies` with `height` metres of the plane through `focus` filling the picture.

        The floor lies at y = `floor`, or under the lowest of them.
        """
        from PIL import Image

        actors = [self._add_body(body) for body in bodies]
        actors.append(self._add_floor(bodies, floor))
        self._aim(np.asarray(focus, float), height, azimuth=0.0 if flat else AZIMUTH)
        with quiet_display():
            self._plotter.render()
            pixels = self._plotter.screenshot(return_img=True)
        for actor in actors:
            self._plotter.remove_actor(actor, render=False)
        picture = Image.fromarray(np.ascontiguousarray(pixels[..., :3]))
        return picture.resize(self._size, Image.Resampling.LANCZOS)

    def _add_body(self, body: Body) -> Any:
        faces = np.insert(body.triangles, 0, 3, axis=1).reshape(-1)
        mesh = self._pv.PolyData(body.vertices.astype(np.float32), faces)
        mesh.point_data.active_normals = vertex_normals(body.vertices, body.triangles).astype(np.float32)
        paint: dict[str, Any] = {"color": body.colour}
        if body.shades is not None:
            paint = {"scalars": np.round(255 * body.shades).astype(np.uint8), "rgb": True}
        return self._plotter.add_mesh(mesh, smooth_shading=True, render=False, **paint, **_SKIN)

    def _add_floor(self, bodies: Sequence[Body], floor: float | None) -> Any:
        """A floor of the colour of the background that shows nothing but the soft shadow of the bodies."""
        shadow, low, high, level = _shadow(bodies, floor)
        points = np.array([[x, level - 0.002, z] for z in (low[1], high[1]) for x in (low[0], high[0])])
        plane = self._pv.PolyData(points, [4, 0, 1, 3, 2])
        plane.active_texture_coordinates = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
        tint = (1 - shadow[..., None] * np.array([0.44, 0.43, 0.41])) * np.array(PAPER) * 255
        texture = self._pv.Texture(np.ascontiguousarray(np.flipud(np.round(tint).astype(np.uint8))))
        texture.interpolate = True
        return self._plotter.add_mesh(plane, texture=texture, lighting=False, render=False)

    def _aim(self, focus: np.ndarray, height: float, *, azimuth: float) -> None:
        distance = height / 2 / np.tan(np.radians(VIEW_ANGLE / 2))
        direction = camera_axes(azimuth)[2]
        camera = self._plotter.camera
        camera.view_angle = VIEW_ANGLE
        camera.focal_point, camera.position, camera.up = focus, focus + distance * direction, (0, 1, 0)
        self._plotter.renderer.ResetCameraClippingRange()
        if abs(distance - self._distance) > 1e-3 * distance:
            self._distance = distance
            self._plotter.disable_ssao()
            self._plotter.enable_ssao(radius=_OCCLUSION, bias=_HALF * distance, kernel_size=48)


def camera_axes(azimuth: float) -> np.ndarray:
    """Rows: what the camera sees as rightwards and as upwards, and the direction towards it."""
    side, up = np.radians(azimuth), np.radians(_ELEVATION)
    return np.array(
        [
            [np.cos(side), 0, -np.sin(side)],
            [-np.sin(side) * np.sin(up), np.cos(up), -np.cos(side) * np.sin(up)],
            [np.sin(side) * np.cos(up), np.sin(up), np.cos(side) * np.cos(up)],
        ]
    )


def _shadow(
    bodies: Sequence[Body], floor: float | None, pixel: float = 0.01
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Shadow on the floor in 0..1 (rows z, columns x), its corners (x, z) and the height of the floor."""
    points = np.concatenate([body.vertices for body in bodies])
    level = float(points[:, 1].min()) if floor is None else floor
    above = np.maximum(points[:, 1] - level, 0)
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
