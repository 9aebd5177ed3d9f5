"""Units and axes: from a backend's native frame to metres, +Y up, +Z forward."""

from __future__ import annotations

import numpy as np

from soma_core.errors import InputError
from soma_core.plugin.spec import Axis, Unit

__all__ = ["ANY_UNIT", "METRES", "METRES_PER_UNIT", "METRIC", "native_to_canonical"]

METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "ft": 0.3048}
"""Length of one unit in metres, of a backend's first."""

METRIC: tuple[Unit, ...] = ("m", "cm", "mm")
"""Units that are taken without being told; inches and feet only where nothing else fits."""

METRES_PER_UNIT = {"meters": METRES["m"], "centimeters": METRES["cm"], "millimeters": METRES["mm"]}
"""The same by the names that files of the SOMA tools have for them."""

ANY_UNIT: dict[str, float] = METRES_PER_UNIT | {str(unit): metres for unit, metres in METRES.items()}
"""The same by either name."""


def _direction(axis: Axis, argument: str) -> np.ndarray:
    if len(axis) != 2 or axis[0] not in "+-" or axis[1] not in "xyz":
        raise InputError(
            argument, got=repr(axis), expected="one of +x -x +y -y +z -z", fix="Correct the declaration."
        )
    vector = np.zeros(3)
    vector["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return vector


def native_to_canonical(up: Axis, forward: Axis) -> np.ndarray:
    """Rotation (3, 3) that takes native vectors to canonical ones (+Y up, +Z forward); det +1.

    Rows are the native left (``up x forward``), up and forward directions.
    """
    vertical, ahead = _direction(up, "up"), _direction(forward, "forward")
    if abs(vertical @ ahead) > 0:
        raise InputError(
            "forward",
            got=repr(forward),
            expected=f"an axis perpendicular to up={up!r}",
            fix="Correct the declaration.",
        )
    return np.stack([np.cross(vertical, ahead), vertical, ahead])
