"""``soma wrap``: the OBJ pair of a new backend from its neutral mesh, without an artist."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from soma_core.backends.parameters import batch_parameters
from soma_core.cache import atomic_write
from soma_core.errors import AssetError, InputError
from soma_core.io.mesh_vertices import read_mesh_vertices
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import HasTriangles, WrapPair
from soma_core.registration.quality import Quality, measure
from soma_core.registration.register import Registration, WrapOptions, register
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh
from soma_core.tasks.animate import given_params
from soma_core.topology.wrap_pair import read_obj

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["WRAP_FILE", "run", "write_pair"]

_log = logging.getLogger(__name__)

WRAP_FILE = "SOMA_wrap.obj"
_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
_DIGITS = {"m": 7, "cm": 5, "mm": 4}
"""Decimals of a coordinate: a tenth of a micrometre."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Native:
    """A mesh to wrap: its arrays, the file to copy where there is one, its name, what is known of it."""

    vertices: np.ndarray
    triangles: np.ndarray
    name: str
    file: Path | None = None
    known: Mapping[str, Any] | None = None


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
    report = {
        "native": native.name, "pair": [pair.native.name, pair.wrap.name],
        "unit": found.frame.unit, "up": found.frame.up, "forward": found.frame.forward,
        "symmetric": found.symmetric, "notes": list(found.notes), **quality.as_dict(),
    }  # fmt: skip
    text = json.dumps(report, indent=2) + "\n"
    atomic_write(folder / "report.json", lambda path: _write_text(path, text))
    _say(found, quality, pair, config.fill)
    if config.picture:
        from soma_core.tasks.wrap_picture import draw_wrap

        draw_wrap(folder / "wrap.png", found, quality, mesh)


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


def _read_native(config: DictConfig) -> _Native:
    chosen = config.backend is not None
    if chosen == (config.native is not None):
        raise InputError(
            "native",
            got="a mesh and a backend" if chosen else "none, and no backend",
            expected="one of the two",
            fix="Pass native=BODY.obj or backend=NAME.",
        )
    if chosen:
        return _neutral(config.backend)
    path = Path(config.native).expanduser()
    if path.suffix.lower() == ".obj":
        return _Native(vertices=(read := read_obj(path))[0], triangles=read[1], name=path.name, file=path)
    if path.suffix.lower() != ".ply":
        raise InputError(
            "native", got=f"the suffix {path.suffix!r}", expected=".obj or .ply", fix="Export it as OBJ."
        )
    vertices = read_mesh_vertices(path)
    return _Native(vertices=vertices, triangles=_ply_triangles(path, vertices), name=f"{path.stem}.obj")


def _ply_triangles(path: Path, vertices: np.ndarray) -> np.ndarray:
    import trimesh

    loaded = trimesh.load(path, process=False, maintain_order=True)
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.vertices) != len(vertices):
        raise AssetError(path, cause="holds no faces", fix="Export the mesh with its faces, as OBJ.")
    return np.asarray(loaded.faces, np.int64)


def _neutral(choice: DictConfig) -> _Native:
    """The mesh that a backend makes of its parameters, with the faces of the native mesh that it declares."""
    registry, name = default_registry(), choice.name
    spec = registry.spec(name)
    if spec.wrap is None:
        raise InputError(
            "backend", got=name, expected="a backend with a topology of its own", fix="It needs no wrap."
        )
    cpu, dtype = torch.device("cpu"), torch.float64
    options = given_params(choice.options)
    generator = registry.generator(name, device=cpu, dtype=dtype, options=options, wrapped=False)
    params = batch_parameters(spec, given_params(choice.params), device=cpu, dtype=dtype)
    with registry.isolated(name, "rest"), torch.no_grad():
        vertices = generator.rest(params)[0].double().numpy()
    if isinstance(generator, HasTriangles):
        triangles = generator.triangles().numpy()
    elif spec.wrap.native.is_file():
        triangles = read_obj(spec.wrap.native)[1]
    else:
        raise InputError(
            "backend",
            got=f"{name}, whose generator has no triangles(), and no file {spec.wrap.native}",
            expected="one of the two, for the faces",
            fix="Write the neutral mesh as OBJ and pass native=FILE.",
        )
    return _Native(
        vertices=vertices, triangles=triangles, name=f"{name}_neutral.obj",
        known={"unit": spec.unit, "up": spec.up, "forward": spec.forward},
    )  # fmt: skip


def _options(config: DictConfig, native: _Native) -> WrapOptions:
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
