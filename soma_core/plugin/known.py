"""Backends that the project knows of: whose models they are, under which licence, and where to get one."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["KNOWN_BACKENDS", "KnownBackend", "publication"]


@dataclass(frozen=True, kw_only=True)
class KnownBackend:
    """One backend.

    Attributes:
        name: of the backend.
        distribution: that provides it; a folder of this project's checkout has it.
        licence: of the model.
        model: what it is, and who made it.
        url: where the model comes from.
        files: what the user must have of its makers; empty where nothing is missing.
    """

    name: str
    distribution: str
    licence: str
    model: str
    url: str = ""
    files: str = ""


_SMPL = "non-commercial research, by registration (Max Planck); never redistributed"
_MHR = "https://github.com/facebookresearch/MHR"
_GARMENT = "https://github.com/mbotsch/GarmentMeasurements"

_ROWS = (
    ("anny", "anny", "Apache-2.0 (code), CC0-1.0 (data)", "Anny, people of all ages (NAVER)",
     "https://github.com/naver/anny", ""),
    ("garment", "garment", "GPL-3.0", "GarmentMeasurements (Botsch et al.)", _GARMENT, "point.pca, mean.obj"),
    ("mhr", "mhr", "Apache-2.0", "Momentum Human Rig, LOD 1 (Meta)", _MHR, "mhr_model_lod1.pt"),
    ("mhr_lod6", "mhr", "Apache-2.0", "Momentum Human Rig, LOD 6 (Meta)", _MHR, "mhr_model_lod6.pt"),
    ("smpl", "smpl", _SMPL, "SMPL (MPI)", "https://smpl.is.tue.mpg.de", "the model of a gender"),
    ("smplh", "smpl", _SMPL, "SMPL-H (MPI)", "https://mano.is.tue.mpg.de", "the model of a gender"),
    ("smplx", "smpl", _SMPL, "SMPL-X (MPI)", "https://smpl-x.is.tue.mpg.de", "the model of a gender"),
    ("toy", "toy", "Apache-2.0", "a figure of capsules, to read", "", ""),
)  # fmt: skip

KNOWN_BACKENDS = {
    name: KnownBackend(
        name=name, distribution=f"soma-backend-{folder}", licence=licence, model=model, url=url, files=files
    )
    for name, folder, licence, model, url, files in _ROWS
}
"""By name: none is published on an index yet."""


def publication(distribution: str) -> str:
    """Return how to come by a distribution of this project, or an empty text for one of somebody else."""
    if distribution not in {each.distribution for each in KNOWN_BACKENDS.values()}:
        return ""
    folder = f"./plugins/{distribution.removeprefix('soma-backend-')}"
    return f"Run in a checkout of this project, since no index has it: pip install {folder}"
