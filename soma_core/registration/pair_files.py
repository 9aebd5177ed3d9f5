"""The files of a wrap: the OBJ pair of a backend's declaration, and the report on it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.cache import atomic_text, atomic_write
from soma_core.plugin.spec import WrapPair
from soma_core.registration.quality import Quality
from soma_core.registration.register import Registration
from soma_core.rig.mesh import CanonicalMesh

__all__ = ["WRAP_FILE", "write_pair", "write_report"]

WRAP_FILE = "SOMA_wrap.obj"

_DIGITS = {"m": 7, "cm": 5, "mm": 4}
"""Decimals of a coordinate: a tenth of a micrometre."""


def write_pair(
    folder: Path,
    found: Registration,
    mesh: CanonicalMesh,
    *,
    vertices: np.ndarray,
    triangles: np.ndarray,
    name: str,
    source: Path | None = None,
) -> WrapPair:
    """Write ``SOMA_wrap.obj`` and the native mesh, and return the pair for a backend's declaration.

    Args:
        folder: made where it is missing.
        found: the registration.
        mesh: the canonical mesh, whose polygons and UVs go into the file.
        vertices, triangles: the native mesh, all of it and in its order.
        name: file name of the native mesh.
        source: an OBJ to copy as it is, instead of writing the arrays.
    """
    if name == WRAP_FILE:
        name = f"native_{name}"
    digits = _DIGITS[found.frame.unit]
    native, wrap = folder / name, folder / WRAP_FILE
    if source is not None:
        if not (native.exists() and native.samefile(source)):
            atomic_write(native, lambda path: _copy(source, path))
    else:
        atomic_write(native, lambda path: _write_obj(path, vertices, triangles + 1, digits + 2))
    faces = _canonical_faces(mesh)
    atomic_write(wrap, lambda path: _write_obj(path, found.wrap, faces, digits, uv=mesh.uv))
    return WrapPair(native=native, wrap=wrap)


def _canonical_faces(mesh: CanonicalMesh) -> list[list[str]]:
    """Corners of each polygon as they stand in an OBJ, vertex/UV, counted from 1."""
    ids = mesh.face_vert_indices + 1
    corners = [f"{v}/{t + 1}" for v, t in zip(ids, mesh.uv_indices, strict=True)] if len(mesh.uv) else [
        str(v) for v in ids
    ]  # fmt: skip
    ends = np.cumsum(mesh.face_vert_counts)
    return [corners[end - count : end] for end, count in zip(ends, mesh.face_vert_counts, strict=True)]


def _write_obj(
    path: Path, vertices: np.ndarray, faces: Any, digits: int, *, uv: np.ndarray | None = None
) -> None:
    lines = [f"v {x:.{digits}f} {y:.{digits}f} {z:.{digits}f}" for x, y, z in vertices.tolist()]
    lines += [] if uv is None else [f"vt {u:.6f} {v:.6f}" for u, v in uv.tolist()]
    lines += ["f " + " ".join(map(str, face)) for face in faces]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _copy(source: Path, path: Path) -> None:
    shutil.copyfile(source, path)


def write_report(folder: Path, found: Registration, quality: Quality, *, native: str) -> None:
    """Write ``report.json``: what was found, and how good the wrap is; `native` is the file of the mesh."""
    report = {
        "native": native, "pair": [native, WRAP_FILE],
        "unit": found.frame.unit, "up": found.frame.up, "forward": found.frame.forward,
        "symmetric": found.symmetric, "notes": list(found.notes), **quality.as_dict(),
    }  # fmt: skip
    atomic_text(folder / "report.json", json.dumps(report, indent=2) + "\n")
