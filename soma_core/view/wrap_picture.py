"""Picture of a wrap: overlay, checkerboard through the UVs, distances, head and foot, both hands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from soma_core._lazy import needed
from soma_core.cache import atomic_write
from soma_core.geometry.mesh import vertex_normals
from soma_core.registration.digits import digit_guide
from soma_core.registration.quality import Quality
from soma_core.registration.register import Registration
from soma_core.rig import load_canonical
from soma_core.rig.landmarks import canonical_landmarks
from soma_core.rig.mesh import CanonicalMesh
from soma_core.view.error_picture import colour_bar, error_colours, scale_top
from soma_core.view.stage import PAPER, quiet_display

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["View", "draw_wrap", "poly", "shot", "table"]

_CELL = (430, 640)
_CELLS_IN_ROW = 4
_OVERSAMPLING = 2
_NATIVE, _WRAP, _LINES, _WRONG = (0.62, 0.70, 0.80), (0.93, 0.78, 0.45), (0.25, 0.2, 0.15), (0.85, 0.1, 0.1)
_FINGERS = ((0.85, 0.4, 0.3), (0.95, 0.7, 0.2), (0.5, 0.7, 0.35), (0.3, 0.6, 0.75), (0.6, 0.45, 0.7))
_INK = (70, 70, 72)
_CHECKS = 40
"""Checks along one side of the UV square."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Where the camera looks: a point, the direction towards it, the height seen [m], what is up."""

    focus: np.ndarray
    towards: tuple[float, float, float] | np.ndarray
    height: float
    up: tuple[float, float, float] | np.ndarray = (0.0, 1.0, 0.0)


def draw_wrap(path: Path, found: Registration, quality: Quality, mesh: CanonicalMesh) -> None:
    """Write the picture of a registration.

    Raises:
        InputError: pyvista is not installed.
    """
    scene = _Scene(found, quality, mesh)
    rows = [scene.far(), scene.near(), scene.hands()]
    sheet = table(rows, colour_bar(_CELL[0] * _CELLS_IN_ROW, scene.top))
    atomic_write(path, lambda target: sheet.save(target, "PNG"))


def _pyvista() -> Any:
    return needed("pyvista", setting="picture", pip="[render]", otherwise="pass picture=false")


def shot(actors: Sequence[tuple[Any, dict[str, Any]] | None], view: View) -> Image:
    """One cell of a sheet: meshes of pyvista with how they look, seen without perspective."""
    from PIL import Image

    size = [side * _OVERSAMPLING for side in _CELL]
    with quiet_display():
        plotter = _pyvista().Plotter(off_screen=True, window_size=size)
        plotter.set_background(PAPER)
        for data, look in filter(None, actors):
            plotter.add_mesh(data, render=False, **look)
        direction = np.array(view.towards) / np.linalg.norm(view.towards)
        camera = plotter.camera
        camera.focal_point, camera.position, camera.up = view.focus, view.focus + 3 * direction, view.up
        camera.parallel_projection, camera.parallel_scale = True, view.height / 2
        plotter.renderer.ResetCameraClippingRange()
        pixels = plotter.screenshot(return_img=True)
        plotter.close()
    picture = Image.fromarray(np.ascontiguousarray(pixels[..., :3]))
    return picture.resize(_CELL, Image.Resampling.LANCZOS)


def poly(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None) -> Any:
    """A mesh of pyvista."""
    data = _pyvista().PolyData(vertices, np.insert(faces, 0, faces.shape[1], axis=1).ravel())
    if normals is not None:
        data.point_data.active_normals = normals
    return data


