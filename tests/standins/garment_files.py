"""``point.pca`` and ``mean.obj`` in the layout of GarmentMeasurements, holding a body of this project."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from soma_core.obj import write_obj
from tests.standins.body import make_body, write_wrap

__all__ = ["COMPONENTS", "FACES", "VERTICES", "garment_arrays", "write_garment_pair", "write_pca"]

VERTICES, FACES, COMPONENTS = 23752, 47500, 15
_ADULTS = 0.4


def garment_arrays() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orthonormal matrix (3 V, 15), mean (3 V,) and eigenvalues (15,), all float64."""
    body = make_body(VERTICES, FACES)
    directions = _ADULTS * body.directions[:COMPONENTS].reshape(COMPONENTS, -1)
    sizes = np.linalg.norm(directions, axis=1)
    return (directions / sizes[:, None]).T, body.vertices.ravel(), sizes**2


def write_pca(path: Path, matrix: np.ndarray, mean: np.ndarray, eigenvalues: np.ndarray) -> Path:
    """Write the binary file, little-endian, the matrix column by column."""
    parts = [
        matrix.astype("<f8").tobytes(order="F"),
        mean.astype("<f8").tobytes(),
        eigenvalues.astype("<f8").tobytes(),
    ]
    path.write_bytes(struct.pack("<II", *matrix.shape) + b"".join(parts))
    return path


def write_garment_pair(folder: Path) -> None:
    """Write ``mean.obj`` and ``SOMA_wrap.obj``."""
    body = make_body(VERTICES, FACES)
    folder.mkdir(parents=True, exist_ok=True)
    write_obj(folder / "mean.obj", body.vertices, body.faces)
    write_wrap(folder, body)
