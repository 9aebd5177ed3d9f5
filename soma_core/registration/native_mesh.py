"""A native mesh to lay the canonical one on: from a file, or from a backend's own generator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from soma_core.backends.parameters import batch_parameters
from soma_core.errors import InputError
from soma_core.io.mesh_vertices import read_mesh_vertices, read_ply_triangles
from soma_core.obj import read_obj
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import HasTriangles

__all__ = ["NativeMesh", "neutral_mesh", "read_native_mesh"]


@dataclass(frozen=True, kw_only=True, eq=False)
class NativeMesh:
    """A mesh to wrap.

    Attributes:
        vertices: (n, 3).
        triangles: (t, 3).
        name: file name for the pair.
        file: the OBJ that it came from, if any.
        known: ``unit``, ``up`` and ``forward``, where they are.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    name: str
    file: Path | None = None
    known: Mapping[str, Any] | None = None


def neutral_mesh(
    registry: Registry, name: str, *, options: Mapping[str, Any], params: Mapping[str, Any]
) -> NativeMesh:
    """The mesh that a backend makes of its parameters, with the faces of the native mesh that it declares.

    Raises:
        InputError: the backend needs no wrap, or nothing tells the faces.
        BackendError: it cannot be built.
    """
    spec = registry.spec(name)
    if spec.wrap is None:
        raise InputError(
            "backend", got=name, expected="a backend with a topology of its own", fix="It needs no wrap."
        )
    cpu, dtype = torch.device("cpu"), torch.float64
    generator = registry.generator(name, device=cpu, dtype=dtype, options=options, wrapped=False)
    batch = batch_parameters(spec, params, device=cpu, dtype=dtype)
    with registry.isolated(name, "rest"), torch.no_grad():
        vertices = generator.rest(batch)[0].double().numpy()
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
    return NativeMesh(
        vertices=vertices, triangles=triangles, name=f"{name}_neutral.obj",
        known={"unit": spec.unit, "up": spec.up, "forward": spec.forward},
    )  # fmt: skip


def read_native_mesh(path: Path) -> NativeMesh:
    """The mesh in an OBJ or PLY file, its vertices in their order.

    Raises:
        AssetError: the file cannot be read, or holds no faces.
        InputError: another kind of file.
    """
    if path.suffix.lower() == ".obj":
        return NativeMesh(vertices=(read := read_obj(path))[0], triangles=read[1], name=path.name, file=path)
    if path.suffix.lower() != ".ply":
        raise InputError(
            "native", got=f"the suffix {path.suffix!r}", expected=".obj or .ply", fix="Export it as OBJ."
        )
    vertices = read_mesh_vertices(path)
    triangles = read_ply_triangles(path, len(vertices))
    return NativeMesh(vertices=vertices, triangles=triangles, name=f"{path.stem}.obj")
