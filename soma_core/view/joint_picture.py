"""Close pictures of bent joints: plain skinning, twist joints alone, and correctives, side by side."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from soma_core.animation.posed import Posed
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.layer import SomaLayer
from soma_core.view.stage import PAPER, Body, Stage, open_stage

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["draw_joints"]

_FRONT, _SIDE, _ABOVE, _BACK = (0.0, 0.0, 0.0), (0.0, -90.0, 0.0), (90.0, 0.0, 0.0), (0.0, 180.0, 0.0)
"""Rotation vectors [degrees] that turn the body's front, left side, top or back towards the camera."""

_JOINTS = (
    ("knee", "LeftShin", (1, 0, 0), (60, 90, 120), (_SIDE, _FRONT)),
    ("elbow", "LeftForeArm", (0, -1, 0), (60, 90, 120), (_ABOVE, _BACK)),
    ("hip", "LeftLeg", (-1, 0, 0), (60, 90, 120), (_SIDE, _BACK)),
    ("shoulder", "LeftArm", (0, 0, 1), (30, 60, 90), (_FRONT, _BACK)),
)
"""Name, joint, axis in the T-pose world, angles [degrees], and the two sides that are shown: before a bent
elbow or hip there is a hand or a foot."""

_KINDS = ("plain skinning", "twist joints", "correctives")
_COLOUR, _CELL, _GAP, _TALL, _HEAD = (0.79, 0.68, 0.62), 150, 4, 0.42, 22
_FAR_BELOW = -50.0
"""A floor that throws no shadow [m]."""


def draw_joints(path: Path, checkpoint: str | None = None) -> None:
    """Draw knee, elbow, hip and shoulder of the canonical body, bent, from two sides and from near.

    Args:
        path: the PNG.
        checkpoint: the correctives; None for the shipped ones.

    Raises:
        InputError: pyvista is not installed.
    """
    layer = SomaLayer("soma", correctives=checkpoint or "auto")
    layers = (layer.pose_plain, SomaLayer("soma", correctives=None).pose, layer.pose)
    identity, rows = layer.identity(), []
    with open_stage((_CELL - _GAP, _CELL), oversampling=2) as stage:
        for name, joint, axis, angles, sides in _JOINTS:
            number = layer.joint_names.index(joint)
            turns = torch.eye(3).repeat(len(angles), len(layer.joint_names), 1, 1)
            radians = torch.deg2rad(torch.tensor(angles, dtype=torch.float32))
            turns[:, number] = axis_angle_to_matrix(radians[:, None] * torch.tensor(axis).float())
            with torch.no_grad():
                posed = [pose(identity, turns, torch.zeros(len(angles), 3)) for pose in layers]
            rows += [(name, angles, _row(stage, posed, layer.mesh.triangles, number, side)) for side in sides]
    _sheet(rows).save(path)


def _row(
    stage: Stage, posed: Sequence[Posed], triangles: np.ndarray, joint: int, side: Sequence[float]
) -> list[Image]:
    """Cells of one side, frame by frame, about a user joint."""
    view = axis_angle_to_matrix(torch.deg2rad(torch.tensor(side))).numpy()
    cells = []
    for frame, one in itertools.product(range(len(posed[0].vertices)), posed):
        skin = one.vertices[frame].numpy() @ view.T
        body = Body(vertices=skin, triangles=triangles, colour=_COLOUR)
        focus = view @ one.joints[frame, joint].numpy()
        cells.append(stage.shot([body], focus=focus, height=_TALL, flat=True, floor=_FAR_BELOW))
    return cells


def _sheet(rows: Sequence[tuple[str, Sequence[int], Sequence[Image]]]) -> Image:
    """Cells in rows, with a line of text above each."""
    from PIL import Image, ImageDraw, ImageFont

    paper = tuple(round(255 * shade) for shade in PAPER)
    picture = Image.new("RGB", (_CELL * len(rows[0][2]), (_CELL + _HEAD) * len(rows)), paper)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(11)
    for row, (name, angles, cells) in enumerate(rows):
        top = row * (_CELL + _HEAD)
        for column, cell in enumerate(cells):
            angle, kind = angles[column // len(_KINDS)], _KINDS[column % len(_KINDS)]
            text = f"{name} {angle}°, {kind}" if column % len(_KINDS) == 0 else kind
            picture.paste(cell, (column * _CELL, top + _HEAD))
            draw.text((column * _CELL + 6, top + 5), text, fill=(70, 70, 72), font=font)
    return picture
