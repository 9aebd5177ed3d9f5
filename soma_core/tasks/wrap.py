"""``soma wrap``: the OBJ pair of a new backend from its neutral mesh, without an artist."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soma_core.cache import atomic_write
from soma_core.errors import AssetError, InputError
from soma_core.io.mesh_vertices import read_mesh_vertices
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import WrapPair
from soma_core.registration.quality import Quality, measure
from soma_core.registration.register import Registration, WrapOptions, register
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh
from soma_core.tasks.animate import given_params
from soma_core.tasks.neutral_mesh import NativeMesh, neutral_mesh
from soma_core.topology.wrap_pair import read_obj

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["WRAP_FILE", "run", "write_pair", "write_report"]

_log = logging.getLogger(__name__)

WRAP_FILE = "SOMA_wrap.obj"
_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
_DIGITS = {"m": 7, "cm": 5, "mm": 4}
"""Decimals of a coordinate: a tenth of a micrometre."""


def run(config: DictConfig, output: Path) -> None:
    """Register the canonical mesh; write the pair, ``report.json`` and ``wrap.png``.

    Raises:
        SomaError: the mesh cannot be read, is broken, or shows no human body.
    """
    mesh, _ = load_canonical("mid")
    native = _read_native(config)
    found = register(native.vertices, native.triangles, options=_options(config, native))
    quality = measure(found, mesh)
    folder = Path(config.out).expanduser() if config.out else output
    pair = write_pair(folder, found, mesh, vertices=native.vertices, triangles=native.triangles,
                      name=native.name, source=native.file)  # fmt: skip
    write_report(folder, found, quality, native=pair.native.name)
    _say(found, quality, pair, config.fill)
    if config.picture:
        from soma_core.view.wrap_picture import draw_wrap

        draw_wrap(folder / "wrap.png", found, quality, mesh)


def write_report(folder: Path, found: Registration, quality: Quality, *, native: str) -> None:
    """Write ``report.json``: what was found, and how good the wrap is; `native` is the file of the mesh."""
    report = {
        "native": native, "pair": [native, WRAP_FILE],
        "unit": found.frame.unit, "up": found.frame.up, "forward": found.frame.forward,
        "symmetric": found.symmetric, "notes": list(found.notes), **quality.as_dict(),
    }  # fmt: skip
    text = json.dumps(report, indent=2) + "\n"
    atomic_write(folder / "report.json", lambda path: _write_text(path, text))


def _say(found: Registration, quality: Quality, pair: WrapPair, fill: Sequence[str]) -> None:
    numbers = quality.as_dict()
    for note in found.notes:
        _log.info("found: %s", note)
    distance, back = numbers["surface_distance_mm"], numbers["native_to_wrap_mm"]
    _log.info(
        "wrap to surface: mean %.3f, P95 %.3f, max %.2f mm; back: mean %.3f, P95 %.3f, max %.2f mm",
        distance["mean"], distance["p95"], distance["max"], back["mean"], back["p95"], back["max"],
    )  # fmt: skip
    _log.info(
        "flipped triangles: %d (%.3f %%); %d vertices filled",
        numbers["flipped_triangles"], numbers["flipped_percent"], numbers["filled_vertices"],
    )  # fmt: skip
    frame = found.frame
    _log.info(
        'for the declaration: wrap=WrapPair(native=folder / "%s", wrap=folder / "%s"), unit="%s", up="%s", '
        'forward="%s", fill_segments=%s',
        pair.native.name, pair.wrap.name, frame.unit, frame.up, frame.forward, tuple(fill),
    )  # fmt: skip


def _read_native(config: DictConfig) -> NativeMesh:
    chosen = config.backend is not None
    if chosen == (config.native is not None):
        raise InputError(
            "native",
            got="a mesh and a backend" if chosen else "none, and no backend",
            expected="one of the two",
            fix="Pass native=BODY.obj or backend=NAME.",
        )
    if chosen:
        options, params = given_params(config.backend.options), given_params(config.backend.params)
        return neutral_mesh(default_registry(), config.backend.name, options=options, params=params)
    path = Path(config.native).expanduser()
    if path.suffix.lower() == ".obj":
        return NativeMesh(vertices=(read := read_obj(path))[0], triangles=read[1], name=path.name, file=path)
    if path.suffix.lower() != ".ply":
        raise InputError(
            "native", got=f"the suffix {path.suffix!r}", expected=".obj or .ply", fix="Export it as OBJ."
        )
    vertices = read_mesh_vertices(path)
    return NativeMesh(vertices=vertices, triangles=_ply_triangles(path, vertices), name=f"{path.stem}.obj")


def _ply_triangles(path: Path, vertices: np.ndarray) -> np.ndarray:
    import trimesh

    loaded = trimesh.load(path, process=False, maintain_order=True)
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.vertices) != len(vertices):
        raise AssetError(path, cause="holds no faces", fix="Export the mesh with its faces, as OBJ.")
    return np.asarray(loaded.faces, np.int64)


def _options(config: DictConfig, native: NativeMesh) -> WrapOptions:
    known = dict(native.known or {})
    for key in ("up", "forward"):
        value = getattr(config, key)
        if value is not None and value not in _AXES:
            raise InputError(
                key, got=repr(value), expected=" ".join(_AXES), fix=f"Pass {key}=+y or the like."
            )
        known[key] = value or known.get(key)
    known["unit"] = str(config.unit) if config.unit else known.get("unit")
    landmarks = _json(config.landmarks, dict, '{"canonical vertex id": native vertex id}')
    masked = _json(config.mask, list, "a list of native vertex ids")
    return WrapOptions(
        **known,
        fill=tuple(config.fill),
        symmetric=config.symmetric,
        landmarks={int(key): int(value) for key, value in landmarks.items()},
        masked=[int(value) for value in masked],
    )


def _json(name: str | None, kind: type, expected: str) -> Any:
    """Content of a JSON file of integers, empty where none is named."""
    if name is None:
        return kind()
    path = Path(name).expanduser()
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        items = [*content, *content.values()] if isinstance(content, dict) else content
        whole = isinstance(content, kind) and all(int(item) == float(item) for item in items)
    except OSError as error:
        raise AssetError(path, cause=f"cannot be read ({error.strerror})", fix="Correct the path.") from error
    except (ValueError, TypeError):
        whole = False
    if not whole:
        raise AssetError(path, cause=f"does not hold {expected}", fix="Write it as JSON.")
    return content


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
    _write_text(path, "\n".join(lines) + "\n")


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _copy(source: Path, path: Path) -> None:
    shutil.copyfile(source, path)
