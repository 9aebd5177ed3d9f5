"""The named points of the canonical mesh, drawn on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soma_core.cache import atomic_write
from soma_core.geometry.mesh import vertex_normals
from soma_core.rig import load_canonical
from soma_core.rig.landmarks import canonical_landmarks
from soma_core.view.wrap_picture import View, poly, shot, table

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["draw_landmarks"]

_SKIN, _DOT, _INK = (0.62, 0.70, 0.80), (200, 40, 30), (40, 40, 42)
_FACING = -0.3
"""Cosine between a point's normal and the direction to the camera from which it is seen."""


def draw_landmarks(path: Path) -> None:
    """Write a PNG: head, body, left hand and foot, each with the points of it that are seen from there.

    Raises:
        InputError: pyvista is not installed.
    """
    points = load_canonical("mid")[0].vertices
    at = {name: points[number] for name, number in canonical_landmarks().items()}
    wrist, tip, heel, toe = (
        at[f"Left{name}"] for name in ("WristThumbSide", "MiddleTip", "Heel", "BigToeTip")
    )
    body = (points.min(0) + points.max(0)) / 2
    down = tuple((wrist - tip).tolist())
    hand, foot, face = (wrist + tip) / 2, (heel + toe) / 2 + [0.03, 0.05, 0], at["NoseTip"] + [0, 0.03, -0.06]
    small, far = ("Tip", "Knuckle", "Eye", "Mouth", "Wrist"), ("Knee", "Navel", "Nipple", "Crotch", "Right")
    cells = [
        ("body", View(focus=body, towards=(0.25, 0.1, 1), height=1.95), small),
        ("from behind", View(focus=body, towards=(-0.25, 0.1, -1), height=1.95), small),
        ("head", View(focus=face, towards=(0.5, 0.05, 1), height=0.36), ()),
        ("left hand", View(focus=hand, towards=(1, 0.6, -0.2), height=0.3, up=down), far),
        ("left hand, palm", View(focus=hand, towards=(-1, -0.5, 0.3), height=0.3, up=down), far),
        ("left foot", View(focus=foot, towards=(0.8, 0.9, 0.6), height=0.4), far),
    ]
    drawn = [(caption, _cell(view, hidden)) for caption, view, hidden in cells]
    sheet = table([drawn[:3], drawn[3:]])
    atomic_write(path, lambda target: sheet.save(target, "PNG"))


def _cell(view: View, hidden: tuple[str, ...]) -> Image:
    """The mesh with the names of its points, but for those with a part of a name in `hidden`."""
    from PIL import ImageDraw, ImageFont

    mesh, _ = load_canonical("mid")
    normals = vertex_normals(mesh.vertices, mesh.triangles)
    skin = poly(mesh.vertices, mesh.triangles, normals), {"color": _SKIN, "smooth_shading": True}
    picture = shot([skin], view)
    towards = np.array(view.towards) / np.linalg.norm(view.towards)
    across = np.cross(view.up, towards)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(across, towards)])
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(11)
    taken: list[tuple[float, float, float, float]] = []
    for name, number in canonical_landmarks().items():
        if normals[number] @ towards < _FACING or any(part in name for part in hidden):
            continue
        x, y = axes @ (mesh.vertices[number] - view.focus) * picture.height / view.height
        x, y = x + picture.width / 2, y + picture.height / 2
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=_DOT)
        wide = draw.textlength(name, font=font)
        start = x + 6 if x > picture.width / 2 else x - 6 - wide
        start, top = min(max(start, 2), picture.width - wide - 2), y - 6
        while any(a < start + wide and start < b and c < top + 12 and top < d for a, b, c, d in taken):
            top += 12  # below the names that stand there
        taken.append((start, start + wide, top, top + 12))
        draw.text((start, top), name, fill=_INK, font=font)
    return picture
