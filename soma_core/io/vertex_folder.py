"""Vertices in a folder of meshes, one OBJ or PLY a frame."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from soma_core.errors import InputError
from soma_core.io.mesh_vertices import read_mesh_vertices
from soma_core.io.vertex_sequence import VertexSequence

__all__ = ["MESH_SUFFIXES", "FolderSequence", "natural"]

MESH_SUFFIXES = (".obj", ".ply")


class FolderSequence(VertexSequence):
    """Meshes in natural order of their names: ``f2.obj`` comes before ``f10.obj``.

    Args:
        path: the folder. Only ``.obj`` and ``.ply`` count, and it must not hold both.

    Raises:
        InputError: no meshes, or both kinds.
        AssetError: the first mesh cannot be read.
    """

    def __init__(self, path: Path) -> None:
        files = [file for file in path.iterdir() if file.suffix.lower() in MESH_SUFFIXES]
        kinds = sorted({file.suffix.lower() for file in files})
        if len(kinds) != 1:
            raise InputError(
                str(path),
                got=f"a folder with {' and '.join(kinds) or 'neither .obj nor .ply'} files",
                expected="meshes of one kind, one a frame",
                fix="Put the frames into a folder of their own.",
            )
        self._files = sorted(files, key=natural)
        super().__init__(path, len(self._files), len(read_mesh_vertices(self._files[0])))

    def _read(self, start: int, stop: int) -> np.ndarray:
        return np.stack([self._mesh(file) for file in self._files[start:stop]])

    def _mesh(self, file: Path) -> np.ndarray:
        vertices = read_mesh_vertices(file)
        if len(vertices) != self.vertex_count:
            raise InputError(
                str(file),
                got=f"{len(vertices)} vertices",
                expected=f"{self.vertex_count}, as in {self._files[0].name}",
                fix="Export every frame without merging or removing vertices.",
            )
        return vertices


def natural(file: Path) -> list[tuple[int, int | str]]:
    """Sorting key in which numbers count as numbers."""
    parts = re.split(r"([0-9]{1,18})", file.name)  # other digits, such as ², are no numbers to Python
    return [(0, int(part)) if part.isascii() and part.isdigit() else (1, part) for part in parts if part]
