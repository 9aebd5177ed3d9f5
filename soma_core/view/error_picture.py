"""Picture of a fit's worst frames: the body coloured by its distance to the target, with a colour bar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soma_core.view.picture import contact_sheet, sheet_width
from soma_core.view.stage import PAPER, Body

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["colour_bar", "error_colours", "error_sheet", "scale_top"]

_STOPS = np.array(
    [[0.90, 0.91, 0.89], [0.99, 0.86, 0.55], [0.97, 0.58, 0.30], [0.80, 0.20, 0.25], [0.36, 0.04, 0.28]]
)
"""Colours (sRGB) from no error to the top of the scale, evenly spaced."""

_UNKNOWN = (0.55, 0.63, 0.72)
"""Colour of vertices without a target."""

_ROUND = (1, 2, 5, 10)
"""Leading digits of the number at the top of the scale."""

_SHOWN_SHARE = 0.99
"""Share of the vertices below the top of the scale: a few outliers would leave the rest without colour."""

_LEAST_TOP = 0.1
"""Smallest top of the scale [mm]: what nobody would see looks like no error."""

_INK = (70, 70, 72)


def error_sheet(
    path: Path, bodies: Sequence[Body], errors_mm: Sequence[np.ndarray], *, width: int = 1600
) -> None:
    """Write bodies coloured by their errors, all on one scale, with its colour bar below.

    Args:
        path: the PNG.
        bodies: one a frame.
        errors_mm: error of each vertex of each body [mm]; NaN where there is none.
        width: width of the picture in pixels.

    Raises:
        InputError: pyvista is not installed.
    """
    top = scale_top(np.concatenate(errors_mm))
    shaded = [
        replace(body, shades=error_colours(errors, top))
        for body, errors in zip(bodies, errors_mm, strict=True)
    ]
    columns = min(len(shaded), 5)
    wide = sheet_width(len(shaded), width) // columns * columns
    contact_sheet(path, shaded, width=width, columns=columns, legend=colour_bar(wide, top))


def scale_top(errors_mm: np.ndarray) -> float:
    """Round number [mm] above nearly all errors."""
    known = errors_mm[np.isfinite(errors_mm)]
    wanted = max(float(np.quantile(known, _SHOWN_SHARE)) if known.size else 0.0, _LEAST_TOP)
    decade = 10 ** np.floor(np.log10(wanted))
    digit = next(digit for digit in _ROUND if digit * decade >= wanted * (1 - 1e-9))
    return float(f"{digit * decade:.1g}")


def error_colours(errors_mm: np.ndarray, top: float) -> np.ndarray:
    """Colours (v, 3), sRGB in 0..1, of errors [mm] on a scale from 0 to `top`."""
    place = np.clip(np.nan_to_num(errors_mm) / top, 0, 1) * (len(_STOPS) - 1)
    steps = np.arange(len(_STOPS))
    colours = np.stack([np.interp(place, steps, channel) for channel in _STOPS.T], axis=-1)
    return np.where(np.isfinite(errors_mm)[:, None], colours, _UNKNOWN)


def colour_bar(width: int, top: float) -> Image:
    """A horizontal bar with five labels in millimetres."""
    from PIL import Image, ImageDraw, ImageFont

    size = int(np.clip(width // 90, 11, 26))
    length, thick = int(0.5 * width), size
    left, top_edge, base = (width - length) // 2, size, int(2.6 * size)
    picture = Image.new("RGB", (width, 5 * size), tuple(round(255 * shade) for shade in PAPER))
    ramp = np.round(255 * error_colours(np.linspace(0, top, length), top)).astype(np.uint8)
    picture.paste(Image.fromarray(np.ascontiguousarray(np.tile(ramp, (thick, 1, 1)))), (left, top_edge))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size)
    for share in np.linspace(0, 1, 5):
        more = "or more, mm" if share == 1 else ""
        x, text = left + share * length, f"{share * top:.3g}"
        draw.line([(x, top_edge + thick), (x, top_edge + 1.3 * thick)], fill=_INK)
        draw.text((x, base), text, fill=_INK, font=font, anchor="ma")
        indent = draw.textlength(f"{text} ", font=font) / 2 + 0.3 * size
        draw.text((x + indent, base), more, fill=_INK, font=font, anchor="la")
    return picture
