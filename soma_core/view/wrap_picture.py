"""Picture of a wrap: overlay, checkerboard through the UVs, distances, and what it looks like from near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soma_core.cache import atomic_write
from soma_core.errors import SomaError
from soma_core.geometry.mesh import vertex_normals
from soma_core.registration.quality import Quality
from soma_core.registration.register import Registration
from soma_core.rig.mesh import CanonicalMesh
from soma_core.view.error_picture import colour_bar, error_colours, scale_top
from soma_core.view.stage import PAPER, quiet_display

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["draw_wrap"]

_CELL = (430, 640)
_CELLS_IN_ROW = 4
_OVERSAMPLING = 2
_NATIVE, _WRAP, _LINES, _WRONG = (0.62, 0.70, 0.80), (0.93, 0.78, 0.45), (0.25, 0.2, 0.15), (0.85, 0.1, 0.1)
_INK = (70, 70, 72)
_CHECKS = 40
"""Checks along one side of the UV square."""


@dataclass(frozen=True, kw_only=True)
class _View:
    """Where the camera looks: a point, the direction towards it, the height seen [m]."""

    focus: np.ndarray
    towards: tuple[float, float, float]
    height: float


def draw_wrap(path: Path, found: Registration, quality: Quality, mesh: CanonicalMesh) -> None:
    """Write the picture of a registration.

    Raises:
        SomaError: pyvista is not installed.
    """
    try:
        import pyvista
    except ImportError as error:
        raise SomaError(
            "pictures need pyvista, which is not installed. Run: pip install 'soma-body-core[render]' "
            "(or pass picture=false)."
        ) from error
    scene = _Scene(pyvista, found, quality, mesh)
    rows = [scene.far(), scene.near()]
    atomic_write(path, lambda target: _sheet(rows, scene.top).save(target, "PNG"))


class _Scene:
    """The meshes of one picture, in metres, +Y up, +Z forward."""

    def __init__(self, pyvista: Any, found: Registration, quality: Quality, mesh: CanonicalMesh) -> None:
        self._pv, self._mesh = pyvista, mesh
        surface = found.skin.surface(found.frame)
        self._native = surface.vertices, surface.triangles
        self._wrap = found.frame.to_canonical(found.wrap)
        self._flipped = mesh.triangles[quality.flipped]
        self.top = scale_top(np.concatenate([quality.distance, quality.uncovered]))
        self._shades = error_colours(quality.distance, self.top)
        self._back = error_colours(quality.uncovered, self.top)

    def far(self) -> list[tuple[str, Image]]:
        """The whole body."""
        low, high = self._wrap.min(0), self._wrap.max(0)
        wide = max(high[0] - low[0], high[2] - low[2]) * _CELL[1] / _CELL[0]
        middle, height = (low + high) / 2, 1.08 * max(high[1] - low[1], wide)
        front, behind = (
            _View(focus=middle, towards=towards, height=height)
            for towards in ((0.35, 0.1, 1), (-0.35, 0.1, -1))
        )
        overlay = [self._native_skin(), self._edges()]
        checks = [self._checked(), self._wrong()]
        distance = [self._shaded(self._wrap, self._mesh.triangles, self._shades)]
        return [
            ("overlay: wrap's edges on the native mesh", self._shot(overlay, front)),
            ("checkerboard through the UVs", self._shot(checks, front)),
            ("the same from behind", self._shot(checks, behind)),
            ("distance, wrap to surface", self._shot(distance, front)),
        ]

    def near(self) -> list[tuple[str, Image]]:
        """Head, hand and foot, and what of the native skin is not covered."""
        wrap, segments = self._wrap, self._mesh.segments
        hand = wrap[wrap[:, 0].argmax()]
        feet = wrap[segments["feet"]]
        foot, head = feet[feet[:, 0] > 0], wrap[segments["head"]]
        tall = float(np.ptp(wrap[:, 1]))
        views = [
            ("head", _View(focus=(head.min(0) + head.max(0)) / 2, towards=(0.5, 0.05, 1), height=0.2 * tall)),
            ("hand", _View(focus=hand - [0.06, -0.02, 0], towards=(0.6, 0.5, 0.9), height=0.2 * tall)),
            ("foot", _View(focus=(foot.min(0) + foot.max(0)) / 2, towards=(0.5, 0.6, 1), height=0.22 * tall)),
        ]
        drawn = [
            (name, self._shot([self._skin(), self._edges(), self._wrong()], view)) for name, view in views
        ]
        middle = (wrap.min(0) + wrap.max(0)) / 2
        whole = _View(focus=middle, towards=(0.35, 0.1, 1), height=1.08 * tall)
        back = self._shot([self._shaded(*self._native, self._back)], whole)
        return [*drawn, ("distance, surface to wrap", back)]

    def _shot(self, actors: Sequence[tuple[Any, dict[str, Any]] | None], view: _View) -> Image:
        from PIL import Image

        size = [side * _OVERSAMPLING for side in _CELL]
        with quiet_display():
            plotter = self._pv.Plotter(off_screen=True, window_size=size)
            plotter.set_background(PAPER)
            for data, look in filter(None, actors):
                plotter.add_mesh(data, render=False, **look)
            direction = np.array(view.towards) / np.linalg.norm(view.towards)
            camera = plotter.camera
            camera.focal_point, camera.position, camera.up = view.focus, view.focus + 3 * direction, (0, 1, 0)
            camera.parallel_projection, camera.parallel_scale = True, view.height / 2
            plotter.renderer.ResetCameraClippingRange()
            pixels = plotter.screenshot(return_img=True)
            plotter.close()
        picture = Image.fromarray(np.ascontiguousarray(pixels[..., :3]))
        return picture.resize(_CELL, Image.Resampling.LANCZOS)

    def _poly(self, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None) -> Any:
        data = self._pv.PolyData(vertices, np.insert(faces, 0, faces.shape[1], axis=1).ravel())
        if normals is not None:
            data.point_data.active_normals = normals
        return data

    def _native_skin(self) -> tuple[Any, dict[str, Any]]:
        data = self._poly(*self._native, vertex_normals(*self._native))
        return data, {"color": _NATIVE, "smooth_shading": True}

    def _skin(self) -> tuple[Any, dict[str, Any]]:
        data = self._poly(self._wrap, self._mesh.triangles)
        return data, {"color": _WRAP, "smooth_shading": False}

    def _edges(self) -> tuple[Any, dict[str, Any]]:
        quads = self._mesh.face_vert_indices.reshape(-1, 4) if self._all_quads else self._mesh.triangles
        lifted = self._wrap + 5e-4 * vertex_normals(self._wrap, self._mesh.triangles)
        look = {"style": "wireframe", "color": _LINES, "line_width": 1.0, "opacity": 0.5, "lighting": False}
        return self._poly(lifted, quads), look

    @property
    def _all_quads(self) -> bool:
        return bool((self._mesh.face_vert_counts == 4).all())

    def _wrong(self) -> tuple[Any, dict[str, Any]] | None:
        if not len(self._flipped):
            return None
        lifted = self._wrap + 1e-3 * vertex_normals(self._wrap, self._mesh.triangles)
        return self._poly(lifted, self._flipped), {"color": _WRONG, "lighting": False}

    def _shaded(
        self, vertices: np.ndarray, triangles: np.ndarray, shades: np.ndarray
    ) -> tuple[Any, dict[str, Any]]:
        data = self._poly(vertices, triangles, vertex_normals(vertices, triangles))
        return data, {"scalars": np.round(255 * shades).astype(np.uint8), "rgb": True, "smooth_shading": True}

    def _checked(self) -> tuple[Any, dict[str, Any]]:
        """The wrap cut at the seams of its UVs, under a checkerboard."""
        mesh = self._mesh
        if not (self._all_quads and len(mesh.uv)):
            return self._skin()
        pairs = np.stack([mesh.face_vert_indices, mesh.uv_indices], 1)
        corners, ids = np.unique(pairs, axis=0, return_inverse=True)
        normals = vertex_normals(self._wrap, mesh.triangles)[corners[:, 0]]
        data = self._poly(self._wrap[corners[:, 0]], ids.reshape(-1, 4), normals)
        data.active_texture_coordinates = mesh.uv[corners[:, 1]].astype(np.float32)
        board = np.kron(np.indices((_CHECKS, _CHECKS)).sum(0) % 2, np.ones((32, 32)))[..., None]
        image = np.round(255 * (board * np.array(_WRAP) + (1 - board) * np.array([0.3, 0.36, 0.45])))
        return data, {"texture": self._pv.Texture(image.astype(np.uint8)), "smooth_shading": True}


def _sheet(rows: Sequence[Sequence[tuple[str, Image]]], top: float) -> Image:
    """Cells with captions, and the colour bar below."""
    from PIL import Image, ImageDraw, ImageFont

    band, size = 30, 17
    paper = tuple(round(255 * shade) for shade in PAPER)
    bar = colour_bar(_CELL[0] * _CELLS_IN_ROW, top)
    sheet = Image.new("RGB", (bar.width, (_CELL[1] + band) * len(rows) + bar.height), paper)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size)
    for row, cells in enumerate(rows):
        for column, (caption, cell) in enumerate(cells):
            x, y = column * _CELL[0], row * (_CELL[1] + band)
            sheet.paste(cell, (x, y))
            draw.text((x + _CELL[0] / 2, y + _CELL[1] + 4), caption, fill=_INK, font=font, anchor="ma")
    sheet.paste(bar, (0, sheet.height - bar.height))
    return sheet
