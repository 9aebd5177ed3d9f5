"""Surfaces that show no human body, and how far they are from one."""

from __future__ import annotations

import numpy as np

from soma_core.errors import InputError
from soma_core.registration.alignment import Start
from soma_core.registration.body_fit import BodyFit
from soma_core.registration.body_model import BodyModel
from soma_core.registration.surface import Surface

__all__ = ["refuse_distant", "refuse_unlike"]

_UNLIKE = 1.0
"""Cost of the best start, of 2, beyond which no stance comes near: people have up to 0.6, a sphere 1.5."""

_FIX = (
    "Pass one human body that stands, each arm out to its side, down or between; if it is one, say unit=, "
    "up= and forward=."
)


def refuse_unlike(best: Start) -> None:
    """Refuse a surface that the mean body is not near, however it is turned.

    Raises:
        InputError: with the share of the surface that lies apart.
    """
    if best.cost > _UNLIKE:
        raise InputError(
            "native mesh",
            got=f"a surface of which {best.cost / 2:.0%} lies apart from a human body, however it is turned",
            expected=f"at most {_UNLIKE / 2:.0%}",
            fix=_FIX,
        )


def refuse_distant(fit: BodyFit, model: BodyModel, surface: Surface, *, share: float) -> None:
    """Refuse a surface that the fitted body does not reach, or that has more to it than the body.

    Args:
        fit: the body, in the frame of `surface`.
        model: that was fitted.
        surface: [m].
        share: mean distance allowed, of the height of the surface.

    Raises:
        InputError: with the distance.
    """
    stature = float(np.ptp(surface.vertices[:, 1]))
    skin = fit.vertices[model.skin]
    contact = surface.closest(skin)
    there = (contact.points - skin)[~contact.open]
    here = Surface(fit.vertices, model.triangles).closest(surface.vertices).points - surface.vertices
    gap = max(float(np.linalg.norm(offset, axis=1).mean()) for offset in (there, here))
    if gap > share * stature:
        raise InputError(
            "native mesh",
            got=f"a surface {1000 * gap:.0f} mm from the nearest human body on average",
            expected=f"at most {1000 * share * stature:.0f} mm ({share:.0%} of its height)",
            fix=_FIX,
        )
