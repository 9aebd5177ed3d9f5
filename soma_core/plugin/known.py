"""Backends that the project knows of: where to get one that is asked for but not installed."""

from __future__ import annotations

__all__ = ["KNOWN_BACKENDS", "install_line", "publication"]

KNOWN_BACKENDS = {
    "anny": "soma-backend-anny",
    "garment": "soma-backend-garment",
    "mhr": "soma-backend-mhr",
    "mhr_lod6": "soma-backend-mhr",
    "smpl": "soma-backend-smpl",
    "smplh": "soma-backend-smpl",
    "smplx": "soma-backend-smpl",
    "toy": "soma-backend-toy",
}
"""Backend name -> the distribution that provides it: none is published on an index yet."""


def install_line(name: str) -> str | None:
    """Return the pip line that installs backend `name`, or None for a name nobody has told us of."""
    distribution = KNOWN_BACKENDS.get(name)
    return f"pip install {distribution}" if distribution else None


def publication(name: str) -> str:
    """Return what to know before the pip line of a known backend is run: where the package is today."""
    distribution = KNOWN_BACKENDS[name]
    folder = f"./plugins/{distribution.removeprefix('soma-backend-')}"
    return f"{distribution} is not published yet; from a checkout: pip install {folder}"
