"""The specimen, a whole plugin package in ``specimen/``: copied, edited, and offered in a registry."""

from __future__ import annotations

import importlib
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias
from unittest import mock

import numpy as np
import torch
from numpy.typing import ArrayLike

from soma_core.geometry.barycentric import closest_point_on_triangle
from soma_core.obj import read_obj, write_obj
from soma_core.plugin.discovery import Offer
from soma_core.plugin.registry import Registry
from soma_core.testing.checks import behaviour
from soma_core.testing.context import CPU
from soma_core.testing.process_probe import ProcessProbe
from soma_core.testing.report import Report
from soma_core.testing.run import check_backend
from soma_core.testing.synthetic import synthetic_canonical, write_wrap_pair
from soma_core.topology.closest import ClosestFaces
from tests.plugin.fakes import FakeEntryPoint

__all__ = ["PACKAGE", "Edit", "Package", "check_package", "package"]

PACKAGE = "soma_backend_specimen"
_SOURCE = Path(__file__).parent / "specimen"


Edit: TypeAlias = "Callable[[Package], object]"


class Package:
    """The specimen's files in a folder of their own, to be edited."""

    def __init__(self, parent: Path) -> None:
        self.folder = parent / PACKAGE
        shutil.copytree(_SOURCE, self.folder, ignore=shutil.ignore_patterns("__pycache__"))
        write_wrap_pair(self.folder)
        (self.folder / "model.txt").write_text("")

    def replace(self, file: str, old: str, new: str) -> None:
        """Replace a text that occurs once."""
        path = self.folder / file
        text = path.read_text()
        assert text.count(old) == 1, f"{file} holds {old!r} {text.count(old)} times"
        path.write_text(text.replace(old, new))

    def prepend(self, file: str, text: str) -> None:
        """Add lines at the beginning."""
        path = self.folder / file
        path.write_text(text + path.read_text())

    def add(self, file: str, text: str) -> None:
        """Write a new file."""
        path = self.folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def delete(self, file: str) -> None:
        """Take a file away."""
        (self.folder / file).unlink()

    def mesh(self, file: str) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and triangles of an OBJ."""
        return read_obj(self.folder / file)

    def write(self, file: str, vertices: ArrayLike, triangles: ArrayLike) -> None:
        """Write an OBJ."""
        write_obj(self.folder / file, np.asarray(vertices), np.asarray(triangles))

    def remesh(self, file: str, edit: Callable[[np.ndarray, np.ndarray], tuple | None]) -> None:
        """Edit vertices and triangles of an OBJ, in place or by returning others."""
        vertices, triangles = self.mesh(file)
        self.write(file, *(edit(vertices, triangles) or (vertices, triangles)))

    def deform(self, move: Callable[[np.ndarray], None]) -> None:
        """Move the vertices of both OBJs [m, canonical axes] in place, by one rule; the wrap stays on."""
        meshes = {}
        for file in ("native.obj", "wrap.obj"):
            vertices, triangles = self.mesh(file)
            points = vertices[:, [0, 2, 1]] / 100 * [1, 1, -1]
            move(points)
            meshes[file] = 100 * points[:, [0, 2, 1]] * [1, -1, 1], triangles
        native, faces = meshes["native.obj"]
        wrap, _ = meshes["wrap.obj"]
        outside = np.setdiff1d(np.arange(len(wrap)), synthetic_canonical()[0].face_interior)
        nearest = faces[ClosestFaces(native, faces).query(wrap[outside])]
        wrap[outside] = closest_point_on_triangle(wrap[outside], native[nearest])
        for file, mesh in meshes.items():
            self.write(file, *mesh)


@contextmanager
def package(parent: Path, edit: Edit = lambda made: None) -> Iterator[Registry]:
    """Write the package, edit it, and offer it in a registry of its own while the context lasts."""
    made = Package(parent)
    edit(made)
    sys.path.insert(0, str(parent))
    _forget()
    point = FakeEntryPoint("specimen", value=PACKAGE, load=lambda: importlib.import_module(PACKAGE))
    try:
        yield Registry([point])
    finally:
        sys.path.remove(str(parent))
        _forget()


def _forget() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
        del sys.modules[name]
    importlib.invalidate_caches()


def check_package(
    parent: Path, edit: Edit = lambda made: None, *, apart: bool = True, **arguments: object
) -> Report:
    """Run the checks on an edited package; without `apart` none starts a process that loads torch."""

    def here(offer: Offer, options: Mapping[str, Any], params: Mapping[str, np.ndarray]) -> ProcessProbe:
        made = registry.generator(offer.name, device=CPU, dtype=torch.float64, options=options)
        with torch.no_grad():
            bodies = made.rest({name: torch.from_numpy(value) for name, value in params.items()})
        return ProcessProbe(bodies=bodies.numpy(), ending="")

    with (
        package(parent, edit) as registry,
        mock.patch.object(behaviour, "probe_process", behaviour.probe_process if apart else here),
    ):
        return check_backend("specimen", registry=registry, canonical=synthetic_canonical(), **arguments)
