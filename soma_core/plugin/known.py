"""Backends that the project knows of: where to get one that is asked for but not installed."""

from __future__ import annotations

__all__ = ["KNOWN_BACKENDS", "install_line"]

KNOWN_BACKENDS = {
    "anny": "soma-backend-anny",
    "garment": "soma-backend-garment",
    "mhr": "soma-backend-mhr",
    "smpl": "soma-backend-smpl",
    "smplh": "soma-backend-smpl",
    "smplx": "soma-backend-smpl",
}
"""Backend name -> the distribution that provides it."""


def install_line(name: str) -> str | None:
    """Return the pip line that installs backend `name`, or None for a name nobody has told us of."""
    distribution = KNOWN_BACKENDS.get(name)
    return f"pip install {distribution}" if distribution else None
