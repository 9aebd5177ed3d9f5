"""Vertices over time for other programs: NPZ, OBJ and PLY a frame, point caches PC2 and MDD.

Every writer holds one piece of the sequence at a time and writes atomically.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from soma_core.cache import atomic_folder, atomic_text, atomic_write
from soma_core.errors import InputError
from soma_core.io.npz_parts import write_npz_parts
from soma_core.rig.mesh import CanonicalMesh
from soma_core.topology.frames import METRES_PER_UNIT

__all__ = [
    "MeshFrames",
    "canonical_frames",
    "write_mdd",
    "write_obj_folder",
    "write_pc2",
    "write_ply_folder",
    "write_vertex_npz",
]

Pieces = Callable[[], Iterator[np.ndarray]]

_FRAME = "frame_{:06d}"
_FRAMES = re.compile(r"frame_\d+\.(obj|ply)")

_NO_UV = np.empty((0, 2), np.float32)
_NO_IDS = np.empty(0, np.int32)


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshFrames:
    """A mesh over time, ready for export.

    Attributes:
        pieces: gives consecutive pieces (f, n, 3) float32 of the frames, from the start at each call.
        frame_count, vertex_count: its size.
        triangles: (t, 3) vertex ids.
        counts, indices: polygons, as many vertices as each has and their ids.
        uv, uv_indices: texture coordinates, and one of their ids for each of `indices`; empty without.
        fps: frames per second.
        metres: one unit of length [m].
        up: upward axis.
        source: what is shown.
    """

    pieces: Pieces
    frame_count: int
    vertex_count: int
    triangles: np.ndarray
    counts: np.ndarray
    indices: np.ndarray
    uv: np.ndarray = field(default_factory=lambda: _NO_UV)
    uv_indices: np.ndarray = field(default_factory=lambda: _NO_IDS)
    fps: float
    metres: float = 1.0
    up: str = "+y"
    source: str = ""

    @property
    def unit(self) -> str:
        """Name of the unit of length."""
        return next(name for name, length in METRES_PER_UNIT.items() if length == self.metres)

    def numbered(self) -> Iterator[tuple[int, np.ndarray]]:
        """Each frame (n, 3) float32 and its number.

        Raises:
            InputError: the pieces do not add up.
        """
        number = 0
        for piece in self.pieces():
            for frame in np.asarray(piece, np.float32):
                yield number, frame
                number += 1
        if number != self.frame_count:
            raise InputError(
                "pieces", got=f"{number} frames", expected=self.frame_count, fix="Give every piece, once."
            )


def canonical_frames(
    mesh: CanonicalMesh, pieces: Pieces, *, frame_count: int, fps: float, up: str = "+y", source: str = ""
) -> MeshFrames:
    """Frames [m] of the canonical mesh, with its polygons and texture coordinates."""
    return MeshFrames(
        pieces=pieces, frame_count=frame_count, vertex_count=mesh.vertex_count, triangles=mesh.triangles,
        counts=mesh.face_vert_counts, indices=mesh.face_vert_indices,
        uv=mesh.uv, uv_indices=mesh.uv_indices if len(mesh.uv) else _NO_IDS, fps=fps, up=up, source=source,
    )  # fmt: skip


def write_vertex_npz(path: Path, mesh: MeshFrames) -> None:
    """Write ``vertices`` (frames, n, 3) float32, ``triangles``, ``fps``, ``unit`` and ``up_axis``."""
    arrays = {
        "vertices": np.empty((0, mesh.vertex_count, 3), np.float32),
        "triangles": mesh.triangles.astype(np.int32),
        "fps": np.asarray(mesh.fps),
        "unit": np.asarray(mesh.unit),
        "source": np.asarray(mesh.source),
    }
    if mesh.up in ("+y", "+z"):
        arrays["up_axis"] = np.asarray(mesh.up[1:].upper())
    write_npz_parts(path, arrays, {"vertices": mesh.pieces}, count=mesh.frame_count)


def write_obj_folder(path: Path, mesh: MeshFrames) -> None:
    """Write an OBJ a frame, ``frame_000000.obj`` and so on, with polygons and texture coordinates.

    Raises:
        InputError: the folder holds other files.
    """
    faces = _obj_faces(mesh)

    def write(folder: Path) -> None:
        for number, frame in mesh.numbered():
            (folder / f"{_FRAME.format(number)}.obj").write_text(_obj(mesh, frame, faces), encoding="utf-8")

    _refuse_other_files(path)
    atomic_folder(path, write)


def write_ply_folder(path: Path, mesh: MeshFrames) -> None:
    """Write a binary PLY a frame, ``frame_000000.ply`` and so on, with triangles.

    Raises:
        InputError: the folder holds other files.
    """
    told = "".join(f"comment {line}\n" for line in _told(mesh))
    header = (
        f"ply\nformat binary_little_endian 1.0\n{told}element vertex {mesh.vertex_count}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.triangles), np.dtype([("count", "u1"), ("ids", "<i4", 3)]))
    faces["count"], faces["ids"] = 3, mesh.triangles

    def write(folder: Path) -> None:
        for number, frame in mesh.numbered():
            content = header.encode() + frame.astype("<f4").tobytes() + faces.tobytes()
            (folder / f"{_FRAME.format(number)}.ply").write_bytes(content)

    _refuse_other_files(path)
    atomic_folder(path, write)


def write_pc2(path: Path, mesh: MeshFrames) -> None:
    """Write a PC2 point cache, one sample a frame from frame 0, and beside it the mesh it moves as an OBJ.

    The cache: ``POINTCACHE2``, version 1, number of points, first frame, step, number of samples, then the
    points; little-endian, float32. It knows no frame rate, unit or axis: the OBJ's comments do.
    """
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, mesh.vertex_count, 0.0, 1.0, mesh.frame_count)
    _write_cache(path, mesh, head, "<f4")


def write_mdd(path: Path, mesh: MeshFrames) -> None:
    """Write an MDD point cache, and beside it the mesh it moves as an OBJ.

    The cache: number of frames, number of points, the time of each frame [s], then the points; big-endian,
    float32. It knows no unit or axis: the OBJ's comments do.
    """
    times = (np.arange(mesh.frame_count) / mesh.fps).astype(">f4")
    head = struct.pack(">ii", mesh.frame_count, mesh.vertex_count) + times.tobytes()
    _write_cache(path, mesh, head, ">f4")


def _write_cache(path: Path, mesh: MeshFrames, head: bytes, kind: str) -> None:
    first = next(frame for _, frame in mesh.numbered())
    atomic_text(path.with_suffix(".obj"), _obj(mesh, first, _obj_faces(mesh)))

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as stream:
            stream.write(head)
            for _, frame in mesh.numbered():
                stream.write(frame.astype(kind).tobytes())

    atomic_write(path, write)


def _told(mesh: MeshFrames) -> list[str]:
    """What these formats have no field for, on lines of a comment."""
    source = " ".join(mesh.source.split())
    return [*([source] if source else []), f"fps {mesh.fps:.9g}", f"unit {mesh.unit}", f"up {mesh.up}"]


def _obj(mesh: MeshFrames, frame: np.ndarray, faces: str) -> str:
    told = "".join(f"# {line}\n" for line in _told(mesh))
    # Nine digits are what float32 holds; one operation on the whole frame is ten times quicker than a loop.
    points = ("v %.9g %.9g %.9g\n" * len(frame)) % tuple(frame.ravel().tolist())
    return told + points + faces


def _obj_faces(mesh: MeshFrames) -> str:
    """Texture coordinates and polygons, the same in every frame; ids begin at 1."""
    textured = len(mesh.uv_indices) > 0
    corners = [f" {index}" for index in (mesh.indices + 1).tolist()]
    if textured:
        corners = [
            f"{corner}/{uv}" for corner, uv in zip(corners, (mesh.uv_indices + 1).tolist(), strict=True)
        ]
    ends = np.cumsum(mesh.counts).tolist()
    texture = "".join(f"vt {u:.9g} {v:.9g}\n" for u, v in mesh.uv.tolist()) if textured else ""
    rows = (
        "".join(corners[end - count : end]) for count, end in zip(mesh.counts.tolist(), ends, strict=True)
    )
    return texture + "".join(f"f{row}\n" for row in rows)


def _refuse_other_files(path: Path) -> None:
    """Refuse to replace a folder that holds what no run of ours has written."""
    others = (
        [file.name for file in path.iterdir() if not _FRAMES.fullmatch(file.name)] if path.is_dir() else []
    )
    if others:
        raise InputError(
            str(path), got=f"a folder that holds {others[0]}", expected="frames alone, or no folder yet",
            fix="Give another folder for the results.",
        )  # fmt: skip