class _Scene:
    """The meshes of one picture, in metres, +Y up, +Z forward."""

    def __init__(self, found: Registration, quality: Quality, mesh: CanonicalMesh) -> None:
        self._mesh = mesh
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
            View(focus=middle, towards=towards, height=height)
            for towards in ((0.35, 0.1, 1), (-0.35, 0.1, -1))
        )
        overlay = [self._native_skin(), self._edges()]
        checks = [self._checked(), self._wrong()]
        distance = [self._shaded(self._wrap, self._mesh.triangles, self._shades)]
        return [
            ("overlay: wrap's edges on the native mesh", shot(overlay, front)),
            ("checkerboard through the UVs", shot(checks, front)),
            ("the same from behind", shot(checks, behind)),
            ("distance, wrap to surface", shot(distance, front)),
        ]

    def near(self) -> list[tuple[str, Image]]:
        """Head and feet, and what of the native skin is not covered."""
        wrap, segments = self._wrap, self._mesh.segments
        feet = wrap[segments["feet"]]
        sides, head = (feet[feet[:, 0] > 0], feet[feet[:, 0] < 0]), wrap[segments["head"]]
        tall = float(np.ptp(wrap[:, 1]))
        views = [
            ("head", View(focus=(head.min(0) + head.max(0)) / 2, towards=(0.5, 0.05, 1), height=0.2 * tall)),
            *(
                (
                    f"{name} foot",
                    View(focus=(foot.min(0) + foot.max(0)) / 2, towards=(away, 0.6, 1), height=0.22 * tall),
                )
                for name, away, foot in zip(("left", "right"), (0.5, -0.5), sides, strict=True)
            ),
        ]
        drawn = [(name, shot([self._skin(), self._edges(), self._wrong()], view)) for name, view in views]
        middle = (wrap.min(0) + wrap.max(0)) / 2
        whole = View(focus=middle, towards=(0.35, 0.1, 1), height=1.08 * tall)
        back = shot([self._shaded(*self._native, self._back)], whole)
        return [*drawn, ("distance, surface to wrap", back)]

    def hands(self) -> list[tuple[str, Image]]:
        """Both hands from both sides: each finger of the wrap in a colour, the native skin below."""
        cells = []
        _, rig = load_canonical("mid")
        moved = np.array(rig.joint_names)[rig.weights.toarray().argmax(1)]
        nearest = cKDTree(self._wrap).query(self._native[0])[1]
        for side in ("Left", "Right"):
            hand = np.char.startswith(moved, f"{side}Hand")
            shown = [self._part(self._native_skin(), hand[nearest]), self._part(self._fingers(), hand)]
            wrist, index, middle, pinky, tip = (
                self._wrap[canonical_landmarks()[f"{side}{name}"]]
                for name in ("WristThumbSide", "IndexKnuckle", "MiddleKnuckle", "PinkyKnuckle", "MiddleTip")
            )
            out, across = tip - wrist, index - pinky
            back = np.cross(middle - wrist, across) * (-1 if side == "Left" else 1)
            height = float(1.7 * np.linalg.norm(middle - wrist) + 1.2 * np.linalg.norm(tip - middle))
            for name, towards in (("back", back), ("palm", -back)):
                view = View(focus=(wrist + tip) / 2, towards=towards, height=height, up=-out)
                cells.append((f"{side.lower()} hand, {name}", shot(shown, view)))
        return cells

    @staticmethod
    def _part(actor: tuple[Any, dict[str, Any]], kept: np.ndarray) -> tuple[Any, dict[str, Any]]:
        """Faces all of whose vertices are kept: a thigh would hide a hanging hand."""
        data, look = actor
        faces = data.faces.reshape(-1, 4)
        chosen = kept[faces[:, 1:]].all(1)
        part = data.copy()
        part.faces = faces[chosen].ravel()
        return part, look

    def _fingers(self) -> tuple[Any, dict[str, Any]]:
        """The wrap a little outside the native skin, its fingers in five colours."""
        lifted = self._wrap + 8e-4 * vertex_normals(self._wrap, self._mesh.triangles)
        shades = np.tile(np.array(_WRAP), (len(lifted), 1))
        for along in digit_guide().along.values():
            for digit, colour in zip(along, _FINGERS, strict=True):
                shades[digit > 0] = colour
        return self._shaded(lifted, self._mesh.triangles, shades)

    def _native_skin(self) -> tuple[Any, dict[str, Any]]:
        data = poly(*self._native, vertex_normals(*self._native))
        return data, {"color": _NATIVE, "smooth_shading": True}

    def _skin(self) -> tuple[Any, dict[str, Any]]:
        data = poly(self._wrap, self._mesh.triangles)
        return data, {"color": _WRAP, "smooth_shading": False}

    def _edges(self) -> tuple[Any, dict[str, Any]]:
        quads = self._mesh.face_vert_indices.reshape(-1, 4) if self._all_quads else self._mesh.triangles
        lifted = self._wrap + 5e-4 * vertex_normals(self._wrap, self._mesh.triangles)
        look = {"style": "wireframe", "color": _LINES, "line_width": 1.0, "opacity": 0.5, "lighting": False}
        return poly(lifted, quads), look

    @property
    def _all_quads(self) -> bool:
        return bool((self._mesh.face_vert_counts == 4).all())

    def _wrong(self) -> tuple[Any, dict[str, Any]] | None:
        if not len(self._flipped):
            return None
        lifted = self._wrap + 1e-3 * vertex_normals(self._wrap, self._mesh.triangles)
        return poly(lifted, self._flipped), {"color": _WRONG, "lighting": False}

    def _shaded(
        self, vertices: np.ndarray, triangles: np.ndarray, shades: np.ndarray
    ) -> tuple[Any, dict[str, Any]]:
        data = poly(vertices, triangles, vertex_normals(vertices, triangles))
        return data, {"scalars": np.round(255 * shades).astype(np.uint8), "rgb": True, "smooth_shading": True}

    def _checked(self) -> tuple[Any, dict[str, Any]]:
        """The wrap cut at the seams of its UVs, under a checkerboard."""
        mesh = self._mesh
        if not (self._all_quads and len(mesh.uv)):
            return self._skin()
        pairs = np.stack([mesh.face_vert_indices, mesh.uv_indices], 1)
        corners, ids = np.unique(pairs, axis=0, return_inverse=True)
        normals = vertex_normals(self._wrap, mesh.triangles)[corners[:, 0]]
        data = poly(self._wrap[corners[:, 0]], ids.reshape(-1, 4), normals)
        data.active_texture_coordinates = mesh.uv[corners[:, 1]].astype(np.float32)
        board = np.kron(np.indices((_CHECKS, _CHECKS)).sum(0) % 2, np.ones((32, 32)))[..., None]
        image = np.round(255 * (board * np.array(_WRAP) + (1 - board) * np.array([0.3, 0.36, 0.45])))
        return data, {"texture": _pyvista().Texture(image.astype(np.uint8)), "smooth_shading": True}


def table(rows: Sequence[Sequence[tuple[str, Image]]], foot: Image | None = None) -> Image:
    """Cells with captions, and a picture below."""
    from PIL import Image, ImageDraw, ImageFont

    band, size = 30, 17
    paper = tuple(round(255 * shade) for shade in PAPER)
    width, below = _CELL[0] * max(map(len, rows)), foot.height if foot else 0
    sheet = Image.new("RGB", (width, (_CELL[1] + band) * len(rows) + below), paper)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size)
    for row, cells in enumerate(rows):
        for column, (caption, cell) in enumerate(cells):
            x, y = column * _CELL[0], row * (_CELL[1] + band)
            sheet.paste(cell, (x, y))
            draw.text((x + _CELL[0] / 2, y + _CELL[1] + 4), caption, fill=_INK, font=font, anchor="ma")
    if foot:
        sheet.paste(foot, (0, sheet.height - foot.height))
    return sheet
