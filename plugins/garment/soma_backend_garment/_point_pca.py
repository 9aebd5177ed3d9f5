"""``point.pca``, the shape space of GarmentMeasurements, and the ``.npz`` that is made of it.

The file is little-endian: uint32 m = 3 V, uint32 n, float64 matrix (m, n) column by column, float64 mean
(m,), float64 eigenvalues (n,).
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soma_core import AssetError
from soma_core.plugin import atomic_arrays, file_sha256, open_npz_file, refuse_unreadable

__all__ = ["COMPONENTS", "VERTICES", "PointSpace", "read_npz", "read_pca", "write_npz"]

VERTICES, COMPONENTS = 23752, 15
_MOST_SIZE, _MOST_COMPONENTS = 1_000_000, 256
_HEADER = "<II"
_SMALLEST = 1e-13
"""Eigenvalue from which on its square root is the scale; below, the model takes its magnitude instead."""

_FIX = "Get data/pca/point.pca from the GarmentMeasurements repository and convert it again."
_KEYS = ("pca_matrix", "pca_mean", "eigenvalues")
_STATURES = (0.5, 2.5)


@dataclass(frozen=True, kw_only=True, eq=False)
class PointSpace:
    """A linear space of bodies [m], +Y up: ``mean + scales * coefficients`` along the columns of `matrix`.

    Attributes:
        matrix: (3 V, n) float64.
        mean: (3 V,) float64.
        eigenvalues: (n,) float64.
    """

    matrix: np.ndarray
    mean: np.ndarray
    eigenvalues: np.ndarray

    @property
    def scales(self) -> np.ndarray:
        """Factor (n,) of one unit of each coefficient."""
        values = self.eigenvalues
        return np.where(values > _SMALLEST, np.sqrt(np.maximum(values, 0)), np.abs(values))


def read_pca(path: Path) -> PointSpace:
    """Read ``point.pca``; sizes are checked before anything is read.

    Raises:
        AssetError: missing, of another size than its header says, or no body.
    """
    refuse_unreadable(path, fix=_FIX)
    size = path.stat().st_size
    with open(path, "rb") as stream:
        head = stream.read(struct.calcsize(_HEADER))
        if len(head) < struct.calcsize(_HEADER):
            raise AssetError(path, cause=f"is cut off: {size} bytes", fix=_FIX)
        m, n = struct.unpack(_HEADER, head)
        if not (m and m % 3 == 0 and m <= _MOST_SIZE and 1 <= n <= _MOST_COMPONENTS):
            cause = f"its header says {m} coordinates and {n} components; it is no point.pca"
            raise AssetError(path, cause=cause, fix=_FIX)
        expected = len(head) + 8 * (m * n + m + n)
        if size != expected:
            state = "is cut off" if size < expected else "goes on after its end"
            raise AssetError(path, cause=f"{state}: {size} bytes, expected {expected}", fix=_FIX)
        values = np.frombuffer(stream.read(expected - len(head)), "<f8").astype(np.float64)
    matrix, mean, eigenvalues = np.split(values, [m * n, m * n + m])
    return _checked(path, matrix.reshape(m, n, order="F"), mean, eigenvalues)


def read_npz(path: Path) -> PointSpace:
    """Read the converted form: ``pca_matrix``, ``pca_mean``, ``eigenvalues``.

    Raises:
        AssetError: missing, damaged, or not in that layout.
    """
    with open_npz_file(path, fix=_FIX) as file:
        missing = [key for key in _KEYS if key not in file.names]
        if missing:
            raise AssetError(path, cause=f"has no {', '.join(missing)}", fix=_FIX)
        found = []
        for key in _KEYS:
            try:
                found.append(file.read(key))
            except ValueError as error:
                raise AssetError(path, cause=f"{key} cannot be read ({error})", fix=_FIX) from error
    return _checked(path, *found)


def _checked(path: Path, matrix: np.ndarray, mean: np.ndarray, eigenvalues: np.ndarray) -> PointSpace:
    expected = {
        "pca_matrix": (3 * VERTICES, COMPONENTS),
        "pca_mean": (3 * VERTICES,),
        "eigenvalues": (COMPONENTS,),
    }
    for (key, shape), array in zip(expected.items(), (matrix, mean, eigenvalues), strict=True):
        if array.shape != shape or array.dtype.kind != "f":
            cause = f"{key} has the shape {array.shape} of {array.dtype}, expected {shape} of float64"
            raise AssetError(path, cause=cause, fix=_FIX)
        if not np.isfinite(array).all():
            raise AssetError(path, cause=f"{key} is not finite", fix=_FIX)
    stature = float(np.ptp(mean.reshape(-1, 3)[:, 1]))
    if not _STATURES[0] <= stature <= _STATURES[1]:
        cause = f"its mean is {stature:.4g} tall, expected metres, {_STATURES[0]} to {_STATURES[1]}, along y"
        raise AssetError(path, cause=cause, fix=_FIX)
    return PointSpace(
        matrix=matrix.astype(np.float64),
        mean=mean.astype(np.float64),
        eigenvalues=eigenvalues.astype(np.float64),
    )


def write_npz(path: Path, space: PointSpace, *, source: Path) -> None:
    """Write the converted form, atomically, with where it came from."""
    meta = {"source": source.name, "source_sha256": file_sha256(source), "unit": "m", "licence": "GPL-3.0"}
    arrays = {
        "pca_matrix": space.matrix, "pca_mean": space.mean, "eigenvalues": space.eigenvalues,
        "meta": np.array(json.dumps(meta, sort_keys=True)),
    }  # fmt: skip
    atomic_arrays(path, arrays, compressed=False)
